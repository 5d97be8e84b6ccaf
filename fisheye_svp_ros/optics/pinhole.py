"""OpenCV's pinhole models, as sensor_msgs/CameraInfo names them: plumb_bob, rational_polynomial.

Their radial part is a curve like any other.  What moves image points otherwise than along the
radius (tangential distortion, thin prism, tilted sensor) is `TangentialDistortion`.
Source: documentation of OpenCV 4, calib3d; Brown, Photogrammetric Engineering 37(8), 1971.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.optics.curve_base import ImageHeight

_NEWTON_STEPS = 60
_ANGLE_TOLERANCE = 1e-12  # rad; a last Newton step this small leaves an error of its square
_NEAR = 1e-6  # of a height: close by, where Newton's step is to be believed
_PLACE_TOLERANCE = 1e-14  # of a place in the image for unit focal length
_AXIS = 1e-12  # of the same: nearer to the axis, directions are of no account
_MAX_OFF = 1e-9  # of the same: what is farther off has not been inverted


class RadialPinhole(ImageHeight):
    """h = r N / D with r = tan(theta), of polynomials N, D = 1 + c1 r^2 + c2 r^4 + c3 r^6."""

    @property
    def above(self) -> tuple[float, ...]:
        """Coefficients of N."""
        return self.coefficients[:3]

    @property
    def below(self) -> tuple[float, ...]:
        """Coefficients of D."""
        return self.coefficients[3:]

    @cached_property
    def limit(self) -> float:
        # dh/dr is a ratio of polynomials in r^2; it ends at the first root of N or D's.
        above, below = (np.poly1d([*reversed(part), 1.0]) for part in (self.above, self.below))
        z = np.poly1d([1.0, 0.0])
        rise = above * below + 2.0 * z * (above.deriv() * below - above * below.deriv())
        roots = np.concatenate([rise.roots, below.roots])
        real = roots.real[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0)]
        return float(np.arctan(np.sqrt(real.min()))) if real.size else np.pi / 2

    def value_and_slope(self, theta: Array) -> tuple[Array, Array]:
        r = np.tan(theta)
        z = r * r
        above, above_rise = _polynomial(self.above, z)
        below, below_rise = _polynomial(self.below, z)
        stretch = above / below
        rise = (above_rise - stretch * below_rise) / below
        return r * stretch, (stretch + 2.0 * z * rise) * (1.0 + z)

    def angle(self, height: Array) -> Array:
        """Return theta by Newton's method, which falls back to halving: h grows without bound."""
        height = np.asarray(height, dtype=float)
        low, high = np.zeros_like(height), np.full_like(height, self.limit)
        theta, moved = np.minimum(np.arctan(height), self.limit), high
        for _ in range(_NEWTON_STEPS):
            with np.errstate(all='ignore'):
                value, slope = self.value_and_slope(theta)
                change = (height - value) / slope
            small = value <= height
            low, high = np.where(small, theta, low), np.where(small, high, theta)
            near = np.abs(height - value) <= _NEAR * height
            step, settled = theta + change, near & (np.abs(change) < _ANGLE_TOLERANCE)
            newton = (step >= low) & (step <= high) & (np.abs(change) < moved / 2)
            step = np.where(newton | settled, step, (low + high) / 2)
            theta, moved = step, np.abs(step - theta)
            if not np.any((moved > _ANGLE_TOLERANCE) & ~settled):
                break
        return np.where(np.isnan(height), np.nan, theta)

    def columns(self, theta: Array) -> Array:
        r = np.tan(theta)
        z = r * r
        above, below = (_polynomial(part, z)[0] for part in (self.above, self.below))
        powers = r[..., None] * z[..., None] ** np.arange(1, 4)
        columns = [powers / below[..., None]]
        if self.below:
            columns.append(-powers * (above / below**2)[..., None])
        return np.concatenate(columns, axis=-1)


@dataclass(frozen=True)
class BrownConrady(RadialPinhole):
    """h = r (1 + k1 r^2 + k2 r^4 + k3 r^6) with r = tan(theta): ROS's plumb_bob."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    coefficient_names = ('k1', 'k2', 'k3')


@dataclass(frozen=True)
class RationalPolynomial(RadialPinhole):
    """The same over 1 + k4 r^2 + k5 r^4 + k6 r^6: ROS's rational_polynomial."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0
    coefficient_names = ('k1', 'k2', 'k3', 'k4', 'k5', 'k6')


@dataclass(frozen=True)
class TangentialDistortion:
    """What OpenCV's pinhole models do beside the radial part, for unit focal length.

    p1, p2: tangential; s1 to s4: thin prism (s1, s2 along u, s3, s4 along v), both by the place
    (x, y) that the ray has in an undistorted image; tau_x, tau_y: tilt of the sensor, rad.
    """

    p1: float = 0.0
    p2: float = 0.0
    s1: float = 0.0
    s2: float = 0.0
    s3: float = 0.0
    s4: float = 0.0
    tau_x: float = 0.0
    tau_y: float = 0.0

    @property
    def values(self) -> dict[str, float]:
        """The coefficients by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def apply(self, curve: ImageHeight, place: Array) -> Array:
        """Return places (..., 2) in the image of those that the radial curve alone gives."""
        moved = place + self._sideways(_undistorted(curve, place)[0])
        return self._tilt_places(moved)[0]

    def slope(self, curve: ImageHeight, place: Array, of_ray: bool = True) -> Array:
        """Return derivatives (..., 2, 2) of `apply` by the place.

        of_ray: the ray moves with the place; otherwise the curve does, and the ray stays.
        """
        plane, by_place = _undistorted(curve, place)
        moved = place + self._sideways(plane)
        by_moved = self._tilt_places(moved)[1]
        if not of_ray:
            return by_moved
        return np.asarray(by_moved @ (np.eye(2) + self._sideways_slope(plane) @ by_place))

    def invert(self, curve: ImageHeight, place: Array) -> Array:
        """Return the places (..., 2) that `apply` moves to others, by Newton's method.

        NaN where there is none, or beyond the range of the curve.
        """
        ideal = np.array(place, dtype=float)
        with np.errstate(all='ignore'):
            for _ in range(_NEWTON_STEPS):
                off = place - self.apply(curve, ideal)
                if not np.nanmax(np.abs(off), initial=0.0) > _PLACE_TOLERANCE:
                    break
                (a, b), (c, d) = np.moveaxis(self.slope(curve, ideal), (-2, -1), (0, 1))
                x, y = np.moveaxis(off, -1, 0)
                step = np.stack([d * x - b * y, a * y - c * x], axis=-1)
                ideal = ideal + step / (a * d - b * c)[..., None]
            off = np.abs(place - self.apply(curve, ideal)).max(axis=-1)
        return np.where((off <= _MAX_OFF)[..., None], ideal, np.nan)

    def check(self) -> str:
        """Say what is wrong with the coefficients; empty if nothing is."""
        wrong = [f'{name} is {value}' for name, value in self.values.items() if abs(value) >= 1.5]
        return f'tangential: {wrong[0]}; no real lens has this' if wrong else ''

    def _sideways(self, plane: Array) -> Array:
        x, y = np.moveaxis(plane, -1, 0)
        z, xy = x * x + y * y, 2.0 * x * y
        return np.stack(
            [
                self.p1 * xy + self.p2 * (z + 2.0 * x * x) + (self.s1 + self.s2 * z) * z,
                self.p2 * xy + self.p1 * (z + 2.0 * y * y) + (self.s3 + self.s4 * z) * z,
            ],
            axis=-1,
        )

    def _sideways_slope(self, plane: Array) -> Array:
        x, y = np.moveaxis(plane, -1, 0)
        z = x * x + y * y
        u, v = (2.0 * (a + 2.0 * b * z) for a, b in ((self.s1, self.s2), (self.s3, self.s4)))
        across = 2.0 * (self.p1 * x + self.p2 * y)
        return _matrices(
            2.0 * self.p1 * y + (6.0 * self.p2 + u) * x,
            across + u * y,
            across + v * x,
            2.0 * self.p2 * x + (6.0 * self.p1 + v) * y,
        )

    @cached_property
    def _tilt(self) -> Array | None:
        """The homography (3, 3) of a tilted sensor."""
        if not (self.tau_x or self.tau_y):
            return None
        (cx, sx), (cy, sy) = ((np.cos(t), np.sin(t)) for t in (self.tau_x, self.tau_y))
        about_x = np.array([[1.0, 0.0, 0.0], [0.0, cx, sx], [0.0, -sx, cx]])
        about_y = np.array([[cy, 0.0, -sy], [0.0, 1.0, 0.0], [sy, 0.0, cy]])
        turn = about_y @ about_x
        onto = np.eye(3)
        onto[:2] = [[turn[2, 2], 0.0, -turn[0, 2]], [0.0, turn[2, 2], -turn[1, 2]]]
        return np.asarray(onto @ turn)

    def _tilt_places(self, places: Array) -> tuple[Array, Array]:
        """Return places (..., 2) on the tilted sensor, and derivatives (..., 2, 2)."""
        if self._tilt is None:
            return places, np.broadcast_to(np.eye(2), (*places.shape, 2))
        tilt = self._tilt
        scale = places @ tilt[2, :2] + tilt[2, 2]
        tilted = (places @ tilt[:2, :2].T + tilt[:2, 2]) / scale[..., None]
        slope = tilt[:2, :2] - tilted[..., None] * tilt[2, :2]
        return tilted, slope / scale[..., None, None]


def _polynomial(coefficients: tuple[float, ...], z: Array) -> tuple[Array, Array]:
    """Return 1 + c1 z + c2 z^2 + ... and its derivative by z."""
    value, rise = np.zeros_like(z), np.zeros_like(z)
    for c in reversed((1.0, *coefficients)):
        rise = rise * z + value
        value = value * z + c
    return value, rise


def _undistorted(curve: ImageHeight, place: Array) -> tuple[Array, Array]:
    """Return where rays have places (..., 2) of a curve in an undistorted image; derivatives."""
    height = np.hypot(place[..., 0], place[..., 1])
    theta = curve.angle(height)
    r, slope = np.tan(theta), curve.value_and_slope(theta)[1]
    on_axis = height < _AXIS
    along = (1.0 + r * r) / slope
    across = np.where(on_axis, along, r / np.where(on_axis, 1.0, height))
    u, v = np.moveaxis(place / np.where(on_axis, 1.0, height)[..., None], -1, 0)
    growth = along - across
    mixed = growth * u * v
    slopes = _matrices(across + growth * u * u, mixed, mixed, across + growth * v * v)
    return place * across[..., None], slopes


def _matrices(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Return matrices (..., 2, 2) of their entries, row by row."""
    return np.stack([np.stack([a, b], axis=-1), np.stack([c, d], axis=-1)], axis=-2)
