"""`fisheye-svp run`: one node, on ROS 2 or, where that is not installed, standalone."""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING

from fisheye_svp_ros.errors import ParameterError, StandaloneError
from fisheye_svp_ros.nodes import NODES, executables

if TYPE_CHECKING:
    from fisheye_svp_ros.io.parameters import Row


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument('node', choices=NODES, metavar='NODE', help=', '.join(NODES))
    parser.add_argument(
        'arguments', nargs=argparse.REMAINDER, metavar='--ros-args ...',
        help='as for `ros2 run`: -p NAME:=VALUE, --params-file FILE, -r FROM:=TO, '
        '-r __ns:=/NAMESPACE; or --help: the parameters of the node'
    )


def run(args: argparse.Namespace) -> None:
    """Spin the node until it ends; exit with its status.  With --help, tell its parameters."""
    with executables.ending_quietly():
        supply_rclpy()
    if {'-h', '--help'} & set(args.arguments):
        _print_parameters(args.node)
        return
    first = next(iter(args.arguments), '--ros-args')
    if first != '--ros-args':
        raise ParameterError(f'run {args.node}: {first!r} stands before --ros-args; ROS arguments '
                             f'come after it: fisheye-svp run {args.node} --ros-args ...')
    raise SystemExit(executables.run(args.node, args.arguments))


def _print_parameters(node: str) -> None:
    from fisheye_svp_ros.reporting.tables import print_table

    def meaning(row: Row) -> str:
        unit, allowed = row.unit and f' [{row.unit}]', row.constraint()
        return row.description + unit + (allowed and f' ({allowed})')

    table = executables.parameters(node)
    print_table(
        f'{node}: parameters, as in --ros-args -p NAME:=VALUE',
        ('parameter', 'default', 'meaning'),
        [(row.name, json.dumps(row.default), meaning(row)) for row in table],
        words=('default', 'meaning'),
    )


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
