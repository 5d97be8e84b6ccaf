"""Numerical derivatives to check analytic ones and to feed reference solvers."""

from __future__ import annotations

import numpy as np

_OFFSETS = (-4, -3, -2, -1, 1, 2, 3, 4)
_WEIGHTS = (1 / 280, -4 / 105, 1 / 5, -4 / 5, 4 / 5, -1 / 5, 4 / 105, -1 / 280)


def derivative(function, step):
    """Eighth-order central difference of function(change) at no change; step: scalar or array."""
    return sum(w * function(k * step) for k, w in zip(_OFFSETS, _WEIGHTS, strict=True)) / step


def jacobian(function, step=1e-5):
    """Return the Jacobian of function(x) as a function of x, by central differences."""

    def at(x):
        return np.stack(
            [
                (function(x + change) - function(x - change)) / (2 * step)
                for change in step * np.eye(len(x))
            ],
            axis=-1,
        )

    return at
