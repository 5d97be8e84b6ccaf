"""Curves that effects add to a lens's own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.optics.curves import ImageHeight, ViewpointShift, invert_height

_GRID = 4097  # angles at which a sum of curves is looked at for where it turns back


@dataclass(frozen=True)
class ChebyshevHeight:
    """A change of image height, px: x times a Chebyshev sum in x = theta / theta_max.

    Zero on the axis; the linear term (a change of focal length) is left out.
    """

    theta_max: float
    values: tuple[float, ...]

    def columns(self, theta: Array) -> Array:
        """Derivatives (..., K) by the values."""
        x = theta / self.theta_max
        basis = np.polynomial.chebyshev.chebvander(2 * x * x - 1, len(self.values))
        # T_k(2x^2 - 1) x, less its value at the axis times x: odd in x and without a linear term.
        signs = (-1.0) ** np.arange(1, len(self.values) + 1)
        return np.asarray((basis[..., 1:] - signs) * x[..., None] / 2)

    def value_and_slope(self, theta: Array) -> tuple[Array, Array]:
        """Return the change and its derivative by theta, px and px/rad."""
        x = theta / self.theta_max
        z = 2 * x * x - 1
        signs = (-1.0) ** np.arange(1, len(self.values) + 1)
        series = np.concatenate([[-float(np.dot(signs, self.values))], self.values])
        inner = np.polynomial.chebyshev.chebval(z, series)
        slope = np.polynomial.chebyshev.chebval(z, np.polynomial.chebyshev.chebder(series))
        return x * inner / 2, (inner + 4 * x * x * slope) / (2 * self.theta_max)


@dataclass(frozen=True)
class SumOfHeights:
    """The image height of a lens, plus changes in px over its focal length."""

    base: ImageHeight
    focal: float
    changes: tuple[ChebyshevHeight, ...]

    @property
    def coefficient_names(self) -> tuple[str, ...]:
        return self.base.coefficient_names

    @property
    def coefficients(self) -> tuple[float, ...]:
        return self.base.coefficients

    @cached_property
    def limit(self) -> float:
        """The incidence angle, rad, up to which the sum grows: changes may turn it back early."""
        theta = np.linspace(0.0, self.base.limit, _GRID)
        falls = self.value_and_slope(theta)[1][:-1] <= 0
        return float(theta[max(int(np.argmax(falls)) - 1, 0)]) if falls.any() else self.base.limit

    def value_and_slope(self, theta: Array) -> tuple[Array, Array]:
        height, slope = self.base.value_and_slope(theta)
        for change in self.changes:
            more, steeper = change.value_and_slope(theta)
            height, slope = height + more / self.focal, slope + steeper / self.focal
        return height, slope

    def angle(self, height: Array) -> Array:
        return invert_height(self, height)

    def columns(self, theta: Array) -> Array:
        return self.base.columns(theta)


@dataclass(frozen=True)
class SumOfShifts:
    """The viewpoint shift of a lens (or none), plus others."""

    base: ViewpointShift | None
    changes: Sequence[ViewpointShift]
    limit: ClassVar[float] = np.pi

    @property
    def coefficient_names(self) -> tuple[str, ...]:
        return self.base.coefficient_names if self.base else ()

    @property
    def coefficients(self) -> tuple[float, ...]:
        return self.base.coefficients if self.base else ()

    def value_and_slope(self, theta: Array, half_tan: Array) -> tuple[Array, Array]:
        parts = [self.base, *self.changes] if self.base else list(self.changes)
        both = [part.value_and_slope(theta, half_tan) for part in parts]
        shift = np.sum([value for value, _ in both], axis=0)
        return np.asarray(shift), np.asarray(np.sum([slope for _, slope in both], axis=0))

    def columns(self, theta: Array) -> Array:
        return self.base.columns(theta) if self.base else np.empty((*np.shape(theta), 0))
