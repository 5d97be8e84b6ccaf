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
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.optics import engines
from fisheye_svp_ros.optics.engines import port_projection
from fisheye_svp_ros.optics.engines.results import Incidence as Incidence
from fisheye_svp_ros.optics.lens import INTRINSICS, Lens, curve_limit
from fisheye_svp_ros.optics.rays import caustic_range

_EDGE_SLACK = 1e-9  # of h/f; keeps image points exactly at the edge of the field inside it


class Image(NamedTuple):
    """Image points (..., 2), px, NaN where `valid` (...) is False."""

    uv: Array
    valid: Mask


@dataclass(frozen=True)
class LinearImage:
    """Image points of points (..., 3), m, in the camera frame, and their derivatives.

    uv (..., 2), px; valid (...); d_point (..., 2, 3), px/m; limited: see `incidence`.
    """

    lens: Lens
    points: Array
    limited: bool
    uv: Array
    valid: Mask
    d_point: Array

    @cached_property
    def incidence(self) -> Incidence:
        """Where the points have their ray through the lens."""
        if self.lens.port is not None:
            return _reshape(
                port_projection.met(self.lens, self._sight, self.limited), self.points.shape[:-1]
            )
        return incidence(self.lens, self.points, self.limited)

    @property
    def d_height(self) -> Array:
        """Derivatives (..., 2) by the image height, px for unit h/f."""
        return self.through_field(self._along_radius[..., None], of_ray=False)[..., 0]

    @property
    def d_shift(self) -> Array:
        """Derivatives (..., 2) by the viewpoint shift, px/m."""
        return -self.d_point[..., 2] if self.lens.port is None else self._behind_port[0]

    @property
    def d_port(self) -> Array:
        """Derivatives (..., 2, K) by the coefficients of the port."""
        return self._behind_port[1]

    def d_intrinsics(self) -> dict[str, Array]:
        """Return derivatives (..., 2) by f, fx, fy, cx and cy."""
        lens = self.lens
        place = lens.displace_tangentially(self._by_curve)
        u, v = np.moveaxis((place - (lens.cx, lens.cy)) / (lens.fx, lens.fy), -1, 0)
        zero, ones = np.zeros_like(u), np.ones_like(u)
        columns = np.stack(
            [
                np.stack([u, u, zero, ones, zero], axis=-1),
                np.stack([v, zero, v, zero, ones], axis=-1),
            ],
            axis=-2,
        )
        if lens.image_field is not None:
            columns = lens.image_field.carry(place, columns)
        return dict(zip(('f', *INTRINSICS), np.moveaxis(columns, -1, 0), strict=True))

    def through_field(self, columns: Array, of_ray: bool = True) -> Array:
        """Return derivatives (..., 2, P) of image points from those of the curve's alone.

        of_ray: see `Lens.carry`.
        """
        return self.lens.carry(self._by_curve, columns, of_ray) if self.lens.displaces else columns

    @property
    def _by_curve(self) -> Array:
        """Image points (..., 2), px, as the curve alone gives them."""
        height, _ = self.lens.image_height.value_and_slope(self.incidence.theta)
        return self._along_radius * height[..., None] + [self.lens.cx, self.lens.cy]

    @property
    def _along_radius(self) -> Array:
        """Derivatives (..., 2) of ideal image points by the image height, px for unit h/f."""
        rays = self.incidence
        return np.stack([self.lens.fx * rays.unit[0], self.lens.fy * rays.unit[1]], axis=-1)

    @cached_property
    def _sight(self) -> port_projection.Sight:
        return port_projection.sight(self.lens, self.points.reshape(-1, 3))

    @cached_property
    def _behind_port(self) -> tuple[Array, Array]:
        shift, port = port_projection.port_columns(self.lens, self._sight)
        shape = (*self.points.shape[:-1], 2)
        columns = np.concatenate([shift[..., None], port], axis=-1).reshape(*shape, -1)
        columns = self.through_field(columns)
        return columns[..., 0], columns[..., 1:]


class Rays(NamedTuple):
    """Rays of image points: origin (..., 3), m; direction (..., 3), unit; theta, valid (...)."""

    origin: Array
    direction: Array
    theta: Array
    valid: Mask

    def reshape(self, shape: tuple[int, ...]) -> Rays:
        """Return as many rays in another leading shape."""
        return Rays(
            self.origin.reshape(*shape, 3),
            self.direction.reshape(*shape, 3),
            self.theta.reshape(shape),
            self.valid.reshape(shape),
        )


def incidence(lens: Lens, points: Array, limited: bool = True) -> Incidence:
    """Solve r cos(theta) - (Z - s(theta)) sin(theta) = 0 for points (..., 3), m.

    limited: also refuse angles past the lens's `max_incidence`; a solver on its way does not.
    Source: Kita, section 2 and figure 2.
    """
    return _reshape(engines.incidence(lens, points.reshape(-1, 3), limited), points.shape[:-1])


def _reshape(fields: Incidence, shape: tuple[int, ...]) -> Incidence:
    return Incidence._make(field.reshape((*field.shape[:-1], *shape)) for field in fields)


def project(lens: Lens, points: Array, limited: bool = True) -> Image:
    """Project points (..., 3), m, in the camera frame to image points (..., 2), px.

    limited: see `incidence`.  Points outside the domain come back as NaN with valid False.
    """
    uv, valid = engines.project(lens, points.reshape(-1, 3), limited)
    return Image(uv.reshape(*points.shape[:-1], 2), valid.reshape(points.shape[:-1]))


def project_with_jacobian(lens: Lens, points: Array, limited: bool = True) -> LinearImage:
    """Project points (..., 3), m, and differentiate by the point and by both lens curves.

    limited: see `incidence`.
    """
    shape = points.shape[:-1]
    still = np.eye(3)[None], np.zeros((1, 3))
    uv, valid, d_pose = engines.linearize_views(lens, *still, points.reshape(1, -1, 3), limited)
    d_point = -d_pose[..., :3]  # the camera moves the other way
    return LinearImage(
        lens,
        points,
        limited,
        uv.reshape(*shape, 2),
        valid.reshape(shape),
        d_point.reshape(*shape, 2, 3),
    )


def lens_columns(lens: Lens, image: LinearImage, names: Sequence[str]) -> Array:
    """Derivatives (..., 2, K) of linearized image points by named lens parameters.

    Raises LensError for a name the lens does not have.
    """
    theta = image.incidence.theta
    columns = image.d_intrinsics()
    for curve, derivative in (
        (lens.image_height, image.d_height),
        (lens.viewpoint_shift, image.d_shift),
    ):
        if curve is not None and set(curve.coefficient_names) & set(names):
            by_coefficient = curve.columns(theta)
            for i, name in enumerate(curve.coefficient_names):
                columns[name] = derivative * by_coefficient[..., i, None]
    if set(lens.port_names) & set(names):
        columns |= {name: image.d_port[..., i] for i, name in enumerate(lens.port_names)}
    unknown = [name for name in names if name not in columns]
    if unknown:
        raise LensError(f'lens {lens.name!r} has no parameter {unknown[0]!r}')
    if not names:
        return np.empty((*theta.shape, 2, 0))
    return np.stack([columns[name] for name in names], axis=-1)


def back_project(lens: Lens, uv: Array) -> Rays:
    """Return the rays of image points (..., 2), px: origin (0, 0, s(theta)), unit direction.

    Behind a port the ray is that in the medium, and its origin where, followed back, it passes the
    camera's origin; theta is that in air.  Image points outside the field of view come back as NaN
    with valid False.
    """
    uv = lens.undo_displacement(uv) if lens.displaces else uv
    mx = (np.asarray(uv[..., 0], dtype=float) - lens.cx) / lens.fx
    my = (np.asarray(uv[..., 1], dtype=float) - lens.cy) / lens.fy
    height = np.sqrt(mx * mx + my * my)
    # A curve that a fit has on its way, or without some frames, may turn back earlier.
    end = min(lens.max_incidence, curve_limit(lens))
    edge, _ = lens.image_height.value_and_slope(np.asarray(end))
    valid = height <= edge + _EDGE_SLACK
    angle = np.minimum(lens.image_height.angle(height), end)
    theta = np.where(valid, angle, np.nan)
    inverse = 1 / np.where(height > 0, height, 1.0)
    sin = np.sin(theta)
    direction = np.stack([sin * mx * inverse, sin * my * inverse, np.cos(theta)], axis=-1)
    origin = np.zeros_like(direction)
    if lens.viewpoint_shift is not None:
        origin[..., 2] = lens.shift_at(theta)
    if lens.port is not None:
        origin_on_port, way = port_projection.trace_rays(lens, direction.reshape(-1, 3))
        back = (origin_on_port.value * way.value).sum(axis=0)
        origin = (origin_on_port.value - back * way.value).T.reshape(direction.shape)
        direction = way.value.T.reshape(direction.shape)
        valid &= np.isfinite(direction).all(axis=-1)
    return Rays(np.where(valid[..., None], origin, np.nan), direction, theta, valid)


def unique_range(lens: Lens) -> float:
    """Nearest distance from the camera's origin beyond which every point has at most one ray, m.

    It is the outermost point of the caustic that the rays up to `max_incidence` envelop; nothing
    is seen through a port that is not behind it.
    """
    if lens.port is not None:
        return max(unique_range(replace(lens, port=None)), lens.port.reach)
    if lens.viewpoint_shift is None:
        return 0.0
    return caustic_range(lens.viewpoint_shift, lens.max_incidence)
