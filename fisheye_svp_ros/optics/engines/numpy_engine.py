"""The reference engine: NumPy, in blocks that stay in a processor's cache.

For single views masks are counted: that takes a tenth of the time of `any` and `all`.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.optics.engines.results import Incidence, Seen
from fisheye_svp_ros.optics.formulas import AXIS_EPS, point_derivatives
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.optics.rays import RaySolution, solve_incidence

_BLOCK = 16_700  # points; rows a power of two apart would share the same lines of the cache

# What the derivatives of a place in the image add up to, (3, 2, 6): by a point's x, y, z in the
# camera frame, or by a turn of the point about these axes; of u, v; the terms of `_add_up`.
_INTRINSICS_JACOBIAN = np.array(
    [
        [[1, 0, 1, 0, 0, 0], [0, 0, 0, 1, 0, 0]],
        [[0, 0, 0, 1, 0, 0], [0, 1, -1, 0, 0, 0]],
        [[0, 0, 0, 0, -1, 0], [0, 0, 0, 0, 0, -1]],
    ],
    dtype=float,
)
_TURN = np.array(
    [
        [[0, 0, 0, -1, 0, 0], [-1, -1, 1, 0, 0, 0]],
        [[1, 0, 1, 0, 0, 0], [0, 0, 0, 1, 0, 0]],
        [[0, 0, 0, 0, 0, -1], [0, 0, 0, 0, 1, 0]],
    ],
    dtype=float,
)
_BY_CAMERA = -np.array([_INTRINSICS_JACOBIAN, _TURN])  # which moves the other way
_IMAGE = np.eye(2, 6, 4)  # the place itself: the last terms by turn

# Where there is no image, there is something to divide by zero.
_quiet = np.errstate(divide='ignore', invalid='ignore')


@_quiet
def incidence(lens: Lens, points: Array, limited: bool) -> Incidence:
    """See `engines.incidence`."""
    theta, valid = np.empty(len(points)), np.empty(len(points), dtype=bool)
    unit = np.empty((2, len(points)))
    for part in _point_blocks(len(points)):
        met = _solved_incidence(lens, _point_rows(points[part]), limited)
        theta[part], valid[part] = met.theta, met.valid
        np.divide((met.x, met.y), met.r, out=unit[:, part])
    return Incidence(theta, unit, valid)


@_quiet
def project(lens: Lens, points: Array, limited: bool) -> tuple[Array, Mask]:
    """See `engines.project`."""
    uv, valid = np.empty((2, len(points))), np.empty(len(points), dtype=bool)
    for part in _point_blocks(len(points)):
        met = _solved_incidence(lens, _point_rows(points[part]), limited)
        ratio, _ = met.height(lens.image_height)
        ratio /= met.r
        np.multiply(met.x, ratio, out=uv[0, part])
        np.multiply(met.y, ratio, out=uv[1, part])
        uv[:, part] *= _number_pair(lens.fx, lens.fy, 2)
        _center(lens, met.valid, uv[:, part])
        valid[part] = met.valid
    return uv.T, valid


@_quiet
def linearize_views(
    lens: Lens, rotation: Array, position: Array, points: Array, limited: bool
) -> tuple[Array, Mask, Array]:
    """See `engines.linearize_views`."""
    shape = points.shape[:2]
    uv, valid = np.empty((2, *shape)), np.empty(shape, dtype=bool)
    d_pose, sums = np.empty((12, *shape)), _sums(lens, rotation)
    for part in _point_tiles(*shape):
        local = _to_cameras(rotation, position, points, part)
        met = _solved_incidence(lens, local, limited)
        out = (rows[:, *part].swapaxes(0, 1) for rows in (d_pose, uv))
        _add_up(sums[part[0]], met, met.height(lens.image_height), *out)
        _center(lens, met.valid, uv[:, *part])
        valid[part] = met.valid
    d_pose = d_pose.reshape(6, 2, *shape)
    return uv.transpose(1, 2, 0), valid, d_pose.transpose(2, 3, 1, 0)


@_quiet
def pose_equations(
    lens: Lens, rotation: Array, position: Array, seen: Seen
) -> tuple[Array, Array, Array]:
    """Return costs (S,) and normal equations (S, 6, 6), (S, 6) of single poses, of a bare lens.

    rotation (S, 3, 3), position (S, 3): cameras in the world.  A point without an image costs
    infinity, unless its weight is 0.
    """
    points, uv, weight = seen
    systems, count = weight.shape
    cost, gram = np.zeros(systems), np.zeros((systems, 6, 7))
    sums, center = _sums(lens, rotation), _number_pair(lens.cx, lens.cy, 3)
    for part in _point_tiles(systems, count):
        tile, weights = part[0], weight[part]
        local = _to_cameras(rotation, position, points, part)
        if np.count_nonzero(weights) < weights.size:
            local[:, weights == 0] = np.array([[0.0], [0.0], [1.0]])
        met = _solved_incidence(lens, local, False)
        height, slope = met.height(lens.image_height)
        height *= weights
        slope *= weights
        rows = np.empty((len(weights), 14, weights.shape[1]))
        _add_up(sums[tile], met, (height, slope), rows[:, :12], rows[:, 12:])
        off = rows[:, 12:].transpose(1, 0, 2)
        off -= (uv[part].transpose(2, 0, 1) - center) * weights
        if np.count_nonzero(met.valid) < met.valid.size:
            off[:, ~met.valid] = np.nan
        cost[tile] += np.einsum('usn,usn->s', off, off)
        flat = rows.reshape(len(rows), 7, -1)
        # All seven times all seven would be BLAS's syrk, which is slower at this size.
        gram[tile] += flat[:, :6] @ flat.swapaxes(1, 2)
    outside = ~np.isfinite(cost)
    if np.count_nonzero(outside):
        cost[outside], gram[outside] = np.inf, np.eye(6, 7)
    return cost, gram[..., :6], gram[..., 6]


def localize(*_: object) -> None:
    """Leave it to `solve.localization`."""


def adjust_rigs(*_: object) -> None:
    """Leave it to `solve.stereo_calibration`."""


def _point_blocks(count: int) -> Iterator[slice]:
    for start in range(0, max(count, 1), _BLOCK):
        yield slice(start, start + _BLOCK)


def _point_tiles(systems: int, count: int) -> Iterator[tuple[slice, slice]]:
    """Blocks of whole systems or, where one alone is larger, of its points."""
    many = max(1, _BLOCK // max(count, 1))
    for first in range(0, systems, many):
        for part in _point_blocks(count):
            yield slice(first, first + many), part


def _point_rows(points: Array) -> Array:
    """Return a copy of points (M, 3) as rows (3, M), in which NumPy is faster."""
    return np.array(points.T, order='C')


def _solved_incidence(lens: Lens, local: Array, limited: bool) -> RaySolution:
    """See `rays.solve_incidence`; moves points off the axis."""
    local[0] += AXIS_EPS
    return solve_incidence(lens, local, limited)


def _to_cameras(
    rotation: Array, position: Array, points: Array, part: tuple[slice, slice]
) -> Array:
    """Return a tile's points (3, S, N) in the frames of their cameras."""
    systems, seen = part[0], points[part].transpose(2, 0, 1)
    arm = np.array(seen, order='C')  # faster copied than subtracted
    arm -= position[systems].T[..., None]
    local = np.empty_like(arm)
    np.matmul(rotation[systems].swapaxes(1, 2), arm.swapaxes(0, 1), out=local.swapaxes(0, 1))
    return local


def _center(lens: Lens, valid: Mask, uv: Array) -> None:
    """Move image points (2, ...), px, from around the origin; NaN where there is none."""
    uv += _number_pair(lens.cx, lens.cy, uv.ndim)
    if np.count_nonzero(valid) < valid.size:
        uv[:, ~valid] = np.nan


def _add_up(
    sums: Array, met: RaySolution, height: tuple[Array, Array], d_pose: Array, uv: Array
) -> None:
    """Write derivatives by place and by turn (S, 12, N), and image points around the origin.

    height: of `RaySolution.height`; uv (S, 2, N).
    """
    x, y, z, mixed = met.x, met.y, met.z, met.x * met.y
    terms = np.empty((6, *z.shape))  # for both in turn, as it is in the cache
    by_system = terms.swapaxes(0, 1)
    ratio = np.divide(height[0], met.r, out=terms[0])
    axial = met.change(terms[1])
    _, fall, bend = point_derivatives(ratio, height[1], met.r2, terms[1], axial)
    np.multiply(met.x2, bend, out=terms[2])
    np.multiply(mixed, bend, out=terms[3])
    np.multiply(x, fall, out=terms[4])
    np.multiply(y, fall, out=terms[5])
    np.matmul(sums[:, :6], by_system, out=d_pose[:, :6])
    bend *= z
    bend += fall
    np.multiply(met.r2, bend, out=terms[1])
    np.multiply(met.x2, bend, out=terms[2])
    np.multiply(mixed, bend, out=terms[3])
    np.multiply(x, ratio, out=terms[4])
    np.multiply(y, ratio, out=terms[5])
    ratio *= z
    np.matmul(sums[:, 6:12], by_system, out=d_pose[:, 6:])
    np.matmul(sums[:, 12:], by_system, out=uv)


def _sums(lens: Lens, rotation: Array) -> Array:
    """Return which sums of terms are the rows that `_add_up` writes (S, 14, 6).

    By place: by x of u, of v, by y, ...; then by turn; then u, v themselves.
    """
    focal = _number_pair(lens.fx, lens.fy, 2)
    sums = np.empty((len(rotation), 14, 6))
    turned = rotation[:, None] @ (_BY_CAMERA * focal).reshape(2, 3, 12)
    sums[:, :12] = turned.reshape(-1, 12, 6)
    sums[:, 12:] = _IMAGE * focal
    return sums


def _number_pair(u: float, v: float, dimensions: int) -> Array:
    """Return two numbers to be applied to rows (2, ...) of some dimensions."""
    return np.array((u, v)).reshape(2, *(1,) * (dimensions - 1))
