"""Interleaved repeats of things that do the same work, their medians and their ratios."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import numpy as np

OURS = 'fisheye-svp'
_SHORTEST = 0.02  # s; within a turn, shorter calls are repeated


class NotHereError(Exception):
    """A peer cannot be had on this machine."""


@dataclass(frozen=True)
class Side:
    """One thing that does the work of a row.

    run: one repeat, returns its answer; work: units of work in it; seconds: reads the time that a
    repeat took from its answer, where it measures itself; error: how far the answer is from the
    common one, None where there is nothing to compare; note: what a reader must know.
    """

    name: str
    run: Callable[[], Any]
    work: float = 1.0
    error: Callable[[Any], float] | None = None
    seconds: Callable[[Any], float] | None = None
    note: str = ''


@dataclass(frozen=True)
class Timing:
    """name; seconds a unit of work in every repeat; error of the answer."""

    name: str
    seconds: tuple[float, ...]
    error: float | None = None
    note: str = ''

    @property
    def median(self) -> float:
        """Median seconds a unit of work."""
        return self.quartiles[1]

    @property
    def quartiles(self) -> tuple[float, float, float]:
        """Quartiles of the seconds a unit of work."""
        low, middle, high = np.percentile(self.seconds, (25, 50, 75))
        return float(low), float(middle), float(high)


@dataclass(frozen=True)
class Goal:
    """`ours` should need at most 1 / `ratio` of the time of `peer`."""

    ours: str
    peer: str
    ratio: float


@dataclass(frozen=True)
class Row:
    """A row of the report: who did the work in what time, who could not take part, what to reach.

    unit: 'ns a point', say, which is `scale` of a second; error_unit: of the timings' errors.
    """

    title: str
    unit: str
    scale: float
    timings: Sequence[Timing]
    error_unit: str = 'm'
    left_out: dict[str, str] = field(default_factory=dict)
    goals: Sequence[Goal] = ()
    text: str = ''

    def timing(self, name: str) -> Timing | None:
        """Return what was measured under a name."""
        return next((timing for timing in self.timings if timing.name == name), None)

    def ratio(self, ours: str, peer: str) -> float | None:
        """Return how many times faster `ours` is than `peer`, if both took part."""
        own, other = self.timing(ours), self.timing(peer)
        return None if own is None or other is None else other.median / own.median


def require(*modules: str) -> None:
    """Raise NotHereError unless some modules of a peer are there."""
    for name in modules:
        try:
            import_module(name)
        except ImportError as reason:
            raise NotHereError(str(reason)) from reason


def available(makers: dict[str, Callable[[], Side]]) -> tuple[list[Side], dict[str, str]]:
    """Make sides; return also why some cannot take part."""
    sides, left_out = [], {}
    for name, make in makers.items():
        try:
            sides.append(make())
        except NotHereError as reason:
            left_out[name] = str(reason)
    return sides, left_out


def measure(sides: Sequence[Side], repeats: int) -> list[Timing]:
    """Time the sides in turns, so that a slow spell of the machine hits all of them alike."""
    answers = [side.run() for side in sides]  # the warm-up: compilations, caches, clock speed
    loops = [_loops(side) for side in sides]
    seconds: list[list[float]] = [[] for _ in sides]
    with _no_collection():
        for _ in range(repeats):
            for times, side, count in zip(seconds, sides, loops, strict=True):
                times.append(_time(side, count) / side.work)
                gc.collect()  # what one run leaves may be gigabytes
    return [
        Timing(side.name, tuple(times), side.error(answer) if side.error else None, side.note)
        for side, times, answer in zip(sides, seconds, answers, strict=True)
    ]


def exponent(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """Return the exponent b of cost ~ size^b, by least squares in the logarithms."""
    return float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])


def _loops(side: Side) -> int:
    if side.seconds is not None:
        return 1
    return max(1, round(_SHORTEST / max(_time(side, 1), 1e-9)))


def _time(side: Side, loops: int) -> float:
    # Processor time: what else runs on the machine counts little, and hidden threads count.
    start = time.process_time()
    for _ in range(loops):
        answer = side.run()
    if side.seconds is not None:
        return side.seconds(answer)
    return (time.process_time() - start) / loops


@contextmanager
def _no_collection() -> Iterator[None]:
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
