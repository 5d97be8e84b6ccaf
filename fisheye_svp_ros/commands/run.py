"""`fisheye-svp run`: one node, as `ros2 run` starts it."""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING

from fisheye_svp_ros.commands.ros import prepare_ros
from fisheye_svp_ros.errors import ParameterError
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
        prepare_ros()
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
