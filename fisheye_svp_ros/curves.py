"""Lens curves: image height h(theta)/f and viewpoint shift s(theta), with their derivatives.

A new curve is one class here and one line in its registry.  All angles in rad, shifts in m.
Curves take arrays of any shape and return arrays of that shape.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np

from fisheye_svp_ros.arrays import Array


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
        """Return h/f and its derivative with respect to theta."""

    def angle(self, height: Array) -> Array:
        """Return theta of heights h/f within the monotone range; anything beyond it."""

    def columns(self, theta: Array) -> Array:
        """Return the derivatives of h/f with respect to the coefficients, shape (..., K)."""


class ViewpointShift(Protocol):
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


class _NoCoefficients:
    coefficient_names: ClassVar[tuple[str, ...]] = ()
    coefficients: tuple[float, ...] = ()

    def columns(self, theta: Array) -> Array:
        return np.empty((*np.shape(theta), 0))


@dataclass(frozen=True)
class Orthographic(_NoCoefficients):
    """h = f sin(theta)."""

    limit: ClassVar[float] = np.pi / 2

    def value_and_slope(self, theta: Array) -> tuple[Array, Array]:
        return np.sin(theta), np.cos(theta)

    def angle(self, height: Array) -> Array:
        return np.arcsin(np.minimum(height, 1.0))


@dataclass(frozen=True)
class Equidistant(_NoCoefficients):
    """h = f theta."""

    limit: ClassVar[float] = np.pi

    def value_and_slope(self, theta: Array) -> tuple[Array, Array]:
        return theta, np.ones_like(theta)

    def angle(self, height: Array) -> Array:
        return height


@dataclass(frozen=True)
class Equisolid(_NoCoefficients):
    """h = 2 f sin(theta / 2)."""

    limit: ClassVar[float] = np.pi

    def value_and_slope(self, theta: Array) -> tuple[Array, Array]:
        return 2 * np.sin(theta / 2), np.cos(theta / 2)

    def angle(self, height: Array) -> Array:
        return 2 * np.arcsin(np.minimum(height / 2, 1.0))


@dataclass(frozen=True)
class Stereographic(_NoCoefficients):
    """h = 2 f tan(theta / 2)."""

    limit: ClassVar[float] = np.pi

    def value_and_slope(self, theta: Array) -> tuple[Array, Array]:
        half = np.tan(theta / 2)
        return 2 * half, 1 + half * half

    def angle(self, height: Array) -> Array:
        return 2 * np.arctan(height / 2)


@dataclass(frozen=True)
class KannalaBrandt:
    """h = f (theta + k1 theta^3 + k2 theta^5 + k3 theta^7 + k4 theta^9).

    Source: Kannala and Brandt, PAMI 2006, eq. 6, with the factor f taken out (OpenCV's fisheye).
    """

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    coefficient_names: ClassVar[tuple[str, ...]] = ('k1', 'k2', 'k3', 'k4')

    @property
    def coefficients(self) -> tuple[float, ...]:
        return self.k1, self.k2, self.k3, self.k4

    @property
    def limit(self) -> float:
        # dh/dtheta is a polynomial in theta^2; its first positive root ends the monotone range.
        roots = np.roots([9 * self.k4, 7 * self.k3, 5 * self.k2, 3 * self.k1, 1.0])
        real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
        return float(min(np.sqrt(real.min()), np.pi)) if real.size else np.pi

    def value_and_slope(self, theta: Array) -> tuple[Array, Array]:
        k1, k2, k3, k4 = self.coefficients
        z = theta * theta
        height = theta * (1 + z * (k1 + z * (k2 + z * (k3 + z * k4))))
        slope = 1 + z * (3 * k1 + z * (5 * k2 + z * (7 * k3 + z * (9 * k4))))
        return height, slope

    def angle(self, height: Array) -> Array:
        return invert_height(self, height)

    def columns(self, theta: Array) -> Array:
        z = theta * theta
        return theta[..., None] * z[..., None] ** np.arange(1, 5)


@dataclass(frozen=True)
class Gennery:
    """s = s0 + (theta / sin(theta) - 1) (e0 + e1 theta^2 + e2 theta^4), all in m.

    Source: Gennery, IJCV 68(3), 2006 (CAHVORE); the entrance pupil moves this way when s0 = 0.
    """

    s0: float = 0.0
    e0: float = 0.0
    e1: float = 0.0
    e2: float = 0.0
    coefficient_names: ClassVar[tuple[str, ...]] = ('s0', 'e0', 'e1', 'e2')
    limit: ClassVar[float] = np.pi

    @property
    def coefficients(self) -> tuple[float, ...]:
        return self.s0, self.e0, self.e1, self.e2

    def value_and_slope(self, theta: Array, half_tan: Array) -> tuple[Array, Array]:
        # 1 / sin(theta) = (1 + t^2) / 2t; the guard only matters at theta = 0, where g = g' = 0.
        t = np.maximum(half_tan, 1e-150)
        cosecant = (1 + t * t) / (2 * t)
        ratio = theta * cosecant
        growth = np.where(theta > 0, ratio - 1, 0.0)
        growth_slope = np.where(theta > 1e-9, cosecant - ratio * (1 - t * t) / (2 * t), 0.0)
        z = theta * theta
        factor = self.e0 + z * (self.e1 + z * self.e2)
        factor_slope = theta * (2 * self.e1 + 4 * self.e2 * z)
        return self.s0 + growth * factor, growth_slope * factor + growth * factor_slope

    def columns(self, theta: Array) -> Array:
        growth = 1 / np.sinc(theta / np.pi) - 1
        z = theta * theta
        return np.stack([np.ones_like(theta), growth, growth * z, growth * z * z], axis=-1)


@dataclass(frozen=True)
class FlatPort:
    """s = d (1 - cos(theta) / sqrt(n^2 - sin(theta)^2)): a plane window square to the axis.

    d: thickness, m; n: refractive index relative to the medium on both sides.  Snell's law: the
    ray leaves the window parallel to itself, so the camera behind seems to stand s further ahead.
    """

    thickness: float
    refractive_index: float
    coefficient_names: ClassVar[tuple[str, ...]] = ('thickness', 'refractive_index')
    limit: ClassVar[float] = np.pi / 2

    @property
    def coefficients(self) -> tuple[float, ...]:
        return self.thickness, self.refractive_index

    def value_and_slope(self, theta: Array, half_tan: Array) -> tuple[Array, Array]:
        t2 = half_tan * half_tan
        cos, sin = (1 - t2) / (1 + t2), 2 * half_tan / (1 + t2)
        n2 = self.refractive_index**2
        root = np.sqrt(n2 - sin * sin)
        shift = self.thickness * (1 - cos / root)
        return shift, self.thickness * sin * (n2 - 1) / root**3

    def columns(self, theta: Array) -> Array:
        cos, n = np.cos(theta), self.refractive_index
        root = np.sqrt(n * n - np.sin(theta) ** 2)
        return np.stack([1 - cos / root, self.thickness * cos * n / root**3], axis=-1)


def invert_height(curve: ImageHeight, height: Array) -> Array:
    """Return theta of heights h/f by Newton's method from a table of the monotone range."""
    grid = np.linspace(0.0, curve.limit, 1025)
    heights, _ = curve.value_and_slope(grid)
    theta = np.interp(height, heights, grid)
    for _ in range(4):
        value, slope = curve.value_and_slope(theta)
        # The slope vanishes at the limit, where the table is already the answer.
        step = np.where(slope > 1e-9, (height - value) / np.maximum(slope, 1e-9), 0.0)
        theta = np.clip(theta + step, 0.0, curve.limit)
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
