"""The rules of Levenberg-Marquardt: damping and when it ends, of one system or of many.

Written so that NumPy runs them on arrays and Numba compiles them for single numbers.
Source: Marquardt's scaling with Nielsen's damping (IMM-REP-1999-05, section 3).
"""

from __future__ import annotations

import numpy as np

from fisheye_svp_ros.arrays import Array, Mask

MAX_ITERATIONS = 60
FIRST_DAMPING, FIRST_GROWTH = 1e-4, 2.0
STUCK = 1e12  # a damping with which no step leads anywhere
# A step that would move the whitened residuals by less than this (their 2-norm) is the last one;
# so is one after which, as steps shrink, the next would be that small beside the residuals.
STEP_TOLERANCE = 2e-9
_ROUNDING = 1e-13
# Whitened residuals are known to no better than this: image points of 1000 px have 13 digits.
_NOISE = 1e-11
_MIN_DIVISOR = 1e-300  # what is divided by in place of 0


def is_last(moved: Array, moved_before: Array, cost: Array, damping: Array) -> Mask:
    """Say whether a step is too small to matter, or the next would be.

    moved: |J d|^2 of the step and of the one accepted before; cost: before the step.
    """
    little = moved <= STEP_TOLERANCE**2 + _ROUNDING * cost
    little |= moved * moved <= STEP_TOLERANCE**2 * (1.0 + cost) * moved_before
    return little & (damping < 1.0)


def is_better(cost: Array, before: Array) -> Mask:
    """Say whether a step is accepted: it lowers the cost, as far as that is known."""
    return cost <= before * (1.0 + _ROUNDING) + _NOISE * np.sqrt(before)


def update_damping(
    damping: Array, growth: Array, better: Mask, gained: Array, moved: Array
) -> tuple[Array, Array]:
    """Return the next damping and its growth from what a step gained in cost, and |J d|^2."""
    # A step out of the domain gains minus infinity.
    ratio = np.minimum(np.maximum(gained / np.maximum(moved, _MIN_DIVISOR), -1.0), 2.0)
    shrunk = damping * np.minimum(np.maximum(1.0 - (2.0 * ratio - 1.0) ** 3, 0.1), 2.0)
    raised = np.maximum(damping, 1e-9) * growth
    accepted, refused = 1.0 * better, 1.0 - better  # factors, see `optics.formulas.half_angle`
    return (
        accepted * np.maximum(shrunk, 1e-15) + refused * raised,
        accepted * FIRST_GROWTH + refused * 2.0 * growth,
    )
