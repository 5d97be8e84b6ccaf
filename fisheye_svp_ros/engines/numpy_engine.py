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

Scale = Array | float

_BLOCK = 8192  # points; larger ones make malloc ask the system for every array


def incidence(lens: Lens, points: Array, limited: bool) -> Incidence:
    """Do as `engines.incidence` says."""
    parts = [_meet(lens, points[part], limited) for part in _blocks(len(points))]
    return Incidence(*(np.concatenate(field) for field in zip(*parts, strict=True)))


def project(lens: Lens, points: Array, limited: bool) -> tuple[Array, Mask]:
    """Do as `engines.project` says."""
    uv, valid = np.empty((len(points), 2)), np.empty(len(points), dtype=bool)
    for part in _blocks(len(points)):
        rays = _meet(lens, points[part], limited)
        height, _ = height_at(lens.image_height, rays.theta, rays.sin, rays.cos)
        uv[part], valid[part] = _image(lens, rays, height).T, rays.valid
    return uv, valid


def linearise(lens: Lens, points: Array, limited: bool) -> tuple[Array, Mask, Array]:
    """Do as `engines.linearise` says."""
    count = len(points)
    uv, valid, d_point = np.empty((count, 2)), np.empty(count, dtype=bool), np.empty((2, 3, count))
    for part in _blocks(count):
        rays = _meet(lens, points[part], limited)
        height, parts = _derivatives(lens, rays)
        uv[part], valid[part] = _image(lens, rays, height).T, rays.valid
        _by_place(rays, parts, (lens.fx, lens.fy), d_point[..., part])
    return uv, valid, np.moveaxis(d_point, -1, 0)


def linearise_views(
    lens: Lens, rotation: Array, position: Array, points: Array, limited: bool
) -> tuple[Array, Mask, Array]:
    """Do as `engines.linearise_views` says."""
    shape = points.shape[:2]
    uv, valid = np.empty((*shape, 2)), np.empty(shape, dtype=bool)
    d_pose = np.empty((shape[0], 2, 2, 3, shape[1]))
    for part in _tiles(*shape):
        rays, z = _seen(lens, rotation, position, points, part, limited)
        height, parts = _derivatives(lens, rays)
        uv[part], valid[part] = np.moveaxis(_image(lens, rays, height), 0, -1), rays.valid
        own = np.empty((2, 2, 3, *z.shape))
        _by_place(rays, parts, (-lens.fx, -lens.fy), own[:, 0])
        _by_turn(rays, parts, z, (lens.fx, lens.fy), own[:, 1])
        own = np.moveaxis(own, 3, 0)
        np.matmul(rotation[part[0], None, None], own, out=d_pose[part[0], ..., part[1]])
    return uv, valid, np.moveaxis(d_pose.reshape(shape[0], 2, 6, shape[1]), -1, 1)


def pose_equations(
    lens: Lens, rotation: Array, position: Array, seen: Seen
) -> tuple[Array, Array, Array]:
    """Do as `engines.pose_equations` says."""
    points, uv, weight = seen
    systems, count = weight.shape
    gram = np.zeros((systems, 7, 7))
    for part in _tiles(systems, count):
        unused = weight[part] == 0
        rays, z = _seen(lens, rotation, position, points, part, False, unused)
        height, parts = _derivatives(lens, rays)
        scale = lens.fx * weight[part], lens.fy * weight[part]
        rows = np.empty((len(z), 7, 2, z.shape[1]))
        out = np.moveaxis(rows, (1, 2), (1, 0))
        _by_place(rays, parts, scale, out[:, :3])
        _by_turn(rays, parts, z, scale, out[:, 3:6])
        off = _image(lens, rays, height) - np.moveaxis(uv[part], -1, 0)
        np.multiply(off, weight[part], out=out[:, 6])
        flat = rows.reshape(len(z), 7, -1)
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


def _meet(lens: Lens, points: Array, limited: bool) -> Incidence:
    x, y, z = (points[..., i] for i in range(3))
    with np.errstate(divide='ignore', invalid='ignore'):
        return meet(lens, x + NOWHERE, np.ascontiguousarray(y), np.ascontiguousarray(z), limited)


def _seen(
    lens: Lens, rotation: Array, position: Array, points: Array, part: tuple[slice, slice],
    limited: bool, unused: Mask | None = None,
) -> tuple[Incidence, Array]:
    """Return where a tile's points meet the lens, and their z in the camera frame."""
    local = (points[part] - position[part[0], None]) @ rotation[part[0]]
    if unused is not None and unused.any():
        local[unused] = 0.0, 0.0, 1.0
    return _meet(lens, local, limited), np.ascontiguousarray(local[..., 2])


def _derivatives(lens: Lens, rays: Incidence) -> tuple[Array, tuple[Array, Array, Array]]:
    """Return the image height and what `formulas.point_derivatives` does."""
    height, slope = height_at(lens.image_height, rays.theta, rays.sin, rays.cos)
    with np.errstate(divide='ignore', invalid='ignore'):
        parts = point_derivatives(
            height, slope, rays.sin, rays.cos, rays.radius, rays.clearance
        )
    return height, parts


def _image(lens: Lens, rays: Incidence, height: Array) -> Array:
    """Return image points (2, ...), px, NaN where there is none."""
    uv = np.empty((2, *height.shape))
    for out, focal, unit, centre in (
        (uv[0], lens.fx, rays.ex, lens.cx), (uv[1], lens.fy, rays.ey, lens.cy)
    ):
        np.multiply(height, unit, out=out)
        out *= focal
        out += centre
    if not rays.valid.all():
        uv[:, ~rays.valid] = np.nan
    return uv


def _by_place(
    rays: Incidence, parts: tuple[Array, Array, Array], scale: tuple[Scale, Scale], out: Array
) -> None:
    """Write the derivatives (2, 3, ...) of `scale` h/f by a point's place in the camera frame."""
    across, along, axial = parts
    unit = rays.ex, rays.ey
    for i in range(2):
        e = unit[i] * scale[i]
        steep = along * e
        np.multiply(steep, rays.ex, out=out[i, 0])
        np.multiply(steep, rays.ey, out=out[i, 1])
        out[i, i] += across * scale[i]
        np.multiply(axial, e, out=out[i, 2])


def _by_turn(
    rays: Incidence, parts: tuple[Array, Array, Array], z: Array, scale: tuple[Scale, Scale],
    out: Array,
) -> None:
    """Write the derivatives (2, 3, ...) of `scale` h/f by turns of the camera about its axes."""
    across, along, axial = parts
    ex, ey = rays.ex, rays.ey
    level, tilted = across * z, along * z - axial * rays.radius
    height = across * rays.radius
    for i, (e, sideways) in enumerate(((ex, ey), (ey, -ex))):
        swung = tilted * (e * scale[i])
        np.multiply(swung, ey, out=out[i, 0])
        np.multiply(swung, -ex, out=out[i, 1])
        np.multiply(height, sideways * scale[i], out=out[i, 2])
    out[0, 1] -= level * scale[0]
    out[1, 0] += level * scale[1]


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
