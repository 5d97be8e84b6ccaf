"""`fisheye-svp run`: one node, on ROS 2 or, where that is not installed, standalone."""

from __future__ import annotations

import argparse

from fisheye_svp_ros.errors import StandaloneError
from fisheye_svp_ros.nodes import NODES, executables


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument('node', choices=NODES, metavar='NODE', help=', '.join(NODES))
    parser.add_argument(
        'arguments', nargs=argparse.REMAINDER, metavar='--ros-args ...',
        help='as for `ros2 run`: -p NAME:=VALUE, --params-file FILE, -r FROM:=TO, '
        '-r __ns:=/NAMESPACE'
    )


def run(args: argparse.Namespace) -> None:
    """Spin the node until it ends; exit with its status."""
    with executables.ending_quietly():
        supply_rclpy()
    raise SystemExit(executables.run(args.node, args.arguments))


def supply_rclpy() -> None:
    """Make rclpy importable; raise StandaloneError where neither ROS 2 nor Cyclone DDS is."""
    from fisheye_svp_ros import standalone

    try:
        standalone.install()
    except ModuleNotFoundError as cause:
        raise StandaloneError(
            f'neither ROS 2 nor {cause.name} is installed; source ROS 2, or install the extra '
            '`standalone` of this package'
        ) from cause
