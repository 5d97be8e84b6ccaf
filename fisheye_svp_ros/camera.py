"""Projection and back-projection through a lens, with analytic Jacobians.

Arrays in, arrays out, batch first; any leading shape.  Points are in the camera optical frame (m),
image points in px.  The SVP model is not a case of its own: it is a lens without a shift.

Domain: a point has an image when its incidence angle does not pass the lens's `max_incidence`
and some ray through it meets the axis at its own viewpoint.  Beyond `unique_range` there is at
most one such ray; nearer, there may be none (NaN, flagged) or two, of which the one at the smaller
angle, which is the one that continues to far points, is taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.curves import ViewpointShift
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.lens import Lens

_NEWTON_STEPS = 3
_SETTLED = 1e-7  # a last Newton step this small leaves an error of its square
_HALVINGS = 48
_EXACT = 1e-13  # rad
_MARGIN = 0.1  # rad past `max_incidence` in which a solver on its way still gets an answer
_ANGLE_SLACK = 1e-9  # rad; keeps points exactly at the edge of the field inside it


class Image(NamedTuple):
    """Image points (..., 2), px, NaN where `valid` (...) is False."""

    uv: Array
    valid: Mask


class Incidence(NamedTuple):
    """Where points meet the lens; every field (...).

    theta: rad; sin, cos: of theta; ex, ey: unit vector of the image height; radius: distance from
    the axis, m; clearance: derivative of the ray equation, m, positive where theta is unique.
    """

    theta: Array
    sin: Array
    cos: Array
    ex: Array
    ey: Array
    radius: Array
    clearance: Array
    valid: Mask


class LinearImage(NamedTuple):
    """Image points and their derivatives.

    uv (..., 2), px; valid (...); d_point (..., 2, 3), px/m; d_height (..., 2), px for unit h/f;
    d_shift (..., 2), px/m; incidence.
    """

    uv: Array
    valid: Mask
    d_point: Array
    d_height: Array
    d_shift: Array
    incidence: Incidence


class Rays(NamedTuple):
    """Rays of image points: origin (..., 3), m; direction (..., 3), unit; theta, valid (...)."""

    origin: Array
    direction: Array
    theta: Array
    valid: Mask


def incidence(lens: Lens, points: Array, limited: bool = True) -> Incidence:
    """Solve r cos(theta) - (Z - s(theta)) sin(theta) = 0 for points (..., 3), m.

    limited: also refuse angles past the lens's `max_incidence`; a solver on its way does not.
    Source: Kita, section 2 and figure 2.
    """
    if points.ndim == 1:
        return Incidence(*(field[0] for field in incidence(lens, points[None], limited)))
    x, y, z = (np.ascontiguousarray(points[..., i], dtype=float) for i in range(3))
    r2 = x * x + y * y
    r = np.sqrt(r2)
    distance = np.sqrt(r2 + z * z)
    with np.errstate(divide='ignore', invalid='ignore'):
        t = np.where(z >= 0, r / (distance + z), (distance - z) / r)
        t = np.where(r > 0, t, np.where(z > 0, 0.0, np.inf))
        shift = lens.viewpoint_shift
        if shift is None:
            theta, reach, slope, settled = 2 * np.arctan(t), z, np.zeros(()), distance > 0
        else:
            theta, t, settled = _newton(shift, r, z, t)
            limit = min(shift.limit, lens.max_incidence + _MARGIN, np.pi - _MARGIN)
            apart = ~settled | (distance < _caustic_range(shift, limit))
            if np.any(apart):
                theta[apart] = _scan(shift, limit, r[apart], z[apart])
                t[apart] = np.tan(theta[apart] / 2)
                settled = settled | ~np.isnan(theta)
            value, slope = shift.value_and_slope(theta, t)
            reach = z - value
        scale = 1 / (1 + t * t)
        sin, cos = 2 * t * scale, (1 - t * t) * scale
        clearance = r * sin + reach * cos - slope * sin
        valid = settled & (clearance > 0)
        if limited:
            valid &= theta <= lens.max_incidence + _ANGLE_SLACK
        on_axis = r == 0
        inverse = 1 / np.where(on_axis, 1.0, r)
        ex = np.where(on_axis, 1.0, x * inverse)
        ey = y * inverse
    return Incidence(theta, sin, cos, ex, ey, r, clearance, valid)


def project(lens: Lens, points: Array, limited: bool = True) -> Image:
    """Project points (..., 3), m, in the camera frame to image points (..., 2), px.

    limited: see `incidence`.  Points outside the domain come back as NaN with valid False.
    """
    rays = incidence(lens, points, limited)
    height, _ = lens.image_height.value_and_slope(rays.theta)
    return Image(_image_points(lens, rays, height), rays.valid)


def project_with_jacobian(lens: Lens, points: Array, limited: bool = True) -> LinearImage:
    """Project points (..., 3), m, and differentiate by the point and by both lens curves."""
    rays = incidence(lens, points, limited)
    height, slope = lens.image_height.value_and_slope(rays.theta)
    ex, ey = rays.ex, rays.ey
    with np.errstate(divide='ignore', invalid='ignore'):
        per_clearance = slope / rays.clearance
        across = np.where(rays.radius > 0, height / rays.radius, per_clearance)
        along = per_clearance * rays.cos
        axial = -per_clearance * rays.sin
    d_point = np.empty((*height.shape, 2, 3))
    mixed = (along - across) * ex * ey
    d_point[..., 0, 0] = lens.fx * (along * ex * ex + across * ey * ey)
    d_point[..., 0, 1] = lens.fx * mixed
    d_point[..., 0, 2] = lens.fx * axial * ex
    d_point[..., 1, 0] = lens.fy * mixed
    d_point[..., 1, 1] = lens.fy * (along * ey * ey + across * ex * ex)
    d_point[..., 1, 2] = lens.fy * axial * ey
    d_height = np.stack([lens.fx * ex, lens.fy * ey], axis=-1)
    d_shift = -d_point[..., 2]
    uv = _image_points(lens, rays, height)
    return LinearImage(uv, rays.valid, d_point, d_height, d_shift, rays)


def lens_columns(lens: Lens, image: LinearImage, names: Sequence[str]) -> Array:
    """Derivatives (..., 2, K) of linearised image points by named lens parameters.

    Raises LensError for a name the lens does not have.
    """
    theta = image.incidence.theta
    height, _ = lens.image_height.value_and_slope(theta)
    h = image.d_height * height[..., None]
    columns: dict[str, Array] = {
        'f': np.stack([h[..., 0] / lens.fx, h[..., 1] / lens.fy], axis=-1),
        'fx': np.stack([h[..., 0] / lens.fx, np.zeros_like(theta)], axis=-1),
        'fy': np.stack([np.zeros_like(theta), h[..., 1] / lens.fy], axis=-1),
        'cx': np.broadcast_to([1.0, 0.0], image.uv.shape),
        'cy': np.broadcast_to([0.0, 1.0], image.uv.shape),
    }
    for curve, derivative in (
        (lens.image_height, image.d_height),
        (lens.viewpoint_shift, image.d_shift),
    ):
        if curve is not None and set(curve.coefficient_names) & set(names):
            by_coefficient = curve.columns(theta)
            for i, name in enumerate(curve.coefficient_names):
                columns[name] = derivative * by_coefficient[..., i, None]
    unknown = [name for name in names if name not in columns]
    if unknown:
        raise LensError(f'lens {lens.name!r} has no parameter {unknown[0]!r}')
    if not names:
        return np.empty((*theta.shape, 2, 0))
    return np.stack([columns[name] for name in names], axis=-1)


def back_project(lens: Lens, uv: Array) -> Rays:
    """Return the rays of image points (..., 2), px: origin (0, 0, s(theta)), unit direction.

    Image points outside the field of view come back as NaN with valid False.
    """
    mx = (np.asarray(uv[..., 0], dtype=float) - lens.cx) / lens.fx
    my = (np.asarray(uv[..., 1], dtype=float) - lens.cy) / lens.fy
    height = np.sqrt(mx * mx + my * my)
    edge, _ = lens.image_height.value_and_slope(np.asarray(lens.max_incidence))
    valid = height <= edge + _ANGLE_SLACK
    angle = np.minimum(lens.image_height.angle(height), lens.max_incidence)
    theta = np.where(valid, angle, np.nan)
    inverse = 1 / np.where(height > 0, height, 1.0)
    sin = np.sin(theta)
    direction = np.stack([sin * mx * inverse, sin * my * inverse, np.cos(theta)], axis=-1)
    origin = np.zeros_like(direction)
    if lens.viewpoint_shift is not None:
        origin[..., 2] = lens.viewpoint_shift.value_and_slope(theta, np.tan(theta / 2))[0]
    return Rays(np.where(valid[..., None], origin, np.nan), direction, theta, valid)


def unique_range(lens: Lens) -> float:
    """Nearest distance from the camera's origin beyond which every point has at most one ray, m.

    It is the outermost point of the caustic that the rays up to `max_incidence` envelop.
    """
    if lens.viewpoint_shift is None:
        return 0.0
    return _caustic_range(lens.viewpoint_shift, lens.max_incidence)


def _caustic_range(shift: ViewpointShift, limit: float) -> float:
    theta = np.linspace(0.0, min(limit, np.pi - _MARGIN), 257)
    value, slope = shift.value_and_slope(theta, np.tan(theta / 2))
    along = slope * np.sin(theta)
    outer = np.hypot(along * np.sin(theta), value + along * np.cos(theta))
    # A viewpoint ahead of the origin hides what lies between the two, caustic or not.
    return float(max(np.max(outer[along > 0], initial=0.0), np.max(np.abs(value))))


def _newton(
    shift: ViewpointShift, r: Array, z: Array, t: Array
) -> tuple[Array, Array, Mask]:
    """Newton steps in t = tan(theta / 2), in which the ray equation is rational."""
    step = np.zeros_like(t)
    for _ in range(_NEWTON_STEPS):
        value, slope = shift.value_and_slope(2 * np.arctan(t), t)
        reach = z - value
        step = r * (1 - t * t) - 2 * reach * t
        step /= 2 * r * t + 2 * reach - 4 * t * slope / (1 + t * t)
        t = np.maximum(t + step, 0.0)
    return 2 * np.arctan(t), t, np.abs(step) < _SETTLED * (1 + t)


def _scan(shift: ViewpointShift, limit: float, r: Array, z: Array) -> Array:
    """Find the smallest root up to `limit` of the ray equation of points (N,); NaN for none."""
    low = np.zeros((len(r), 1))
    high = np.full((len(r), 1), limit)
    for _ in range(2):
        grid = low + (high - low) * np.linspace(0, 1, 65)
        values, _ = _ray_equation(shift, r[:, None], z[:, None], grid)
        falls = (values[:, :-1] >= 0) & (values[:, 1:] < 0)
        found = falls.any(axis=1)
        # Where no sign changes, two roots may hide between neighbours of the lowest value.
        lowest = np.clip(np.argmin(values, axis=1), 1, 63)
        first = np.argmax(falls, axis=1)
        left = np.where(found, first, lowest - 1)[:, None]
        right = np.where(found, first + 1, lowest + 1)[:, None]
        low = np.take_along_axis(grid, left, axis=1)
        high = np.take_along_axis(grid, right, axis=1)
    theta = np.full(len(r), np.nan)
    if found.any():
        theta[found] = _bracketed(shift, r[found], z[found], low[found, 0], high[found, 0])
    return theta


def _bracketed(shift: ViewpointShift, r: Array, z: Array, low: Array, high: Array) -> Array:
    """Newton steps that fall back to halving the bracket; the equation falls through zero."""
    theta = (low + high) / 2
    for _ in range(_HALVINGS):
        value, slope = _ray_equation(shift, r, z, theta)
        low, high = np.where(value >= 0, theta, low), np.where(value >= 0, high, theta)
        step = theta - value / slope
        inside = (step >= low) & (step <= high)
        before, theta = theta, np.where(inside, step, (low + high) / 2)
        if np.all(np.abs(theta - before) < _EXACT):
            break
    return theta


def _ray_equation(shift: ViewpointShift, r: Array, z: Array, theta: Array) -> tuple[Array, Array]:
    """Return r cos(theta) - (Z - s(theta)) sin(theta) and its derivative."""
    value, slope = shift.value_and_slope(theta, np.tan(theta / 2))
    sin, cos, reach = np.sin(theta), np.cos(theta), z - value
    return r * cos - reach * sin, slope * sin - r * sin - reach * cos


def _image_points(lens: Lens, rays: Incidence, height: Array) -> Array:
    uv = np.empty((*height.shape, 2))
    uv[..., 0] = lens.cx + lens.fx * height * rays.ex
    uv[..., 1] = lens.cy + lens.fy * height * rays.ey
    uv[~rays.valid] = np.nan
    return uv
