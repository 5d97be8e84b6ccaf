"""What a column of numbers says at a glance."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array


class Summary(NamedTuple):
    """Of the finite ones among some values; NaN where there is none."""

    solved: int
    missing: int
    median: float
    mean: float
    largest: float


def summarise(values: Array) -> Summary:
    """Return the summary of values (N,), NaN = missing; the largest is that of the magnitudes."""
    known = values[np.isfinite(values)]
    missing = len(values) - len(known)
    if not len(known):
        return Summary(0, missing, np.nan, np.nan, np.nan)
    largest = np.abs(known).max()
    return Summary(len(known), missing, *map(float, (np.median(known), known.mean(), largest)))
