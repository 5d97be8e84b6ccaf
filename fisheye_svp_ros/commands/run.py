"""`fisheye-svp run`: one node, as `ros2 run` starts it, or several in one process."""

from __future__ import annotations

import argparse
from itertools import takewhile

from fisheye_svp_ros.commands.processes import prepare_ros
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.nodes import NODES, executables


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument('node', choices=NODES, metavar='NODE', help=', '.join(NODES))
    parser.add_argument(
        'arguments',
        nargs=argparse.REMAINDER,
        metavar='[NODE ...] --ros-args ...',
        help='more nodes for the same process, and then arguments as for `ros2 run`: -p '
        'NAME:=VALUE, --params-file FILE, -r FROM:=TO, -r __ns:=/NAMESPACE. --help lists '
        'the parameters of the nodes',
    )


def run(args: argparse.Namespace) -> None:
    """Spin nodes until one ends; exit with its status.  With --help, tell their parameters."""
    with executables.ending_quietly():
        prepare_ros()
    more = list(takewhile(NODES.__contains__, args.arguments))
    nodes, arguments = [args.node, *more], args.arguments[len(more) :]
    if {'-h', '--help'} & set(arguments):
        for node in nodes:
            executables.print_parameters(node)
        return
    first, names = next(iter(arguments), '--ros-args'), ' '.join(nodes)
    if first != '--ros-args':
        raise ParameterError(
            f'run {names}: {first!r} comes before --ros-args; ROS arguments '
            f'follow it: fisheye-svp run {names} --ros-args ...'
        )
    if len({*nodes}) < len(nodes):
        raise ParameterError(
            f'run {names}: a node is listed twice, and both would share their '
            'topics; start one process for each namespace'
        )
    raise SystemExit(executables.run(*nodes, args=arguments))
