"""Managed nodes, which need ROS 2: what stands in for rclpy.lifecycle refuses to begin."""

from __future__ import annotations

import enum
from typing import Any

from fisheye_svp_ros.standalone.exceptions import NotSupportedError


class TransitionCallbackReturn(enum.Enum):
    """What a transition comes to."""

    SUCCESS = 0
    FAILURE = 1
    ERROR = 2


class LifecycleNodeMixin:
    """The lifecycle of a node."""

    def __init__(self, **options: Any) -> None:
        raise NotSupportedError('managed nodes need an installation of ROS 2; leave the '
                                'parameter lifecycle at false')
