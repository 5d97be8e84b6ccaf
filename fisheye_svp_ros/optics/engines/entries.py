"""What Python calls of the compiled engine: each compiled once and kept in the cache."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import config, njit, types

from fisheye_svp_ros.optics.engines import cache
from fisheye_svp_ros.optics.engines.adjustment import copy, minimize, normal_of, pose_of, workspace
from fisheye_svp_ros.optics.engines.kernels import (
    BACKWARD_ANGLE,
    BARE,
    INVALID,
    OPTIONS,
    ROW,
    ROWS,
    SCRATCH,
    SINGULAR,
    STATE,
    UNSETTLED,
    VALID,
    B,
    U,
    V,
    X,
    Y,
    Z,
    derivatives,
    factor,
    image,
    load,
    solve_rays,
    substitute,
)
from fisheye_svp_ros.optics.engines.marquardt import MAX_ITERATIONS
from fisheye_svp_ros.optics.engines.results import PLANARITY

_MAX_CONDITION = 1e12  # trace of a scaled inverse; what is worse goes to the reference


@njit(**BARE)
def _take(w, n, points):
    """Put points in the camera frame into their rows."""
    for i in range(n):
        w[X + i], w[Y + i], w[Z + i] = points[i, 0], points[i, 1], points[i, 2]


@njit(**BARE)
def _write_image(w, n, uv, state):
    for i in range(n):
        uv[i, 0] = w[U + i] if w[STATE + i] == VALID else np.nan
        uv[i, 1] = w[V + i] if w[STATE + i] == VALID else np.nan
        state[i] = w[STATE + i]


@njit(**BARE)
def _invert(hessian, lower, out):
    """Write the inverse of an information (6, 6); return whether it is determined."""
    trace = 0.0
    if not factor(hessian, SINGULAR, lower):
        return False
    out[:] = 0.0
    for k in range(6):
        out[k, k] = 1.0
        substitute(lower, out[k])
        trace += out[k, k] * hessian[k, k]
    return trace < _MAX_CONDITION


@njit(**BARE)
def _residual(w, points, uv, row, lens, pose, out):
    """Write measured minus predicted, nan for padding; return whether all could be done."""
    for start in range(0, len(points), B):
        n, rows, measured = min(B, len(points) - start), row[start:], uv[start:]
        load(w, n, points[start:], *pose)
        solve_rays(w, n, lens, BACKWARD_ANGLE)
        image(w, n, lens)
        remaining, off = 0, out[start:]
        for i in range(n):
            remaining += (rows[i] >= 0) & (w[STATE + i] == UNSETTLED)
            seen = (rows[i] >= 0) & (w[STATE + i] != INVALID)
            off[i, 0] = measured[i, 0] - w[U + i] if seen else np.nan
            off[i, 1] = measured[i, 1] - w[V + i] if seen else np.nan
        if remaining:
            return False
    return True


@njit(**BARE)
def _is_planar(points, weight):
    """Say whether the weighted points lie near a plane: eigenvalues after Smith (1961)."""
    total = x = y = z = xx = xy = xz = yy = yz = zz = 0.0
    for i in range(len(points)):
        k = weight[i]
        # Beside the first point, for the digits of a target far from the origin.
        a, b, c = (
            points[i, 0] - points[0, 0],
            points[i, 1] - points[0, 1],
            points[i, 2] - points[0, 2],
        )
        total, x, y, z = total + k, x + k * a, y + k * b, z + k * c
        xx, xy, xz = xx + k * a * a, xy + k * a * b, xz + k * a * c
        yy, yz, zz = yy + k * b * b, yz + k * b * c, zz + k * c * c
    x, y, z = x / total, y / total, z / total
    xx, yy, zz = xx / total - x * x, yy / total - y * y, zz / total - z * z
    xy, xz, yz = xy / total - x * y, xz / total - x * z, yz / total - y * z
    mean = (xx + yy + zz) / 3.0
    a, b, c = xx - mean, yy - mean, zz - mean
    size = np.sqrt((a * a + b * b + c * c + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    if not size > 0.0:
        return False
    det = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    turn = np.arccos(min(max(0.5 * det / (size * size * size), -1.0), 1.0)) / 3.0
    largest = mean + 2.0 * size * np.cos(turn)
    return mean + 2.0 * size * np.cos(turn + 2.0943951023931953) < PLANARITY * PLANARITY * largest


def _arg(dimensions: int, kind: Any = types.float64) -> types.Array:
    return types.Array(kind, dimensions, 'C', readonly=True)


def _dest(dimensions: int, kind: Any = types.float64) -> types.Array:
    return types.Array(kind, dimensions, 'C')


def _compiled_entry(result: Any, *arguments: Any) -> Any:
    """Compile for these types only, and keep it in the engine's own folder."""

    def compile_entry(function: Any) -> Any:
        before, config.CACHE_DIR = config.CACHE_DIR, str(cache.folder())
        try:
            return njit(result(*arguments), cache=True, nogil=True, **OPTIONS)(function)
        finally:
            config.CACHE_DIR = before

    return compile_entry


_LENS = (_arg(1), types.float64)


@_compiled_entry(types.void, _arg(2), *_LENS, _dest(2), _dest(1))
def project(points, lens, edge, uv, state):
    """Write image points (M, 2) and states (M)."""
    w = np.empty(SCRATCH)
    for start in range(0, len(points), B):
        n = min(B, len(points) - start)
        _take(w, n, points[start:])
        solve_rays(w, n, lens, edge)
        image(w, n, lens)
        _write_image(w, n, uv[start:], state[start:])


@_compiled_entry(types.void, _arg(3), _arg(2), _arg(3), *_LENS, _dest(3), _dest(2), _dest(4))
def linearize_views(rotation, position, points, lens, edge, uv, state, d_pose):
    """Write image points (S, N, 2), states (S, N) and derivatives (S, 2, 6, N)."""
    w = np.empty(SCRATCH)
    for s in range(len(points)):
        r = rotation[s]
        for start in range(0, points.shape[1], B):
            n = min(B, points.shape[1] - start)
            load(w, n, points[s, start:], r, position[s])
            solve_rays(w, n, lens, edge)
            image(w, n, lens)
            derivatives(w, n, lens)
            _write_image(w, n, uv[s, start:], state[s, start:])
            for row in range(4):
                # By place and by turn, of u and of v; the camera moves, not the point.
                at = ROW + (row // 2) * ROWS + (row % 2) * 3 * B
                x, y, z = w[at : at + B], w[at + B : at + 2 * B], w[at + 2 * B : at + 3 * B]
                sign = 1.0 if row % 2 else -1.0
                for k in range(3):
                    a, b, c = sign * r[k, 0], sign * r[k, 1], sign * r[k, 2]
                    out = d_pose[s, row // 2, 3 * (row % 2) + k, start:]
                    for i in range(n):
                        out[i] = a * x[i] + b * y[i] + c * z[i]


_VIEW_ARRAYS = (_arg(3), _arg(3), _arg(2))


@_compiled_entry(
    types.UniTuple(types.int64, 2),
    _arg(1),
    types.int64,
    types.int64,
    *_VIEW_ARRAYS,
    _arg(2, types.int64),
    _dest(3),
    _dest(2),
    _dest(3),
    _dest(3),
    _dest(1),
    _dest(1, types.boolean),
    _dest(1, types.int64),
)
def localize(
    lens,
    minimum,
    limit,
    points,
    uv,
    weight,
    row,
    rotation,
    position,
    covariance,
    residual,
    cost,
    solved,
    iterations,
):
    """Move S poses to their minima; return how many remain for the reference, and flat targets."""
    w, work, remaining, flat = np.empty(SCRATCH), workspace(1), 0, 0
    states, normals, lower = work[0], work[1], work[4]
    for s in range(len(points)):
        usable, solved[s] = 0, False
        for i in range(weight.shape[1]):
            usable += weight[s, i] > 0.0
        if usable >= minimum:
            pose = pose_of(states[0, 0])
            copy(rotation[s], pose[0])
            copy(position[s], pose[1])
            seen = (points[s : s + 1], uv[s : s + 1], weight[s : s + 1], lens)
            cost[s], iterations[s], ended, at, known = minimize(w, seen, seen, 1, work, limit)
            pose = pose_of(states[at, 0])
            copy(pose[0], rotation[s])
            copy(pose[1], position[s])
            solved[s] = (
                ended == 1
                and _invert(normal_of(normals[known, 0])[0], lower, covariance[s])
                and _residual(w, points[s], uv[s], row[s], lens, pose, residual[s])
            )
        remaining += not solved[s]
        flat += _is_planar(points[s], weight[s])
    return remaining, flat


@_compiled_entry(
    types.int64,
    *_VIEW_ARRAYS,
    _arg(1),
    *_VIEW_ARRAYS,
    _arg(1),
    _dest(4),
    _dest(4),
    _dest(1),
    _dest(1, types.int64),
)
def adjust_rigs(
    left_points,
    left_uv,
    left_weight,
    left_lens,
    points,
    uv,
    weight,
    lens,
    state,
    normal,
    cost,
    iterations,
):
    """Move S rigs of V views to their minima; return how many remain for the reference.

    state (S, V + 1, 4, 3); normal (S, V + 1, 13, 6): see `adjustment`.
    """
    views, remaining = state.shape[1] - 1, 0
    w, work = np.empty(SCRATCH), workspace(views)
    for s in range(len(state)):
        mine = slice(s * views, (s + 1) * views)
        copy(state[s], work[0][0])
        cost[s], iterations[s], ended, at, known = minimize(
            w,
            (left_points[mine], left_uv[mine], left_weight[mine], left_lens),
            (points[mine], uv[mine], weight[mine], lens),
            2,
            work,
            MAX_ITERATIONS,
        )
        copy(work[0][at], state[s])
        copy(work[1][known], normal[s])
        remaining += ended < 1
    return remaining
