"""Lens curves: image height h(theta)/f and viewpoint shift s(theta), with their derivatives.

A new curve is one class here and one line in its registry.  All angles in rad, shifts in m.
Curves take arrays of any shape and return arrays of that shape.  A curve whose `formula` is in
`formulas` is faster: it need not start from theta alone, and it can be compiled.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.optics import formulas

# Of a height, (theta, *coefficients) or (sin, cos) -> value and slope; of a shift, (theta, sin,
# cos, *coefficients) -> value and slope times sin
Formula = Callable[..., tuple[Array, Array]]


class ImageHeight(Protocol):
    """An image-height curve for unit focal length; monotone from 0 up to `limit`."""

    @property
    def coefficient_names(self) -> tuple[str, ...]:
        """Names of the coefficients."""

    @property
    def coefficients(self) -> tuple[float, ...]:
        """Values of the coefficients, in the order of `coefficient_names`."""

    @property
    def limit(self) -> float:
        """Largest incidence angle up to which the height grows, rad."""

    def value_and_slope(self, theta: Array) -> tuple[Array, Array]:
        """Return h/f and its derivative with respect to theta, in arrays of their own."""

    def angle(self, height: Array) -> Array:
        """Return theta of heights h/f within the monotone range; anything beyond it."""

    def columns(self, theta: Array) -> Array:
        """Return the derivatives of h/f with respect to the coefficients, shape (..., K)."""


class ViewpointShift(Hashable, Protocol):
    """A viewpoint-shift curve s(theta), m."""

    @property
    def coefficient_names(self) -> tuple[str, ...]:
        """Names of the coefficients."""

    @property
    def coefficients(self) -> tuple[float, ...]:
        """Values of the coefficients, in the order of `coefficient_names`."""

    @property
    def limit(self) -> float:
        """Largest incidence angle at which a ray gets through, rad."""

    def value_and_slope(self, theta: Array, half_tan: Array) -> tuple[Array, Array]:
        """Return s and ds/dtheta; `half_tan` is tan(theta / 2), which the caller has at hand."""

    def columns(self, theta: Array) -> Array:
        """Return the derivatives of s with respect to the coefficients, shape (..., K)."""


class _Height:
    coefficient_names: ClassVar[tuple[str, ...]] = ()
    formula: ClassVar[Formula]

    @property
    def coefficients(self) -> tuple[float, ...]:
        return tuple(getattr(self, name) for name in self.coefficient_names)

    def value_and_slope(self, theta: Array) -> tuple[Array, Array]:
        return self.formula(theta, *self.coefficients)

    def columns(self, theta: Array) -> Array:
        return np.empty((*np.shape(theta), 0))


class Trigonometric(_Height):
    """An image height whose formula has sine and cosine of theta alone."""

    def value_and_slope(self, theta: Array) -> tuple[Array, Array]:
        """Do as `ImageHeight.value_and_slope` says."""
        return self.formula(np.sin(theta), np.cos(theta))


@dataclass(frozen=True)
class Orthographic(Trigonometric):
    """h = f sin(theta)."""

    limit: ClassVar[float] = np.pi / 2
    formula = staticmethod(formulas.orthographic)

    def angle(self, height: Array) -> Array:
        return np.arcsin(np.minimum(height, 1.0))


@dataclass(frozen=True)
class Equidistant(_Height):
    """h = f theta."""

    limit: ClassVar[float] = np.pi
    formula = staticmethod(formulas.equidistant)

    def angle(self, height: Array) -> Array:
        return height


@dataclass(frozen=True)
class Equisolid(Trigonometric):
    """h = 2 f sin(theta / 2)."""

    limit: ClassVar[float] = np.pi
    formula = staticmethod(formulas.equisolid)

    def angle(self, height: Array) -> Array:
        return 2 * np.arcsin(np.minimum(height / 2, 1.0))


@dataclass(frozen=True)
class Stereographic(Trigonometric):
    """h = 2 f tan(theta / 2)."""

    limit: ClassVar[float] = np.pi
    formula = staticmethod(formulas.stereographic)

    def angle(self, height: Array) -> Array:
        return 2 * np.arctan(height / 2)


@dataclass(frozen=True)
class KannalaBrandt(_Height):
    """h = f (theta + k1 theta^3 + k2 theta^5 + k3 theta^7 + k4 theta^9).

    Source: Kannala and Brandt, PAMI 2006, eq. 6, with the factor f taken out (OpenCV's fisheye).
    """

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    coefficient_names: ClassVar[tuple[str, ...]] = ('k1', 'k2', 'k3', 'k4')
    formula = staticmethod(formulas.kannala_brandt)

    @property
    def limit(self) -> float:
        # dh/dtheta is a polynomial in theta^2; its first positive root ends the monotone range.
        roots = np.roots([9 * self.k4, 7 * self.k3, 5 * self.k2, 3 * self.k1, 1.0])
        real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
        return float(min(np.sqrt(real.min()), np.pi)) if real.size else np.pi

    def angle(self, height: Array) -> Array:
        return invert_height(self, height)

    def columns(self, theta: Array) -> Array:
        z = theta * theta
        return theta[..., None] * z[..., None] ** np.arange(1, 5)


class _Shift:
    coefficient_names: ClassVar[tuple[str, ...]]
    formula: ClassVar[Formula]

    @property
    def coefficients(self) -> tuple[float, ...]:
        return tuple(getattr(self, name) for name in self.coefficient_names)

    def value_and_slope(self, theta: Array, half_tan: Array) -> tuple[Array, Array]:
        # The guards only matter on the axis, where the slope of every shift vanishes.
        t, theta = np.maximum(half_tan, formulas.NOWHERE), np.maximum(theta, 2 * formulas.NOWHERE)
        scale = 1 / (1 + t * t)
        sin, cos = 2 * t * scale, (1 - t * t) * scale
        value, rise = self.formula(theta, sin, cos, *self.coefficients)
        return value, np.where(theta > 1e-9, rise / sin, 0.0)


@dataclass(frozen=True)
class Gennery(_Shift):
    """s = s0 + (theta / sin(theta) - 1) (e0 + e1 theta^2 + e2 theta^4), all in m.

    Source: Gennery, IJCV 68(3), 2006 (CAHVORE); the entrance pupil moves this way when s0 = 0.
    """

    s0: float = 0.0
    e0: float = 0.0
    e1: float = 0.0
    e2: float = 0.0
    coefficient_names: ClassVar[tuple[str, ...]] = ('s0', 'e0', 'e1', 'e2')
    limit: ClassVar[float] = np.pi
    formula = staticmethod(formulas.gennery)

    def columns(self, theta: Array) -> Array:
        growth = 1 / np.sinc(theta / np.pi) - 1
        z = theta * theta
        return np.stack([np.ones_like(theta), growth, growth * z, growth * z * z], axis=-1)


@dataclass(frozen=True)
class FlatPort(_Shift):
    """s = d (1 - cos(theta) / sqrt(n^2 - sin(theta)^2)): a plane window square to the axis.

    d: thickness, m; n: refractive index relative to the medium on both sides.  Snell's law: the
    ray leaves the window parallel to itself, so the camera behind seems to stand s further ahead.
    """

    thickness: float
    refractive_index: float
    coefficient_names: ClassVar[tuple[str, ...]] = ('thickness', 'refractive_index')
    limit: ClassVar[float] = np.pi / 2
    formula = staticmethod(formulas.flat_port)

    def columns(self, theta: Array) -> Array:
        cos, n = np.cos(theta), self.refractive_index
        root = np.sqrt(n * n - np.sin(theta) ** 2)
        return np.stack([1 - cos / root, self.thickness * cos * n / root**3], axis=-1)


def shift_at(
    curve: ViewpointShift, theta: Array, sin: Array, cos: Array
) -> tuple[Array, Array]:
    """Return s and sin ds/dtheta where sine and cosine are at hand; theta above 0."""
    formula: Formula | None = getattr(curve, 'formula', None)
    if formula is None:
        value, slope = curve.value_and_slope(theta, sin / (1 + cos))
        return value, slope * sin
    return formula(theta, sin, cos, *curve.coefficients)


def invert_height(curve: ImageHeight, height: Array) -> Array:
    """Return theta of heights h/f by Newton's method from a table of the monotone range."""
    limit = curve.limit  # not always a constant
    grid = np.linspace(0.0, limit, 1025)
    heights, _ = curve.value_and_slope(grid)
    theta = np.interp(height, heights, grid)
    for _ in range(4):
        value, slope = curve.value_and_slope(theta)
        # The slope vanishes at the limit, where the table is already the answer.
        step = np.where(slope > 1e-9, (height - value) / np.maximum(slope, 1e-9), 0.0)
        theta = np.clip(theta + step, 0.0, limit)
    return theta


IMAGE_HEIGHTS: dict[str, type[ImageHeight]] = {
    'orthographic': Orthographic,
    'equidistant': Equidistant,
    'equisolid': Equisolid,
    'stereographic': Stereographic,
    'kannala_brandt': KannalaBrandt,
}

VIEWPOINT_SHIFTS: dict[str, type[ViewpointShift]] = {
    'gennery': Gennery,
    'flat_port': FlatPort,
}


def curve_name(curve: ImageHeight | ViewpointShift) -> str:
    """Return the name under which the curve's class is registered."""
    registry: dict[str, type] = {**IMAGE_HEIGHTS, **VIEWPOINT_SHIFTS}
    return next(name for name, kind in registry.items() if kind is type(curve))
