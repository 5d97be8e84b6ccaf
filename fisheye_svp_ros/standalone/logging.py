"""Loggers that write to stderr in the format of ROS 2 and to /rosout: `rclpy.logging`."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from enum import IntEnum
from functools import partialmethod


class LoggingSeverity(IntEnum):
    """Severities, in the numbering of rcl_interfaces/Log."""

    UNSET = 0
    DEBUG = 10
    INFO = 20
    WARN = 30
    ERROR = 40
    FATAL = 50


Sink = Callable[[int, int, str, str], None]

_levels: dict[str, LoggingSeverity] = {'': LoggingSeverity.INFO}
_sinks: dict[str, Sink] = {}


class Logger:
    """Writes messages of a node; `throttle_duration_sec` and `once` filter them.

    Loggers of one name share their level.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._calls: dict[tuple[str, int], float] = {}

    def _log(self, severity: LoggingSeverity, message: str, **filters: float) -> bool:
        """Write a message of a severity; False if it was filtered out."""
        name = self.name
        while name and not _levels.get(name):  # the severity set for the nearest one above it
            name = name.rpartition('.')[0]
        if severity < _levels[name] or (filters and not self._passes(**filters)):
            return False
        stamp = time.time_ns()
        seconds, rest = divmod(stamp, 10**9)
        line = f'[{severity.name}] [{seconds}.{rest:09d}] [{self.name}]: {message}\n'
        sys.stderr.write(line)
        sys.stderr.flush()
        if sink := _sinks.get(self.name):
            sink(stamp, severity, self.name, message)
        return True

    debug = partialmethod(_log, LoggingSeverity.DEBUG)
    info = partialmethod(_log, LoggingSeverity.INFO)
    warning = warn = partialmethod(_log, LoggingSeverity.WARN)
    error = partialmethod(_log, LoggingSeverity.ERROR)
    fatal = partialmethod(_log, LoggingSeverity.FATAL)

    def _passes(self, *, throttle_duration_sec: float = 0, once: float = False) -> bool:
        frame = sys._getframe(2)  # filters count per line of code, so find the caller's
        call = (frame.f_code.co_filename, frame.f_lineno)
        last, now = self._calls.get(call), time.monotonic()
        if last is not None and (once or now < last + throttle_duration_sec):
            return False
        self._calls[call] = now
        return True


def set_logger_level(name: str, level: int) -> None:
    """Set the severity below which a logger writes nothing; an empty name is the default."""
    _levels[name] = LoggingSeverity(level)


def attach_sink(name: str, sink: Sink | None) -> None:
    """Send what a logger writes to a function as well: stamp in ns, severity, name, message."""
    if sink:
        _sinks[name] = sink
    else:
        _sinks.pop(name, None)
