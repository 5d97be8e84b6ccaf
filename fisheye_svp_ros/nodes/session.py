"""What a command that is a node of its own stands on: ROS 2 from its start to its end."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import rclpy
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.signals import SignalHandlerOptions

from fisheye_svp_ros.errors import GraphError
from fisheye_svp_ros.nodes.signals import SignalHandler

RCLError: type[Exception] = rclpy_implementation.RCLError


@contextmanager
def ros_session(arguments: Sequence[str]) -> Iterator[SignalHandler]:
    """Start rclpy, and end it; arguments: as after `--ros-args`.

    Yields what deals with signals meanwhile, as it does for nodes.  Raises GraphError where
    arguments, environment or middleware allow no node.
    """
    signals = SignalHandler()
    try:
        try:
            rclpy.init(args=['--ros-args', *arguments],
                       signal_handler_options=SignalHandlerOptions.NO)
        except Exception as error:  # of a kind of its own for each argument
            raise GraphError(f'ROS arguments or environment: {error}') from error
        yield signals
    except RCLError as error:
        raise GraphError(f'ROS 2: {error}') from error
    finally:
        rclpy.try_shutdown()
        signals.restore()
