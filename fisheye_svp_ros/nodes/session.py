"""What a command that is a node of its own stands on: ROS 2 from its start to its end."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import rclpy
from rclpy.impl.implementation_singleton import rclpy_implementation

from fisheye_svp_ros.errors import GraphError

RCLError: type[Exception] = rclpy_implementation.RCLError


@contextmanager
def ros_session(arguments: Sequence[str]) -> Iterator[None]:
    """Start rclpy, and end it; arguments: as after `--ros-args`.

    Raises GraphError where arguments, environment or middleware allow no node.
    """
    try:
        rclpy.init(args=['--ros-args', *arguments])
    except Exception as error:  # of a kind of its own for each argument
        raise GraphError(f'ROS arguments or environment: {error}') from error
    try:
        yield
    except RCLError as error:
        raise GraphError(f'ROS 2: {error}') from error
    finally:
        rclpy.try_shutdown()
