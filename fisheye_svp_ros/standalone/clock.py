"""Time as nodes see it: `rclpy.time`, `rclpy.duration` and `rclpy.clock` in one."""

from __future__ import annotations

import time
from enum import IntEnum
from functools import total_ordering
from typing import Any

from fisheye_svp_ros.standalone.messages import message_class

_NS = 10**9


class ClockType(IntEnum):
    """Which clock a time was read from."""

    ROS_TIME = 1
    SYSTEM_TIME = 2
    STEADY_TIME = 3


class Duration:
    """A span of time, kept in nanoseconds."""

    def __init__(self, *, seconds: float = 0, nanoseconds: int = 0) -> None:
        self.nanoseconds = int(seconds * _NS) + int(nanoseconds)

    def to_msg(self) -> Any:
        """Return a builtin_interfaces/Duration."""
        sec, nanosec = divmod(self.nanoseconds, _NS)
        return message_class('builtin_interfaces/msg/Duration')(sec=sec, nanosec=nanosec)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Duration) and self.nanoseconds == other.nanoseconds

    def __repr__(self) -> str:
        return f'Duration(nanoseconds={self.nanoseconds})'


@total_ordering
class Time:
    """A point in time, kept in nanoseconds since the epoch of its clock."""

    def __init__(
        self,
        *,
        seconds: float = 0,
        nanoseconds: int = 0,
        clock_type: ClockType = ClockType.SYSTEM_TIME,
    ) -> None:
        self.nanoseconds = int(seconds * _NS) + int(nanoseconds)
        self.clock_type = clock_type
        if self.nanoseconds < 0:
            raise ValueError('a time must not be negative')

    @classmethod
    def from_msg(cls, msg: Any, clock_type: ClockType = ClockType.ROS_TIME) -> Time:
        """Read a builtin_interfaces/Time."""
        return cls(seconds=msg.sec, nanoseconds=msg.nanosec, clock_type=clock_type)

    def to_msg(self) -> Any:
        """Return a builtin_interfaces/Time."""
        sec, nanosec = divmod(self.nanoseconds, _NS)
        return message_class('builtin_interfaces/msg/Time')(sec=sec, nanosec=nanosec)

    def seconds_nanoseconds(self) -> tuple[int, int]:
        """Return whole seconds and the remaining nanoseconds."""
        return divmod(self.nanoseconds, _NS)

    def __add__(self, other: object) -> Time:
        if not isinstance(other, Duration):
            return NotImplemented
        total = self.nanoseconds + other.nanoseconds
        return Time(nanoseconds=total, clock_type=self.clock_type)

    def __sub__(self, other: Any) -> Any:
        if isinstance(other, Time):
            self._same_clock(other)
            return Duration(nanoseconds=self.nanoseconds - other.nanoseconds)
        return self + Duration(nanoseconds=-other.nanoseconds)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Time) and self._same_clock(other) == other.nanoseconds

    def __lt__(self, other: object) -> bool:
        if not isinstance(other, Time):
            return NotImplemented
        return self._same_clock(other) < other.nanoseconds

    def __repr__(self) -> str:
        return f'Time(nanoseconds={self.nanoseconds}, clock_type={self.clock_type.name})'

    def _same_clock(self, other: Time) -> int:
        if self.clock_type != other.clock_type:
            raise TypeError("Can't compare times with different clock types")
        return self.nanoseconds


class Clock:
    """A source of time; without simulated time, ROS time is the time of the system."""

    def __init__(self, *, clock_type: ClockType = ClockType.SYSTEM_TIME) -> None:
        self.clock_type = clock_type

    def now(self) -> Time:
        """Return the current time of this clock."""
        steady = self.clock_type == ClockType.STEADY_TIME
        nanoseconds = time.monotonic_ns() if steady else time.time_ns()
        return Time(nanoseconds=nanoseconds, clock_type=self.clock_type)
