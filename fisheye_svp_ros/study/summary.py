"""The summary of a metric over the sets of a sweep."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array


class Summary(NamedTuple):
    """Statistics of the finite values of a metric; NaN where there is none.

    solved, missing: counts of finite values and of others; largest: of the magnitudes.
    """

    solved: int
    missing: int
    median: float
    mean: float
    largest: float


def summarize(values: Array) -> Summary:
    """Return the summary of values (N,), NaN = missing."""
    solved = values[np.isfinite(values)]
    missing = len(values) - len(solved)
    if not len(solved):
        return Summary(0, missing, np.nan, np.nan, np.nan)
    statistics = np.median(solved), solved.mean(), np.abs(solved).max()
    return Summary(len(solved), missing, *map(float, statistics))
