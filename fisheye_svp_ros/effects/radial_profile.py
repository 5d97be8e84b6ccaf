"""The image-height curve differs from the one assumed."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Self

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Effect, Parameter, Scene
from fisheye_svp_ros.optics.lens import Lens

_MAX_TERMS = 8  # polynomials


@dataclass(frozen=True)
class RadialProfileEffect(Effect):
    """A smooth change of h(theta), px, as sums of Chebyshev polynomials of theta / theta_max.

    first: of the polynomials; those before it do what the lens's own coefficients do.
    """

    terms: int = 2
    theta_max: float = field(default=1.5707963, metadata={'key': False})
    first: int = field(default=1, metadata={'key': False})

    name = 'radial_profile'
    stage = 'ray'
    signature = 'residuals along the radius that depend on the angle alone, not on the range'
    to_separate = 'views of the same angles at clearly different ranges'

    @classmethod
    def candidates(cls, scene: Scene) -> Sequence[Effect]:
        own, limit = len(scene.lens.image_height.coefficient_names), round(scene.theta_max, 6)
        finest = cls(_MAX_TERMS, limit, own % _MAX_TERMS + 1)
        return [*(cls(terms, limit) for terms in (1, 2, 4)), finest]

    def merge_with(self, other: Self) -> Effect:
        return replace(other, terms=max(self.terms, other.terms),
                       first=min(self.first, other.first))

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(f'h{i}', 'px', 10.0) for i in range(self.first, self.terms + 1))

    def columns(self, scene: Scene) -> Array:
        height = ChebyshevHeight(self.theta_max, (0.0,) * self.terms).columns(scene.theta)
        height = height[..., self.first - 1 :]
        return np.stack([np.zeros_like(height), height], axis=-2)

    def with_curves(self, lens: Lens, values: Array) -> Lens:
        every = np.concatenate([np.zeros(self.first - 1), values])
        change = ChebyshevHeight(self.theta_max, tuple((every / lens.focal).tolist()))
        return replace(lens, image_height=lens.image_height.plus(change))

    def rescale_values(self, values: Array, ratio: float) -> Array:
        return values * ratio


@dataclass(frozen=True)
class ChebyshevHeight:
    """A change of image height h/f: x times a Chebyshev sum in x = theta / theta_max.

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
        """Return the change and its derivative by theta."""
        x, series = theta / self.theta_max, self._series()
        z = 2 * x * x - 1
        inner = np.polynomial.chebyshev.chebval(z, series)
        slope = np.polynomial.chebyshev.chebval(z, np.polynomial.chebyshev.chebder(series))
        return x * inner / 2, (inner + 4 * x * x * slope) / (2 * self.theta_max)

    @property
    def powers(self) -> tuple[float, ...]:
        """Factors of theta^3, theta^5, ... of the same polynomial."""
        inner = self._series() @ _shifted_chebyshev(len(self.values) + 1)
        scaled = zip(inner[1:].tolist(), itertools.count(3, 2), strict=False)
        return tuple(factor / (2 * self.theta_max**power) for factor, power in scaled)

    def _series(self) -> Array:
        signs = (-1.0) ** np.arange(1, len(self.values) + 1)
        return np.concatenate([[-float(np.dot(signs, self.values))], self.values])


@cache
def _shifted_chebyshev(count: int) -> Array:
    """Return the factors (count, count) of 1, s, s^2 ... in T_0(2s - 1), T_1(2s - 1) ..."""
    found, z = np.zeros((count, count)), np.polynomial.Polynomial([-1.0, 2.0])
    for order in range(count):
        found[order, : order + 1] = np.polynomial.Chebyshev.basis(order)(z).coef
    return found
