"""Levenberg-Marquardt compiled: `solve.least_squares` and `solve.arrow`, system by system.

A system is V views of a rig of one or two cameras: a pose of the right camera for each view and,
for two, the rig that they share.  What is not plain sailing (a point near the lens, a singular
system) is left to the reference.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from fisheye_svp_ros.engines.kernels import (
    BARE,
    OPTIONS,
    factor,
    retract,
    substitute,
    view_equations,
)
from fisheye_svp_ros.solve.least_squares import (
    MAX_ITERATIONS,
    NOISE,
    ROUNDING,
    STEP_TOLERANCE,
    STUCK,
)


@njit(**OPTIONS)
def empty_normal(views):
    """Return the arrays of `solve.arrow.ArrowEquations` for one system."""
    return (np.zeros((views, 6, 6)), np.zeros((views, 6, 6)), np.zeros((6, 6)),
            np.zeros((views, 6)), np.zeros(6))


@njit(**OPTIONS)
def workspace(views):
    """Return what `minimise` works in: equations, states, steps, and room for small matrices."""
    return (
        empty_normal(views),
        (np.empty((views, 3, 3)), np.empty((views, 3))), (np.empty((3, 3)), np.empty(3)),
        np.empty((views, 6)), np.zeros(6),
        (np.empty((6, 6)), np.empty((6, 6)), np.empty((views, 7, 6))),
        (np.empty((6, 6)), np.empty(6), np.zeros((6, 12)), np.empty((3, 3)), np.empty(3),
         np.empty((6, 12))),
    )


@njit(**BARE)
def _right_equations(w, seen, pose, normal):
    """Add the right camera's part; return the cost."""
    points, uv, weight, lens = seen
    blocks, _, _, block_gradient, _ = normal
    total = 0.0
    for v in range(len(points)):
        total += view_equations(
            w, points[v], uv[v], weight[v], lens, pose[0][v], pose[1][v], blocks[v],
            block_gradient[v])
        if not np.isfinite(total):
            break
    return total


@njit(**BARE)
def _left_equations(w, seen, pose, rig, normal, room):
    """Add the left camera's part, by way of its pose, `right.compose(rig)`; return the cost."""
    points, uv, weight, lens = seen
    blocks, cross, shared, block_gradient, shared_gradient = normal
    hessian, gradient, change, rotation, position, half = room
    total = 0.0
    for v in range(len(points)):
        _left_pose((pose[0][v], pose[1][v]), rig, rotation, position, change)
        total += view_equations(
            w, points[v], uv[v], weight[v], lens, rotation, position, hessian, gradient)
        if not np.isfinite(total):
            break
        half[:] = 0.0
        for i in range(6):
            for k in range(6):
                for j in range(12):
                    half[i, j] += hessian[i, k] * change[k, j]
        cross[v] = 0.0
        for k in range(6):
            for i in range(6):
                block_gradient[v, i] += change[k, i] * gradient[k]
                shared_gradient[i] += change[k, 6 + i] * gradient[k]
                for j in range(6):
                    blocks[v, i, j] += change[k, i] * half[k, j]
                    cross[v, i, j] += change[k, i] * half[k, 6 + j]
                    shared[i, j] += change[k, 6 + i] * half[k, 6 + j]
    return total


@njit(**BARE)
def _left_pose(right, rig, rotation, position, change):
    """Write the left camera's pose, and its change (6, 12) by those of right camera and rig."""
    for i in range(3):
        position[i] = 0.0
        for j in range(3):
            position[i] += right[0][i, j] * rig[1][j]
            rotation[i, j] = 0.0
            for k in range(3):
                rotation[i, j] += right[0][i, k] * rig[0][k, j]
            change[i, 6 + j] = change[3 + i, 9 + j] = right[0][i, j]
    x, y, z = position
    change[0, 4], change[0, 5], change[1, 5] = z, -y, x
    change[1, 3], change[2, 3], change[2, 4] = -z, y, -x
    for i in range(6):
        change[i, i] = 1.0
    for i in range(3):
        position[i] += right[1][i]


@njit(**BARE)
def _equations(w, left, right, cameras, pose, rig, normal, room):
    """Write the normal equations; return the cost, inf outside the domain, nan if left."""
    total = _right_equations(w, right, pose, normal)
    if cameras == 2 and np.isfinite(total):
        normal[2][:] = 0.0
        normal[4][:] = 0.0
        total += _left_equations(w, left, pose, rig, normal, room)
    return total


@njit(**BARE)
def _step(normal, cameras, damping, work, block_step, shared_step):
    """Solve (H + damping diag H) d = -g; return |J d|^2, nan for a singular system."""
    blocks, cross, shared, block_gradient, shared_gradient = normal
    lower, reduced, eliminated = work
    columns = 7 if cameras == 2 else 1
    if cameras == 2:
        _copy(shared, reduced)
        for k in range(6):
            reduced[k, k] *= 1.0 + damping
            shared_step[k] = -shared_gradient[k]
    for v in range(len(blocks)):
        if not factor(blocks[v], damping, lower):
            return np.nan
        for i in range(6):
            eliminated[v, 0, i] = block_gradient[v, i]
            for k in range(1, columns):
                eliminated[v, k, i] = cross[v, i, k - 1]
        for k in range(columns):
            substitute(lower, eliminated[v, k])
        for k in range(columns - 1):
            for i in range(6):
                shared_step[k] += cross[v, i, k] * eliminated[v, 0, i]
                for j in range(6):
                    reduced[j, k] -= cross[v, i, j] * eliminated[v, k + 1, i]
    if cameras == 2:
        if not factor(reduced, 0.0, lower):
            return np.nan
        substitute(lower, shared_step)
    for v in range(len(blocks)):
        for i in range(6):
            block_step[v, i] = -eliminated[v, 0, i]
            for k in range(columns - 1):
                block_step[v, i] -= eliminated[v, k + 1, i] * shared_step[k]
    return _moved(normal, cameras, block_step, shared_step)


@njit(**BARE)
def _moved(normal, cameras, block_step, shared_step):
    blocks, cross, shared, _, _ = normal
    total = 0.0
    for v in range(len(blocks)):
        for i in range(6):
            for k in range(6):
                total += block_step[v, i] * blocks[v, i, k] * block_step[v, k]
                if cameras == 2:
                    total += 2.0 * block_step[v, i] * cross[v, i, k] * shared_step[k]
    if cameras == 2:
        for i in range(6):
            for k in range(6):
                total += shared_step[i] * shared[i, k] * shared_step[k]
    return total


@njit(**BARE)
def _retract(pose, rig, cameras, block_step, shared_step, new_pose, new_rig):
    for v in range(len(block_step)):
        retract(pose[0][v], pose[1][v], block_step[v], new_pose[0][v], new_pose[1][v])
    if cameras == 2:
        retract(rig[0], rig[1], shared_step, new_rig[0], new_rig[1])


@njit(**BARE)
def _copy(source, target):
    # Assigning whole arrays takes Numba longer to compile than all the rest.
    source, target = source.reshape(-1), target.reshape(-1)
    for i in range(len(source)):
        target[i] = source[i]


@njit(**BARE)
def _copy_state(pose, rig, new_pose, new_rig):
    _copy(pose[0], new_pose[0])
    _copy(pose[1], new_pose[1])
    _copy(rig[0], new_rig[0])
    _copy(rig[1], new_rig[1])


@njit(**BARE)
def _copy_normal(source, target):
    _copy(source[0], target[0])
    _copy(source[1], target[1])
    _copy(source[2], target[2])
    _copy(source[3], target[3])
    _copy(source[4], target[4])


@njit(**BARE)
def minimise(w, left, right, cameras, pose, rig, normal, work):
    """Move pose and rig to the minimum; return cost, iterations and how it ended.

    1: converged; 0: not; -1: left to the reference, wherever it got to.
    """
    fresh, new_pose, new_rig, block_step, shared_step, small, room = work
    damping, growth, moved_before, iteration, ended = 1e-4, 2.0, 0.0, 0, 0
    # What is accepted changes places with what was there: copies are made at the end, if at all.
    state_elsewhere = normal_elsewhere = False
    total = _equations(w, left, right, cameras, pose, rig, normal, room)
    if not np.isfinite(total):
        return total, 0, -1 if np.isnan(total) else 0
    while iteration < MAX_ITERATIONS:
        iteration += 1
        moved = _step(normal, cameras, damping, small, block_step, shared_step)
        if np.isnan(moved):
            ended = -1
            break
        _retract(pose, rig, cameras, block_step, shared_step, new_pose, new_rig)
        little = moved <= STEP_TOLERANCE**2 + ROUNDING * total
        little |= moved * moved <= STEP_TOLERANCE**2 * (1.0 + total) * moved_before
        if little and damping < 1.0:
            pose, rig, new_pose, new_rig = new_pose, new_rig, pose, rig
            state_elsewhere = not state_elsewhere
            total, ended = max(total - moved, 0.0), 1
            break
        cost = _equations(w, left, right, cameras, new_pose, new_rig, fresh, room)
        if np.isnan(cost):
            ended = -1
            break
        if cost <= total * (1.0 + ROUNDING) + NOISE * np.sqrt(total):
            ratio = (total - cost) / moved if moved > 0.0 else 0.0
            damping = max(damping * min(max(1.0 - (2.0 * ratio - 1.0)**3, 0.1), 2.0), 1e-15)
            growth, total, moved_before = 2.0, cost, moved
            pose, rig, new_pose, new_rig = new_pose, new_rig, pose, rig
            normal, fresh = fresh, normal
            state_elsewhere, normal_elsewhere = not state_elsewhere, not normal_elsewhere
        else:
            damping, growth = max(damping, 1e-9) * growth, 2.0 * growth
            if damping >= STUCK:
                break
    if state_elsewhere:
        _copy_state(pose, rig, new_pose, new_rig)
    if normal_elsewhere:
        _copy_normal(normal, fresh)
    return total, iteration, ended
