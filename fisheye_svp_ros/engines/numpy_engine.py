"""The reference engine: NumPy, in blocks that stay in a processor's cache."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.curves import height_at
from fisheye_svp_ros.engines.answers import Seen
from fisheye_svp_ros.engines.rays import Incidence, meet
from fisheye_svp_ros.formulas import NOWHERE, point_derivatives
from fisheye_svp_ros.lens import Lens

_BLOCK = 12_000  # points; rows a power of two apart would share the same lines of the cache


def incidence(lens: Lens, points: Array, limited: bool) -> Incidence:
    """Do as `engines.incidence` says."""
    parts = [_meet(lens, _rows(points[part]), limited) for part in _blocks(len(points))]
    return Incidence(*(np.concatenate(field, axis=-1) for field in zip(*parts, strict=True)))


def project(lens: Lens, points: Array, limited: bool) -> tuple[Array, Mask]:
    """Do as `engines.project` says."""
    uv, valid = np.empty((2, len(points))), np.empty(len(points), dtype=bool)
    for part in _blocks(len(points)):
        rays = _meet(lens, _rows(points[part]), limited)
        height, _ = height_at(lens.image_height, rays.theta, rays.sin, rays.cos)
        valid[part] = rays.valid
        _image(lens, rays, height, uv[:, part])
    return uv.T, valid


def linearise(lens: Lens, points: Array, limited: bool) -> tuple[Array, Mask, Array]:
    """Do as `engines.linearise` says."""
    count = len(points)
    uv, valid, d_point = np.empty((2, count)), np.empty(count, dtype=bool), np.empty((2, 3, count))
    for part in _blocks(count):
        rays = _meet(lens, _rows(points[part]), limited)
        height, parts = _derivatives(lens, rays)
        valid[part] = rays.valid
        _image(lens, rays, height, uv[:, part])
        _by_place(rays, parts, _pair(lens.fx, lens.fy, uv), d_point[..., part])
    return uv.T, valid, np.moveaxis(d_point, -1, 0)


def linearise_views(
    lens: Lens, rotation: Array, position: Array, points: Array, limited: bool
) -> tuple[Array, Mask, Array]:
    """Do as `engines.linearise_views` says."""
    shape = points.shape[:2]
    uv, valid = np.empty((2, *shape)), np.empty(shape, dtype=bool)
    d_pose = np.empty((2, shape[0], 6, shape[1]))
    for part in _tiles(*shape):
        arm, local = _seen(rotation, position, points, part)
        rays = _meet(lens, local, limited)
        height, parts = _derivatives(lens, rays)
        valid[part] = rays.valid
        _image(lens, rays, height, uv[:, *part])
        own = np.empty((2, 3, *rays.theta.shape))
        _by_place(rays, parts, _pair(-lens.fx, -lens.fy, uv), own)  # the camera moves
        own = np.swapaxes(rotation[part[0]] @ np.swapaxes(own, 1, 2), 1, 2)
        out = np.swapaxes(d_pose[:, part[0], :, part[1]], 1, 2)
        out[:, :3] = own
        _cross(arm, own, out[:, 3:])
    return np.moveaxis(uv, 0, -1), valid, d_pose.transpose(1, 3, 0, 2)


def pose_equations(
    lens: Lens, rotation: Array, position: Array, seen: Seen
) -> tuple[Array, Array, Array]:
    """Do as `engines.pose_equations` says."""
    points, uv, weight = seen
    systems, count = weight.shape
    gram = np.zeros((systems, 7, 7))
    for part in _tiles(systems, count):
        _, local = _seen(rotation, position, points, part)
        unused = weight[part] == 0
        if unused.any():
            local[:, unused] = np.array([[0.0], [0.0], [1.0]])
        rays = _meet(lens, local, False)
        height, parts = _derivatives(lens, rays)
        rows = np.empty((len(unused), 7, 2, unused.shape[1]))
        out = np.moveaxis(rows, (1, 2), (1, 0))
        _by_place(rays, parts, _pair(lens.fx, lens.fy, out[:, 0]) * weight[part], out[:, :3])
        _cross(out[:, :3], local, out[:, 3:6])
        _image(lens, rays, height, out[:, 6])
        out[:, 6] -= np.moveaxis(uv[part], -1, 0)
        out[:, 6] *= weight[part]
        flat = rows.reshape(len(rows), 7, -1)
        gram[part[0]] += flat @ np.swapaxes(flat, -1, -2)
    return _in_world(gram, rotation)


def localize(*_: object) -> None:
    """Leave it to `solve.localization`."""


def adjust_rigs(*_: object) -> None:
    """Leave it to `solve.stereo_calibration`."""


def _blocks(count: int) -> Iterator[slice]:
    for start in range(0, max(count, 1), _BLOCK):
        yield slice(start, start + _BLOCK)


def _tiles(systems: int, count: int) -> Iterator[tuple[slice, slice]]:
    """Blocks of whole systems or, where one alone is larger, of its points."""
    many = max(1, _BLOCK // max(count, 1))
    for first in range(0, systems, many):
        for part in _blocks(count):
            yield slice(first, first + many), part


def _rows(points: Array) -> Array:
    """Return a copy of points (M, 3) as rows (3, M), in which NumPy is faster."""
    return np.array(points.T, order='C')


def _meet(lens: Lens, local: Array, limited: bool) -> Incidence:
    """Return where points (3, ...) in the camera frame meet the lens; moves those on its axis."""
    local[0] += NOWHERE
    with np.errstate(divide='ignore', invalid='ignore'):
        return meet(lens, local, limited)


def _seen(
    rotation: Array, position: Array, points: Array, part: tuple[slice, slice]
) -> tuple[Array, Array]:
    """Return a tile's points from their cameras, along the axes of the world and of the camera.

    Both (3, S, N).
    """
    arm = np.subtract(np.moveaxis(points[part], -1, 0), position[part[0]].T[..., None], order='C')
    local = np.empty_like(arm)
    turned = np.swapaxes(rotation[part[0]], -1, -2)
    np.matmul(turned, np.swapaxes(arm, 0, 1), out=np.swapaxes(local, 0, 1))
    return arm, local


def _derivatives(lens: Lens, rays: Incidence) -> tuple[Array, tuple[Array, Array, Array]]:
    """Return the image height and what `formulas.point_derivatives` does."""
    height, slope = height_at(lens.image_height, rays.theta, rays.sin, rays.cos)
    with np.errstate(divide='ignore', invalid='ignore'):
        parts = point_derivatives(
            height, slope, rays.sin, rays.cos, rays.radius, rays.clearance
        )
    return height, parts


def _image(lens: Lens, rays: Incidence, height: Array, out: Array) -> None:
    """Write image points (2, ...), px, NaN where there is none."""
    np.multiply(height, rays.unit, out=out)
    out *= _pair(lens.fx, lens.fy, out)
    out += _pair(lens.cx, lens.cy, out)
    if not rays.valid.all():
        out[:, ~rays.valid] = np.nan


def _by_place(
    rays: Incidence, parts: tuple[Array, Array, Array], scale: Array, out: Array
) -> None:
    """Write the derivatives (2, 3, ...) of `scale` h/f by a point's place in the camera frame.

    scale (2, ...): of u and of v.
    """
    across, along, axial = parts
    height = rays.unit * scale
    np.multiply((along * height)[:, None], rays.unit, out=out[:, :2])
    out[0, 0] += across * scale[0]
    out[1, 1] += across * scale[1]
    np.multiply(axial, height, out=out[:, 2])


def _cross(a: Array, b: Array, out: Array) -> None:
    """Write cross products (..., 3, S, N) of vectors.

    Of an arm with derivatives by place they are those by turn.
    """
    (a0, a1, a2), (b0, b1, b2) = np.moveaxis(a, -3, 0), np.moveaxis(b, -3, 0)
    np.subtract(a1 * b2, a2 * b1, out=out[..., 0, :, :])
    np.subtract(a2 * b0, a0 * b2, out=out[..., 1, :, :])
    np.subtract(a0 * b1, a1 * b0, out=out[..., 2, :, :])


def _pair(u: float, v: float, like: Array) -> Array:
    """Return two numbers to be applied to rows (2, ...)."""
    return np.array([u, v]).reshape(2, *(1,) * (like.ndim - 1))


def _in_world(gram: Array, rotation: Array) -> tuple[Array, Array, Array]:
    """Turn sums of products of camera-frame rows (by place, by turn, residual) into equations."""
    turn = np.zeros((len(gram), 6, 6))
    turn[:, :3, :3], turn[:, 3:, 3:] = -rotation, rotation  # the camera moves, not the point
    hessian = turn @ gram[:, :6, :6] @ np.swapaxes(turn, -1, -2)
    gradient = (turn @ gram[:, :6, 6:])[..., 0]
    cost = gram[:, 6, 6]
    outside = ~np.isfinite(cost)
    if outside.any():
        hessian[outside], gradient[outside], cost[outside] = np.eye(6), 0.0, np.inf
    return cost, hessian, gradient
