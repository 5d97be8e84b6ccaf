"""How nodes run as a process: from its arguments to its exit status."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import rclpy
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from fisheye_svp_ros.errors import FisheyeSvpError
from fisheye_svp_ros.nodes.base import BaseNode, NodeExit, NodeFailure
from fisheye_svp_ros.nodes.session import RCLError, SignalHandler


def run(kinds: Sequence[type[BaseNode]], args: list[str] | None = None) -> int:
    """Spin nodes in one executor until one of them ends; return the exit status.

    It is 2 for unusable arguments.
    """
    signals = SignalHandler()
    try:
        try:
            rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
            executor = SingleThreadedExecutor()
        except Exception as error:
            return _refuse(kinds, f'ROS arguments or environment: {error}')
        return _run(kinds, executor, signals)
    finally:
        signals.restore()


def _run(
    kinds: Sequence[type[BaseNode]], executor: SingleThreadedExecutor, signals: SignalHandler
) -> int:
    nodes: list[BaseNode] = []
    try:
        signals.begin()
        for kind in kinds:
            nodes.append(kind())
            executor.add_node(nodes[-1])
        signals.spin()
        _spin(executor, nodes[0])
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except NodeFailure as error:
        return _refuse(kinds, error)
    except NodeExit:
        pass
    except (FisheyeSvpError, ParameterException, NameValidationException) as error:
        return _refuse(kinds[len(nodes) :][:1] or kinds, error)
    except Exception as error:
        # A signal ends the context between any two calls; what fails then is no failure.
        if rclpy.ok():
            if not nodes and isinstance(error, RCLError):  # such as security that it lacks
                return _refuse(kinds, f'ROS 2: {error}')
            raise
    finally:
        signals.end()
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


def _spin(executor: SingleThreadedExecutor, first: BaseNode) -> None:
    while rclpy.ok():
        try:
            executor.spin()
        except (ExternalShutdownException, NodeExit):
            raise
        except Exception as error:  # of the client library, about what came over the wire
            first.unforeseen(error)


def _refuse(kinds: Sequence[type[BaseNode]], error: Exception | str) -> int:
    names = ', '.join(kind.NAME for kind in kinds)
    print(f'{names}: {" ".join(str(error).split())}', file=sys.stderr)
    return 2
