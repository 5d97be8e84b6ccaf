"""What the executables of the package call: a node by its name.

It loads a node only when it is run, so that a signal while that takes place ends it quietly.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from itertools import takewhile
from typing import TYPE_CHECKING

from fisheye_svp_ros import __version__
from fisheye_svp_ros.io.streams import tolerant_streams
from fisheye_svp_ros.nodes import NODES
from fisheye_svp_ros.process import draw_to_files, set_thread_count

if TYPE_CHECKING:
    from fisheye_svp_ros.io.parameters import Row
    from fisheye_svp_ros.nodes.base import BaseNode

# Packages that rclpy does not bring along.
_MESSAGES = ('diagnostic_msgs', 'geometry_msgs', 'sensor_msgs', 'std_srvs', 'visualization_msgs')

set_thread_count()  # other nodes use the other cores
draw_to_files()


def missing_rclpy() -> str:
    """Return why rclpy, or messages of the nodes, cannot be imported; empty where they can."""
    try:
        import rclpy.node  # noqa: F401 - it loads the C library, too

        for package in _MESSAGES:
            import_module(package)
    except ImportError as error:
        # Of a C library that was built for another Python, the first line says enough.
        return str(error).partition('\n')[0]
    return ''


def ros_needed(reason: str) -> str:
    """Return how to get what nodes need; reason: why it cannot be imported."""
    version = '.'.join(map(str, sys.version_info[:2]))
    return (
        f'nodes need ROS 2, which Python {version} does not have ({reason}). Source ROS 2 Jazzy '
        '(Ubuntu 24.04: apt install ros-jazzy-ros-base). On x86-64 Linux with Python 3.11 to '
        '3.14, you can instead install the extra `ros` of this package'
    )


@contextmanager
def ending_quietly() -> Iterator[None]:
    """End the process at once on SIGINT or SIGTERM: while modules load, nothing is to be saved."""
    before = {
        number: signal.signal(number, lambda *_: os._exit(0))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def run(*names: str, args: list[str] | None = None) -> int:
    """Run nodes in one process until one ends; return the exit status.

    args: as for rclpy.init().
    """
    with ending_quietly():
        kinds = [_node_class(name) for name in names]
        from fisheye_svp_ros.nodes import running
    return running.run(kinds, args)


def parameters(name: str) -> list[Row]:
    """Return the parameters of a node, its own before those of every node; rclpy must be there."""
    from fisheye_svp_ros.io.parameters import rows

    return sorted(
        rows(_node_class(name).SETTINGS), key=lambda row: row.name == 'wait_for_subscribers'
    )


def _node_class(name: str) -> type[BaseNode]:
    module = import_module(f'fisheye_svp_ros.nodes.{name}')
    kind: type[BaseNode] = getattr(module, name.title().replace('_', ''))
    return kind


def print_parameters(name: str) -> None:
    """Print the table of a node's parameters; rclpy must be there."""
    from fisheye_svp_ros.reporting.terminal import print_table

    def meaning(row: Row) -> str:
        unit, allowed = row.unit and f' [{row.unit}]', row.constraint()
        return row.description + unit + (allowed and f' ({allowed})')

    print_table(
        f'{name}: parameters, as in --ros-args -p NAME:=VALUE',
        ('parameter', 'default', 'meaning'),
        [(row.name, json.dumps(row.default), meaning(row)) for row in parameters(name)],
        words=('default', 'meaning'),
    )


def _main(name: str) -> int:
    """Run a node with the arguments of its executable, whether or not anybody reads its output."""
    with tolerant_streams():
        return _run_executable(name)


def _run_executable(name: str) -> int:
    """Run a node; refuse or answer the arguments that nodes commonly overlook."""
    words = sys.argv[1:]
    misplaced = [word for word in takewhile('--ros-args'.__ne__, words) if word.startswith('-')]
    if '--version' in words:
        print(f'{name} {__version__}')
        return 0
    with ending_quietly():
        reason = missing_rclpy()
    if reason:
        print(f'{name}: {ros_needed(reason)}', file=sys.stderr)
        return 2
    if {'-h', '--help'} & {*words}:
        with ending_quietly():
            print_parameters(name)
    elif misplaced:
        print(
            f'{name}: {misplaced[0]!r} comes before --ros-args; ROS arguments follow it: {name} '
            '--ros-args ...',
            file=sys.stderr,
        )
        return 2
    else:
        return run(name)
    return 0


def __getattr__(name: str) -> Callable[..., int]:
    if name not in NODES:
        raise AttributeError(f'no node is called {name!r}')
    return partial(_main, name)
