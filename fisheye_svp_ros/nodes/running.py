"""How nodes run as a process: from its arguments to its exit status."""

from __future__ import annotations

import math
import signal
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import rclpy
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor

from fisheye_svp_ros.errors import FisheyeSvpError
from fisheye_svp_ros.nodes.base import BaseNode, NodeExit, NodeFailure
from fisheye_svp_ros.nodes.session import RCLError

_SAME_INTERRUPT = 1.0  # s between two interrupts that are one


def run(kinds: Sequence[type[BaseNode]], args: list[str] | None = None) -> int:
    """Spin nodes in one executor until one of them ends; return the exit status.

    It is 2 for unusable arguments.
    """
    signal.signal(signal.SIGINT, _interrupting_without_echo())
    try:
        try:
            rclpy.init(args=args)
        except Exception as error:
            return _refuse(kinds, f'ROS arguments or environment: {error}')
        return _run(kinds)
    except KeyboardInterrupt:
        return 0


def _interrupting_without_echo() -> Callable[..., None]:
    """Return a handler: below `ros2 launch` Ctrl-C comes twice, from the terminal and from launch.

    The second one would end what the first one has begun to put away.  A later one counts again:
    the first is lost where C code calls Python and drops its exceptions.
    """
    last = -math.inf

    def interrupt(*_: Any) -> None:
        nonlocal last
        before, last = last, time.monotonic()
        if last - before > _SAME_INTERRUPT:
            raise KeyboardInterrupt

    return interrupt


def _run(kinds: Sequence[type[BaseNode]]) -> int:
    nodes: list[BaseNode] = []
    try:
        for kind in kinds:
            nodes.append(kind())
        _spin(nodes)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except NodeFailure as error:
        return _refuse(kinds, error)
    except NodeExit:
        pass
    except (FisheyeSvpError, ParameterException, NameValidationException) as error:
        return _refuse(kinds[len(nodes):][:1] or kinds, error)
    except Exception as error:
        # A signal ends the context between any two calls; what fails then is no failure.
        if rclpy.ok():
            if not nodes and isinstance(error, RCLError):  # such as security that it lacks
                return _refuse(kinds, f'ROS 2: {error}')
            raise
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


def _spin(nodes: Sequence[BaseNode]) -> None:
    executor = SingleThreadedExecutor()
    for node in nodes:
        executor.add_node(node)
    while rclpy.ok():
        try:
            executor.spin()
        except (ExternalShutdownException, NodeExit):
            raise
        except Exception as error:  # of the client library, about what came over the wire
            nodes[0].unforeseen(error)


def _refuse(kinds: Sequence[type[BaseNode]], error: Exception | str) -> int:
    names = ', '.join(kind.NAME for kind in kinds)
    print(f'{names}: {" ".join(str(error).split())}', file=sys.stderr)
    return 2
