"""Ports: what stands between a camera in air and the medium that it looks into.

A port bends rays twice, at its inner and its outer face, so that the camera behind it has no
single viewpoint, whatever its lens.  Exact rays: Snell's law at both faces, in vectors.
Source: Glassner, An Introduction to Ray Tracing, 1989, section 2.4; for what a flat port does to a
camera Treibitz, Schechner, Kunz and Singh, PAMI 34(1), 2012; Agrawal et al., CVPR 2012.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.optics.curve_base import Curve
from fisheye_svp_ros.registry import Registry

# Refractive indices beside air at 20 degrees and 589 nm (CRC Handbook; sea water of 35 g/kg:
# Quan and Fry, Applied Optics 34, 1995).
MEDIA = {'air': 1.0, 'water': 1.333, 'sea_water': 1.340}
_INDICES = (1.0, 3.0)
_DISTANCES = (0.005, 0.02, 0.06, 0.15)  # m
_OFF_CENTER = (-0.4, 0.0, 0.4)
_STEPS = 40  # of Newton's method, which a ray that grazes the port needs


@dataclass(frozen=True)
class Varying:
    """Numbers (1, M) or vectors (3, M), and their derivatives by T variables (T, 1 or 3, M).

    Coordinates come first, so that every operation runs along the rays.
    Source: forward-mode differentiation (Griewank and Walther, Evaluating Derivatives, chapter 3).
    """

    value: Array
    slope: Array

    def __add__(self, other: Varying) -> Varying:
        return Varying(self.value + other.value, self.slope + other.slope)

    def __sub__(self, other: Varying) -> Varying:
        return Varying(self.value - other.value, self.slope - other.slope)

    def __mul__(self, other: Varying) -> Varying:
        return Varying(
            self.value * other.value, self.slope * other.value + self.value * other.slope
        )

    def __truediv__(self, other: Varying) -> Varying:
        ratio = self.value / other.value
        return Varying(ratio, (self.slope - ratio * other.slope) / other.value)

    def __rsub__(self, constant: float) -> Varying:
        return Varying(constant - self.value, -self.slope)

    def dot(self, other: Varying) -> Varying:
        """Return the inner product of two vectors, (1, M)."""
        product = self * other
        return Varying(
            product.value.sum(axis=-2, keepdims=True), product.slope.sum(axis=-2, keepdims=True)
        )

    def root(self) -> Varying:
        """Return the square root; NaN below 0."""
        root = np.sqrt(self.value)
        return Varying(root, self.slope / (2 * root))

    def tan(self) -> Varying:
        """Return the tangent."""
        tan = np.tan(self.value)
        return Varying(tan, self.slope * (1 + tan * tan))

    def unit(self) -> Varying:
        """Return the vector over its length."""
        return self / self.dot(self).root()


def stack_vector(x: Varying, y: Varying, z: Varying) -> Varying:
    """Return the vector (3, M) of three numbers."""
    return Varying(
        np.concatenate([x.value, y.value, z.value], axis=-2),
        np.concatenate([x.slope, y.slope, z.slope], axis=-2),
    )


def constant(value: float, variables: int) -> Varying:
    """Return a number that depends on nothing."""
    return Varying(np.full((1, 1), value), np.zeros((variables, 1, 1)))


@dataclass(frozen=True)
class Port(Curve, ABC):
    """A port in the camera frame; lengths in m, angles in rad, indices relative to air.

    placed: the coefficients that say where it is, which a calibration fits.
    """

    placed: ClassVar[tuple[str, ...]]

    @abstractmethod
    def starts(self) -> list[Self]:
        """Return the same port in places from which a fit of its place is begun."""

    @property
    def magnification(self) -> float:
        """How much larger what is far away seems on the axis than without the port."""
        return 1.0

    @property
    @abstractmethod
    def reach(self) -> float:
        """Distance of the outer face from the camera's origin, m."""

    @abstractmethod
    def leave(
        self, origin: Varying, direction: Varying, numbers: Sequence[Varying]
    ) -> tuple[Varying, Varying]:
        """Follow rays through the port: where on its outer face they leave it, and which way.

        origin, direction (unit): in air, vectors (3, M); numbers: the coefficients.
        """

    @abstractmethod
    def start(self, points: Array) -> Array:
        """Return directions (M, 3), unit, in air in which about points (M, 3), m, are seen."""

    def varying(self, variables: int, first: int | None = None) -> list[Varying]:
        """Return the coefficients; those from variable `first` on are the variables themselves."""
        numbers = [constant(value, variables) for value in self.coefficients]
        if first is not None:
            for number, coefficient in enumerate(numbers, start=first):
                coefficient.slope[number] = 1.0
        return numbers

    def check(self) -> str:
        values = dict(zip(self.coefficient_names, self.coefficients, strict=True))
        for name, value in values.items():
            if name.endswith('_index') and not _INDICES[0] <= value <= _INDICES[1]:
                return f'port: {name} is {value}; it must be from {_INDICES[0]} to {_INDICES[1]}'
            if name in ('thickness', 'distance') and value < 0:
                return f'port: {name} is {value}; it must not be below 0'
            if name.startswith('tilt') and not abs(value) < np.pi / 2:
                return f'port: {name} is {value} rad; it must be within 1.57, a quarter turn'
        return ''


@dataclass(frozen=True)
class FlatGlass(Port):
    """A pane with air before and a medium behind it.

    distance: of its inner face from the camera's origin, the entrance pupil, along the normal;
    tilt_x, tilt_y: of the normal (tan(tilt_y), -tan(tilt_x), 1) about the camera's x and y.
    """

    distance: float
    medium_index: float
    tilt_x: float = 0.0
    tilt_y: float = 0.0
    thickness: float = 0.0
    glass_index: float = 1.5
    coefficient_names = (
        'distance',
        'medium_index',
        'tilt_x',
        'tilt_y',
        'thickness',
        'glass_index',
    )
    placed = ('distance', 'tilt_x', 'tilt_y')

    @property
    def magnification(self) -> float:
        return self.medium_index

    def starts(self) -> list[Self]:
        return [self.with_values(distance=distance) for distance in _DISTANCES]

    @property
    def reach(self) -> float:
        return self.distance + self.thickness

    def leave(
        self, origin: Varying, direction: Varying, numbers: Sequence[Varying]
    ) -> tuple[Varying, Varying]:
        distance, medium, tilt_x, tilt_y, thickness, glass = numbers
        air = constant(1.0, len(medium.slope))
        normal = stack_vector(tilt_y.tan(), 0.0 - tilt_x.tan(), air).unit()
        point = origin + direction * ((distance - normal.dot(origin)) / normal.dot(direction))
        direction = refract(direction, normal, air, glass)
        point = point + direction * (thickness / normal.dot(direction))
        return point, refract(direction, normal, glass, medium)

    def start(self, points: Array) -> Array:
        """See `Port.start`; exact where the viewpoint is the origin, NaN where no ray leads.

        In u, the tangent of the angle in air, the height at which a ray arrives is concave: Newton
        from below never passes the root.
        """
        normal = np.array([np.tan(self.tilt_y), -np.tan(self.tilt_x), 1.0])
        normal /= np.linalg.norm(normal)
        z = points @ normal
        across = points - z[:, None] * normal
        r, deep = np.linalg.norm(across, axis=-1), z - self.reach
        layers = (
            (self.distance, 1.0),
            (self.thickness, self.glass_index**2),
            (deep, self.medium_index**2),
        )
        u = np.zeros_like(r)
        for _ in range(_STEPS):
            height, slope = np.zeros_like(r), np.zeros_like(r)
            for depth, square in layers:
                inside = square + (square - 1) * u * u
                root = np.sqrt(inside)
                height, slope = height + depth * u / root, slope + depth * square / (root * inside)
            step = (r - height) / slope
            u = u + step
            if np.all(np.abs(step) <= 1e-7 * (1 + u), where=np.isfinite(step)):
                break
        way = across / np.maximum(r, 1e-300)[:, None]
        seen = (deep > 0) & np.isfinite(u) & (np.abs(r - height) < 1e-6 * (1 + r))
        return np.where(
            seen[:, None], (normal + u[:, None] * way) / np.hypot(1, u)[:, None], np.nan
        )


@dataclass(frozen=True)
class DomeGlass(Port):
    """A spherical shell: radius of its inner face, and its center in the camera frame."""

    radius: float
    medium_index: float
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    thickness: float = 0.0
    glass_index: float = 1.5
    coefficient_names = ('radius', 'medium_index', 'x', 'y', 'z', 'thickness', 'glass_index')
    placed = ('x', 'y', 'z')

    def starts(self) -> list[Self]:
        return [self.with_values(z=share * self.radius) for share in _OFF_CENTER]

    @property
    def reach(self) -> float:
        off = float(np.linalg.norm([self.x, self.y, self.z]))
        return off + self.radius + self.thickness

    def leave(
        self, origin: Varying, direction: Varying, numbers: Sequence[Varying]
    ) -> tuple[Varying, Varying]:
        radius, medium, x, y, z, thickness, glass = numbers
        center, index = stack_vector(x, y, z), constant(1.0, len(medium.slope))
        for size, beyond in ((radius, glass), (radius + thickness, medium)):
            arm = origin - center
            along = arm.dot(direction)
            origin = origin + direction * (
                (along * along - arm.dot(arm) + size * size).root() - along
            )
            direction = refract(direction, (origin - center) / size, index, beyond)
            index = beyond
        return origin, direction

    def start(self, points: Array) -> Array:
        """See `Port.start`; exact for a dome about the origin."""
        return np.asarray(points / np.linalg.norm(points, axis=-1, keepdims=True))

    def check(self) -> str:
        if not np.linalg.norm([self.x, self.y, self.z]) < self.radius:
            return f'port: radius is {self.radius} m; the camera must be inside the dome'
        return super().check()


def refract(direction: Varying, normal: Varying, before: Varying, after: Varying) -> Varying:
    """Return directions behind a face by Snell's law; normal: the way the light is followed.

    NaN where all of it is reflected, or where it does not come to this side of the face.
    """
    ratio = before / after
    cos = normal.dot(direction)
    cos = Varying(np.where(cos.value > 0, cos.value, np.nan), cos.slope)
    root = (1.0 - ratio * ratio * (1.0 - cos * cos)).root()
    return direction * ratio + normal * (root - ratio * cos)


PORTS: Registry[type[Port]] = Registry('ports', {'flat': FlatGlass, 'dome': DomeGlass}, Port)
