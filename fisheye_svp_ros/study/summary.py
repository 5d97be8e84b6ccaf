"""The summary of a metric in the memory of one block, however many values there are."""

from __future__ import annotations

from collections.abc import Iterator
from typing import IO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fisheye_svp_ros.arrays import Array

_BLOCK = 1 << 16  # values that are held at once
_DIGIT = 16  # bits of a value that one reading of all of them finds
_SIGN = np.uint64(1 << 63)


class Summary(NamedTuple):
    """Of the finite ones among some values; NaN where there is none.

    largest: of the magnitudes.
    """

    solved: int
    missing: int
    median: float
    mean: float
    largest: float


class StoredMetric:
    """The values of a metric, the finite ones in a file.

    file: empty, binary, to write and to read; 8 bytes a value.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._solved = self._missing = 0
        self._largest = np.nan

    def add(self, values: Array) -> None:
        """Take further values (N,), NaN = missing; raise OSError where the disk is full."""
        known = values[np.isfinite(values)]
        self._file.seek(8 * self._solved)
        self._file.write(known.tobytes())
        self._solved += len(known)
        self._missing += len(values) - len(known)
        self._largest = float(np.fmax.reduce(np.abs(known), initial=self._largest))

    def summarize(self) -> Summary:
        """Return the summary of all values, to the bit as NumPy has it of an array of them."""
        count = self._solved
        if not count:
            return Summary(0, self._missing, np.nan, np.nan, np.nan)
        middle = [self._ranked(rank) for rank in {(count - 1) // 2, count // 2}]
        median, mean = float(np.mean(middle)), self._sum(0, count) / count
        return Summary(count, self._missing, median, mean, self._largest)

    def _read(self, first: int, count: int) -> Array:
        self._file.seek(8 * first)
        return np.frombuffer(self._file.read(8 * count))

    def _blocks(self) -> Iterator[Array]:
        for first in range(0, self._solved, _BLOCK):
            yield self._read(first, min(_BLOCK, self._solved - first))

    def _sum(self, first: int, count: int) -> float:
        """Return the sum of some values, halved where NumPy halves: to the same bit."""
        if count <= _BLOCK:
            return float(self._read(first, count).sum())
        half = count // 2 // 8 * 8
        return self._sum(first, half) + self._sum(first + half, count - half)

    def _ranked(self, rank: int) -> float:
        """Return the value of a rank, from 0: digit by digit of its key, the highest first."""
        prefix = 0
        for shift in range(64 - _DIGIT, -1, -_DIGIT):
            counts = np.zeros(1 << _DIGIT, dtype=np.int64)
            for block in self._blocks():
                keys = _keys(block) >> np.uint64(shift)
                alike = keys[keys >> np.uint64(_DIGIT) == np.uint64(prefix)]
                digits = (alike & np.uint64(len(counts) - 1)).astype(np.int64)
                counts += np.bincount(digits, minlength=len(counts))
            ends = np.cumsum(counts)
            digit = int(np.searchsorted(ends, rank, side='right'))
            rank -= int(ends[digit] - counts[digit])
            prefix = prefix << _DIGIT | digit
        return _value(prefix)


def _keys(values: Array) -> NDArray[np.uint64]:
    """Return whole numbers (N,) that sort as values (N,): of negative ones all bits flip."""
    bits = values.view(np.uint64)
    return np.where(bits & _SIGN, ~bits, bits | _SIGN)


def _value(key: int) -> float:
    """Return the value of a key."""
    bits = np.uint64(key)
    return float((bits & ~_SIGN if bits & _SIGN else ~bits).view(np.float64))
