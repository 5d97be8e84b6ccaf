"""What a process of nodes stands on: ROS 2 from its start to its end, signals, timers."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.signals import SignalHandlerOptions, install_signal_handlers

from fisheye_svp_ros.errors import GraphError

RCLError: type[Exception] = rclpy_implementation.RCLError

_SAME_INTERRUPT = 1.0  # s between two interrupts that are one
_NUMBERS = signal.SIGINT, signal.SIGTERM


class SignalHandler:
    """Raises KeyboardInterrupt while nodes are built; once they spin, rclpy deals with SIGTERM.

    rclpy ends the context between any two calls of the node that is being built, and what comes
    next then fails in a way of its own.  So it gets its handlers when there is an executor to end.

    Below `ros2 launch` Ctrl-C comes twice, from the terminal and from launch, and the second one
    would end what the first one has begun to put away.  A later one counts again: the first is
    lost where C code calls Python and drops its exceptions.
    """

    def __init__(self) -> None:
        self.times: list[float] = []  # s, of the monotonic clock: when there was a signal
        self._raises = self._spinning = False
        self._last = -math.inf
        self._before = {number: signal.signal(number, self._handle) for number in _NUMBERS}

    def _handle(self, number: int, _: object) -> None:
        if number == signal.SIGTERM and self._spinning:
            return
        before, self._last = self._last, time.monotonic()
        if self._last - before > _SAME_INTERRUPT:
            self.times.append(self._last)
            if self._raises:
                raise KeyboardInterrupt

    def begin(self) -> None:
        """Raise KeyboardInterrupt on signals from now on, and if there was one already."""
        self._raises = True
        self._raise_pending()

    def collect(self) -> None:
        """Raise nothing from now on: `times` tells of signals."""
        self._raises = False

    def spin(self) -> None:
        """Let an executor be ended by signals; raise KeyboardInterrupt if there was one."""
        install_signal_handlers(SignalHandlerOptions.ALL)  # these call the ones above, too
        self._spinning = True
        self._raise_pending()

    def end(self) -> None:
        """Ignore signals from now on: everything is put away."""
        self._raises, self._spinning = False, True
        signal.signal(signal.SIGINT, signal.SIG_IGN)

    def restore(self) -> None:
        """Give signals back what they did before; one that is ignored at the end stays so."""
        for number, before in self._before.items():
            if signal.getsignal(number) == self._handle:
                signal.signal(number, before)

    def _raise_pending(self) -> None:
        if self.times:
            raise KeyboardInterrupt


@contextmanager
def ros_session(arguments: Sequence[str]) -> Iterator[SignalHandler]:
    """Start rclpy, and end it; arguments: as after `--ros-args`.

    Yields what deals with signals meanwhile, as it does for nodes.  Raises GraphError where
    arguments, environment or middleware allow no node.
    """
    signals = SignalHandler()
    try:
        try:
            rclpy.init(
                args=['--ros-args', *arguments], signal_handler_options=SignalHandlerOptions.NO
            )
        except Exception as error:  # of a kind of its own for each argument
            raise GraphError(f'ROS arguments or environment: {error}') from error
        yield signals
    except RCLError as error:
        raise GraphError(f'ROS 2: {error}') from error
    finally:
        rclpy.try_shutdown()
        signals.restore()


def start_timer(
    node: Any, period: float, callback: Callable[[], object], clock: Any = None
) -> Any:
    """Have a node call a function every `period` seconds, of real time where no clock is given.

    Simulated time may stand still.
    """
    clock = clock or Clock(clock_type=ClockType.STEADY_TIME)
    return node.create_timer(period, callback, clock=clock)
