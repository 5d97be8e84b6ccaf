"""Timers: of real time if nothing else is asked for, since simulated time may stand still."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.clock import Clock, ClockType


def start_timer(
    node: Any, period: float, callback: Callable[[], object], clock: Any = None
) -> Any:
    """Have a node call a function every `period` seconds, of real time where no clock is given."""
    clock = clock or Clock(clock_type=ClockType.STEADY_TIME)
    return node.create_timer(period, callback, clock=clock)
