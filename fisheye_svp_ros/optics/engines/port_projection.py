"""A lens behind a port: the ray in air that meets each point, then the lens as it is in air.

Newton's method in the two numbers of the direction, from exact derivatives; no compiled twin.
The port apart, the lens needs its direction alone, its own viewpoint having done its part.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.optics.engines import numpy_engine
from fisheye_svp_ros.optics.engines.results import Incidence
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.optics.ports import Varying
from fisheye_svp_ros.pose import cross_matrix

_STEPS = 20
_STEP_TOLERANCE = 1e-8  # rad: a last Newton step this small leaves an error of its square
_MAX_STEP = 0.2  # rad, a step
_MAX_MISS = 1e-9  # of the range, by which a ray may pass its point

_quiet = np.errstate(divide='ignore', invalid='ignore', over='ignore')


class Sight(NamedTuple):
    """Rays in air that meet points in the medium.

    direction (M, 3), unit; its derivatives by the point (M, 3, 3), by the lens's viewpoint shift
    (M, 3) and by the coefficients of the port (M, 3, K); valid (M,).
    """

    direction: Array
    d_point: Array
    d_shift: Array
    d_port: Array
    valid: Mask


@_quiet
def sight(lens: Lens, points: Array) -> Sight:
    """Find the rays in air that meet points (M, 3), m, in the medium; NaN where there is none."""
    assert lens.port is not None
    direction = lens.port.start(points)
    for _ in range(_STEPS):
        across = _across(direction)
        _, off, by_turn = _ray_miss(lens, points, direction, across)
        step = -_solve_2x2(by_turn, off[..., None])[..., 0]
        step *= _MAX_STEP / np.maximum(np.linalg.norm(step, axis=-1, keepdims=True), _MAX_STEP)
        direction = direction + (step[..., None] * across).sum(axis=1)
        direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
        if np.all(np.abs(step) < _STEP_TOLERANCE, where=np.isfinite(step)):
            break
    across = _across(direction)
    more = 1 + len(lens.port.coefficients)
    side, off, slopes = _ray_miss(lens, points, direction, across, more)
    by_turn, by_lens = slopes[..., :2], slopes[..., 2:]
    # off = 0 stays so: what moves it otherwise is taken back by a turn of the ray.
    turn = -_solve_2x2(by_turn, np.concatenate([side, by_lens], axis=-1))
    change = np.swapaxes(across, -1, -2) @ turn
    size = np.linalg.norm(points, axis=-1)
    valid = np.asarray(np.linalg.norm(off, axis=-1) < _MAX_MISS * size)
    return Sight(direction, change[..., :3], change[..., 3], change[..., 4:], valid)


def project(lens: Lens, points: Array, limited: bool) -> tuple[Array, Mask]:
    """See `engines.project`."""
    seen = sight(lens, points)
    uv, valid = numpy_engine.project(lens.svp(), seen.direction, limited)
    valid &= seen.valid
    return np.where(valid[:, None], uv, np.nan), valid


def incidence(lens: Lens, points: Array, limited: bool) -> Incidence:
    """See `engines.incidence`: of the rays in air."""
    return met(lens, sight(lens, points), limited)


def met(lens: Lens, sight: Sight, limited: bool) -> Incidence:
    """Return where rays in air meet the lens."""
    in_air = numpy_engine.incidence(lens.svp(), sight.direction, limited)
    return in_air._replace(valid=in_air.valid & sight.valid)


def port_columns(lens: Lens, sight: Sight) -> tuple[Array, Array]:
    """Return derivatives of image points by the lens's viewpoint shift (M, 2), px/m.

    And by the coefficients of its port (M, 2, K).
    """
    _, _, by_direction = _image_by_direction(lens, sight, False)
    return (by_direction @ sight.d_shift[..., None])[..., 0], by_direction @ sight.d_port


def linearize_views(
    lens: Lens, rotation: Array, position: Array, points: Array, limited: bool
) -> tuple[Array, Mask, Array]:
    """See `engines.linearize_views`."""
    shape = points.shape[:2]
    arm = points - position[:, None]
    seen = sight(lens, (arm @ rotation).reshape(-1, 3))
    uv, valid, by_direction = _image_by_direction(lens, seen, limited)
    by_point = (by_direction @ seen.d_point).reshape(*shape, 2, 3)
    by_place = by_point @ np.swapaxes(rotation, -1, -2)[:, None]
    d_pose = np.concatenate([-by_place, by_place @ cross_matrix(arm)], axis=-1)
    return uv.reshape(*shape, 2), valid.reshape(shape), d_pose


def _image_by_direction(lens: Lens, sight: Sight, limited: bool) -> tuple[Array, Mask, Array]:
    """Return image points (M, 2), validity, and derivatives (M, 2, 3) by the direction."""
    still = np.eye(3)[None], np.zeros((1, 3))
    uv, valid, d_pose = numpy_engine.linearize_views(
        lens.svp(), *still, sight.direction[None], limited
    )
    valid = valid[0] & sight.valid
    return np.where(valid[:, None], uv[0], np.nan), valid, -d_pose[0, ..., :3]


def _ray_miss(
    lens: Lens, points: Array, direction: Array, across: Array, more: int = 0
) -> tuple[Array, Array, Array]:
    """Trace rays and say by what they miss their points: across (M, 2, 3), off (M, 2), slopes.

    slopes (M, 2, 2 + more): of off by the turn of the ray in air along `across` (M, 2, 3), then by
    the lens's viewpoint shift and the coefficients of the port.
    """
    exits, way = trace_rays(lens, direction, across, more)
    arm = points.T - exits.value
    along = (arm * way.value).sum(axis=0)
    # A point between the camera and the port is not seen through it.
    along = np.where(along > 0, along, np.nan)
    side = _across(way.value.T)
    sides = np.ascontiguousarray(np.moveaxis(side, 0, -1))
    slopes = (sides[:, None] * (exits.slope + along * way.slope)).sum(axis=2)
    return side, (sides * arm).sum(axis=1).T, -np.moveaxis(slopes, -1, 0)


def trace_rays(
    lens: Lens, direction: Array, across: Array | None = None, more: int = 0
) -> tuple[Varying, Varying]:
    """Return where rays in air of directions (M, 3) leave the port, and which way: (3, M).

    across (M, V, 3): turns of the direction that are variables; more: of the variables that
    follow, the lens's viewpoint shift and the coefficients of the port, 0 or all.
    """
    assert lens.port is not None
    direction = np.ascontiguousarray(direction.T)
    turns = np.zeros((0, *direction.shape))
    if across is not None:
        turns = np.ascontiguousarray(np.moveaxis(across, 0, -1))
    count = len(turns) + more
    way = Varying(direction, np.concatenate([turns, np.zeros((more, *direction.shape))]))
    origin = Varying(np.zeros_like(direction), np.zeros((count, *direction.shape)))
    if lens.viewpoint_shift is not None:
        sin = np.hypot(direction[0], direction[1])
        theta = np.arctan2(sin, direction[2])
        value, slope = lens.viewpoint_shift.value_and_slope(theta, np.tan(theta / 2))
        origin.value[2] = value
        origin.slope[:, 2] = -way.slope[:, 2] * slope / np.maximum(sin, 1e-12)
    if more:
        origin.slope[len(turns), 2] += 1.0
    numbers = lens.port.varying(count, len(turns) + 1 if more else None)
    return lens.port.leave(origin, way, numbers)


def _across(direction: Array) -> Array:
    """Return two unit vectors (M, 2, 3) across unit vectors (M, 3) and each other."""
    helper = np.where(np.abs(direction[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(direction, helper)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(direction, first)], axis=1)


def _solve_2x2(matrix: Array, right: Array) -> Array:
    """Return matrix^-1 right for matrices (M, 2, 2), right (M, 2, K); not finite if singular."""
    a, b, c, d = matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 0], matrix[:, 1, 1]
    turned = np.stack([np.stack([d, -b], axis=-1), np.stack([-c, a], axis=-1)], axis=1)
    return np.asarray(turned @ right / (a * d - b * c)[:, None, None])
