"""Time as nodes see it: `rclpy.clock`, and the times that it gives."""

from __future__ import annotations

import time
from enum import IntEnum
from typing import Any, NamedTuple

from fisheye_svp_ros.standalone.messages import message_class


class ClockType(IntEnum):
    """Which clock a time was read from."""

    ROS_TIME = 1
    SYSTEM_TIME = 2
    STEADY_TIME = 3


class Time(NamedTuple):
    """A point in time, nanoseconds since the epoch of its clock."""

    nanoseconds: int

    def to_msg(self) -> Any:
        """Return a builtin_interfaces/Time."""
        sec, nanosec = divmod(self.nanoseconds, 10**9)
        return message_class('builtin_interfaces/msg/Time')(sec=sec, nanosec=nanosec)


class Clock:
    """A source of time; without simulated time, ROS time is the time of the system."""

    def __init__(self, *, clock_type: ClockType = ClockType.SYSTEM_TIME) -> None:
        self.clock_type = clock_type

    def now(self) -> Time:
        """Return the current time of this clock."""
        steady = self.clock_type == ClockType.STEADY_TIME
        return Time(time.monotonic_ns() if steady else time.time_ns())
