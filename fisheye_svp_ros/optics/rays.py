"""The ray of a point: r cos(theta) - (Z - s(theta)) sin(theta) = 0 solved for theta.

Source: Kita, section 2 and figure 2.  Newton's method far from the lens; near it, where there may
be no ray or two, a search.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.optics.curve_base import ImageHeight, ViewpointShift, shift_at
from fisheye_svp_ros.optics.formulas import newton_step
from fisheye_svp_ros.optics.lens import Lens

NEWTON_STEPS, MORE_STEPS = 3, 3  # for all points, and for those that need them
STEP_TOLERANCE = 1e-7  # a last Newton step this small leaves an error of its square
ZERO_CLEARANCE = 1e-20  # m; a clearance of 0 but for rounding
_HALVINGS = 48
_ANGLE_TOLERANCE = 1e-13  # rad
_MARGIN = 0.1  # rad past `max_incidence` in which a solver on its way still gets an answer
_ANGLE_SLACK = 1e-9  # rad; keeps points exactly at the edge of the field inside it
BACKWARD_ANGLE = float(np.nextafter(np.pi, 0.0))  # nothing that is seen lies on the axis behind

ShiftedRays = tuple[Array, Array, Array]  # sine and cosine of theta, clearance (m)


class RaySolution(NamedTuple):
    """Where points have their ray through the lens; every field (...).

    x, y, z: in the camera frame, m; x2: x^2; r2, r: of the distance r from the axis; d2: of that
    from the origin; theta: rad; shifted: where the lens has a shift; its clearance is the ray
    equation's derivative by theta, the sign turned.
    """

    x: Array
    y: Array
    z: Array
    x2: Array
    r2: Array
    d2: Array
    r: Array
    theta: Array
    shifted: ShiftedRays | None
    valid: Mask

    def height(self, curve: ImageHeight) -> tuple[Array, Array]:
        """Return h/f and its derivative by theta."""
        return curve.from_sine(self.theta, self._sine)

    def _sine(self) -> tuple[Array, Array]:
        if self.shifted is not None:
            return self.shifted[:2]
        inverse = 1.0 / np.sqrt(self.d2)
        return self.r * inverse, self.z * inverse

    def change(self, outward: Array) -> Array:
        """Write dtheta/dr, 1/m, and return -dtheta/dZ / r, 1/m^2."""
        if self.shifted is None:
            axial = 1.0 / self.d2
            np.multiply(self.z, axial, out=outward)
            return axial
        sin, cos, clearance = self.shifted
        np.divide(cos, clearance, out=outward)
        return sin / (clearance * self.r)


def solve_incidence(lens: Lens, local: Array, limited: bool) -> RaySolution:
    """Return the rays of points (3, ...) in the camera frame, none exactly on the axis.

    limited: see `edge`.
    """
    x, y, z = local
    x2, r2, d2 = local * local
    r2 += x2
    d2 += r2
    r = np.sqrt(r2)
    theta = np.arctan2(r, z)
    shifted: ShiftedRays | None = None
    if lens.viewpoint_shift is None:
        valid = d2 > ZERO_CLEARANCE * ZERO_CLEARANCE
    else:
        distance = np.sqrt(d2)
        theta, shifted = _shifted_rays(lens, r, z, distance, (theta, r / distance, z / distance))
        valid = shifted[2] > ZERO_CLEARANCE
    valid &= theta <= edge(lens, limited)
    return RaySolution(x, y, z, x2, r2, d2, r, theta, shifted, valid)


def edge(lens: Lens, limited: bool) -> float:
    """Return the largest angle that counts, rad: the lens's own, if `limited` to it."""
    return min(lens.max_incidence + _ANGLE_SLACK, BACKWARD_ANGLE) if limited else BACKWARD_ANGLE


def search_limit(shift: ViewpointShift, max_incidence: float) -> float:
    """Return the angle up to which rays are searched for near the lens, rad."""
    return min(shift.limit, max_incidence + _MARGIN, np.pi - _MARGIN)


@lru_cache(maxsize=256)
def caustic_range(shift: ViewpointShift, limit: float) -> float:
    """Return the distance of the outermost point of the caustic of the rays up to `limit`, m."""
    theta = np.linspace(0.0, min(limit, np.pi - _MARGIN), 257)
    value, slope = shift.value_and_slope(theta, np.tan(theta / 2))
    along = slope * np.sin(theta)
    outer = np.hypot(along * np.sin(theta), value + along * np.cos(theta))
    # A viewpoint ahead of the origin hides what lies between the two, caustic or not.
    return float(max(np.max(outer[along > 0], initial=0.0), np.max(np.abs(value))))


def _shifted_rays(
    lens: Lens, r: Array, z: Array, distance: Array, start: tuple[Array, Array, Array]
) -> tuple[Array, ShiftedRays]:
    """Return theta, and its sine, cosine and clearance; NaN where there is no ray."""
    shift = lens.viewpoint_shift
    assert shift is not None
    theta, sin, cos, clearance, settled = _newton(shift, r, z, *start)
    limit = search_limit(shift, lens.max_incidence)
    apart = ~settled | (theta <= 0) | (distance < caustic_range(shift, limit))
    if np.count_nonzero(apart):
        roots = _scan(shift, limit, r[apart], z[apart])
        theta[apart], sin[apart], cos[apart] = roots, np.sin(roots), np.cos(roots)
        value, rise = shift_at(shift, roots, sin[apart], cos[apart])
        clearance[apart] = newton_step(r[apart], z[apart], sin[apart], cos[apart], value, rise)[1]
    return theta, (sin, cos, clearance)


def _newton(
    shift: ViewpointShift,
    r: Array,
    z: Array,
    theta: Array,
    sin: Array,
    cos: Array,
    steps: int = NEWTON_STEPS,
    more: int = MORE_STEPS,
) -> tuple[Array, Array, Array, Array, Mask]:
    """Take Newton steps, and up to so many more with the points that have not settled.

    theta and cos are used up.
    """
    for count in range(steps):
        if count:
            sin, cos = _sine_and_cosine(theta)
        step, clearance = newton_step(r, z, sin, cos, *shift_at(shift, theta, sin, cos))
        theta += step
    # The last step is so small that sine and cosine follow it in a straight line.
    turned = step * cos
    turned += sin
    cos -= step * sin
    found = (theta, turned, cos, clearance, np.abs(step, out=step) < STEP_TOLERANCE)
    late = ~found[-1]
    if more and np.count_nonzero(late):
        start = theta[late], *_sine_and_cosine(theta[late])
        again = _newton(shift, r[late], z[late], *start, 1, more - 1)
        for field, values in zip(found, again, strict=True):
            field[late] = values
    return found


def _sine_and_cosine(theta: Array) -> tuple[Array, Array]:
    """Return both by way of tan(theta / 2), which NumPy has faster."""
    half_tan = 0.5 * theta
    np.tan(half_tan, out=half_tan)
    cos = half_tan * half_tan
    cos += 1.0
    np.divide(2.0, cos, out=cos)
    half_tan *= cos
    cos -= 1.0
    return half_tan, cos


def _scan(shift: ViewpointShift, limit: float, r: Array, z: Array) -> Array:
    """Find the smallest root up to `limit` of the ray equation of points (N,); NaN for none."""
    low = np.zeros((len(r), 1))
    high = np.full((len(r), 1), limit)
    for _ in range(2):
        grid = low + (high - low) * np.linspace(0, 1, 65)
        values, _ = _ray_equation(shift, r[:, None], z[:, None], grid)
        falls = (values[:, :-1] >= 0) & (values[:, 1:] < 0)
        found = falls.any(axis=1)
        # Where no sign changes, two roots may hide between neighbors of the lowest value.
        lowest = np.clip(np.argmin(values, axis=1), 1, 63)
        first = np.argmax(falls, axis=1)
        left = np.where(found, first, lowest - 1)[:, None]
        right = np.where(found, first + 1, lowest + 1)[:, None]
        low = np.take_along_axis(grid, left, axis=1)
        high = np.take_along_axis(grid, right, axis=1)
    theta = np.full(len(r), np.nan)
    if found.any():
        theta[found] = _bracketed_newton(shift, r[found], z[found], low[found, 0], high[found, 0])
    return theta


def _bracketed_newton(shift: ViewpointShift, r: Array, z: Array, low: Array, high: Array) -> Array:
    """Newton steps that fall back to halving the bracket; the equation falls through zero."""
    theta = (low + high) / 2
    for _ in range(_HALVINGS):
        value, slope = _ray_equation(shift, r, z, theta)
        low, high = np.where(value >= 0, theta, low), np.where(value >= 0, high, theta)
        step = theta - value / slope
        inside = (step >= low) & (step <= high)
        before, theta = theta, np.where(inside, step, (low + high) / 2)
        if np.all(np.abs(theta - before) < _ANGLE_TOLERANCE):
            break
    return theta


def _ray_equation(shift: ViewpointShift, r: Array, z: Array, theta: Array) -> tuple[Array, Array]:
    """Return r cos(theta) - (Z - s(theta)) sin(theta) and its derivative."""
    value, slope = shift.value_and_slope(theta, np.tan(theta / 2))
    sin, cos, reach = np.sin(theta), np.cos(theta), z - value
    return r * cos - reach * sin, slope * sin - r * sin - reach * cos
