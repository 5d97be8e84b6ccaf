"""Colors and levels of pictures."""

from __future__ import annotations

import numpy as np

from fisheye_svp_ros.arrays import Array

OURS, PUBLISHED, FAINT = '#1f5fa8', '#e07b28', '#b8bfc7'
INK = '#334155'
_LEVELS = 9  # of a map, at most


def round_number(value: float) -> float:
    """Return the largest of 1, 2, 5, 10, 20 ... that is not above a value."""
    power = 10.0 ** np.floor(np.log10(max(value, 1e-12)))
    return float(max((m * power for m in (1, 2, 5) if m * power <= value), default=power))


def error_levels(sd: Array) -> list[float]:
    """Return 1, 2, 5, 10 ... from what is least on; what lies beyond them has one color."""
    low, high = np.nanquantile(sd, (0.02, 0.98))
    first = np.floor(np.log10(max(low, 1e-6)))
    steps = [m * 10.0 ** (first + power) for power in range(12) for m in (1, 2, 5)]
    start = max(i for i, step in enumerate(steps) if step <= max(low, steps[0]))
    stop = next(i for i, step in enumerate(steps) if step >= high)
    return steps[start : max(stop, start + 1) + 1][:_LEVELS]
