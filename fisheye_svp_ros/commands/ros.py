"""Whether there is a ROS 2 to run nodes on, and how to get one."""

from __future__ import annotations

import os
import sys

from fisheye_svp_ros.errors import GraphError

RANGE, LOCALHOST = 'ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST'
# Of a ROS 2 that is sourced, or of a user who has said how far its nodes are to be seen.
_ENVIRONMENT = {'ROS_DISTRO', RANGE, 'ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS'}
WAYS = (
    'source ROS 2 Jazzy (Ubuntu 24.04: apt install ros-jazzy-ros-base) or, on x86-64 Linux with '
    'Python 3.11 to 3.14, install the extra `ros` of this package'
)


def missing_rclpy() -> str:
    """Return why rclpy cannot be imported; empty where it can."""
    try:
        import rclpy.node  # noqa: F401 - it loads the C library, too
    except ImportError as error:
        # Of a C library that was built for another Python, the first line says enough.
        return str(error).partition('\n')[0]
    return ''


def prepare_ros() -> None:
    """Keep nodes on this machine where no environment of ROS says otherwise.

    Raises GraphError, with the ways to get it, where rclpy cannot be imported.
    """
    if reason := missing_rclpy():
        version = '.'.join(map(str, sys.version_info[:2]))
        raise GraphError(f'nodes need ROS 2, which Python {version} does not have ({reason}); '
                         f'{WAYS}')
    if not _ENVIRONMENT & os.environ.keys():
        os.environ[RANGE] = LOCALHOST
