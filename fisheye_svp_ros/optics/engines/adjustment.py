"""Levenberg-Marquardt compiled: `solve.least_squares`, system by system.

A system is V views of a rig of one or two cameras: a pose of the right camera for each view and,
for two, the rig that they share.  Its state (V + 1, 4, 3) is these poses and last the rig, each a
rotation and, in the fourth row, a position.  Its normal equations (V + 1, 13, 6) are for each its
own, those mixed with the rig, and the gradient.  A point near the lens and a singular
system end the compiled run: those systems are solved by the reference.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numba.extending import register_jitable

from fisheye_svp_ros.optics.engines import marquardt
from fisheye_svp_ros.optics.engines.kernels import (
    BARE,
    OPTIONS,
    factor,
    retract,
    substitute,
    view_equations,
)
from fisheye_svp_ros.optics.engines.marquardt import FIRST_DAMPING, FIRST_GROWTH, STUCK

for rule in (marquardt.is_last, marquardt.is_better, marquardt.update_damping):
    register_jitable(**OPTIONS)(rule)

POSE, NORMAL = (4, 3), (13, 6)


@njit(**OPTIONS)
def workspace(views):
    """Return what `minimize` works in: two states and equations each, a step, and some room."""
    rows = views + 1
    return (
        np.empty((2, rows, *POSE)),
        np.empty((2, rows, *NORMAL)),
        np.empty((rows, 6)),
        np.empty((views, 7, 6)),
        np.empty((6, 6)),
        (np.empty(POSE), np.empty(NORMAL), np.zeros((6, 12)), np.empty((6, 12))),
    )


@njit(inline='always', **BARE)
def pose_of(part):
    """Return rotation (3, 3) and position (3) of a part of a state."""
    return part[:3], part[3]


@njit(inline='always', **BARE)
def normal_of(part):
    """Return own (6, 6), mixed (6, 6) and gradient (6) of a part of normal equations."""
    return part[:6], part[6:12], part[12]


@njit(**BARE)
def copy(source, target):
    """Copy an array; assigning it whole takes Numba longer to compile than all the rest."""
    source, target = source.reshape(-1), target.reshape(-1)
    for i in range(len(source)):
        target[i] = source[i]


@njit(**BARE)
def _rig_equations(w, left, right, cameras, state, normal, room):
    """Write the normal equations; return the cost, inf outside the domain, nan if left."""
    points, uv, weight, lens = right
    views, total = len(points), 0.0
    normal[views] = 0.0
    for v in range(views):
        rotation, position = pose_of(state[v])
        own, _, gradient = normal_of(normal[v])
        total += view_equations(
            w, points[v], uv[v], weight[v], lens, rotation, position, own, gradient
        )
        if cameras == 2 and np.isfinite(total):
            total += _left_equations(w, left, v, state, normal, room)
        if not np.isfinite(total):
            break
    return total


@njit(**BARE)
def _left_equations(w, seen, v, state, normal, room):
    """Add the left camera's part, by way of its pose, `right.compose(rig)`; return the cost."""
    points, uv, weight, lens = seen
    pose, equations, change, half = room
    rotation, position = pose_of(pose)
    hessian, _, gradient = normal_of(equations)
    own, mixed, own_gradient = normal_of(normal[v])
    rig, _, rig_gradient = normal_of(normal[len(points)])
    _write_left_pose(pose_of(state[v]), pose_of(state[len(points)]), rotation, position, change)
    cost = view_equations(
        w, points[v], uv[v], weight[v], lens, rotation, position, hessian, gradient
    )
    half[:] = 0.0
    mixed[:] = 0.0
    for i in range(6):
        for k in range(6):
            for j in range(12):
                half[i, j] += hessian[i, k] * change[k, j]
    for k in range(6):
        for i in range(6):
            own_gradient[i] += change[k, i] * gradient[k]
            rig_gradient[i] += change[k, 6 + i] * gradient[k]
            for j in range(6):
                own[i, j] += change[k, i] * half[k, j]
                mixed[i, j] += change[k, i] * half[k, 6 + j]
                rig[i, j] += change[k, 6 + i] * half[k, 6 + j]
    return cost


@njit(**BARE)
def _write_left_pose(right, rig, rotation, position, change):
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
def _solve_damped(normal, cameras, damping, step, eliminated, lower):
    """Solve (H + damping diag H) d = -g; return |J d|^2, nan for a singular system."""
    views, columns = len(eliminated), 7 if cameras == 2 else 1
    # What the poses leave of the rig's equations has its place beside them.
    rig, reduced, rig_gradient = normal_of(normal[views])
    for i in range(6):
        step[views, i] = -rig_gradient[i] if cameras == 2 else 0.0
        for j in range(6):
            reduced[i, j] = rig[i, j] * (1.0 + damping if i == j else 1.0)
    for v in range(views):
        own, mixed, gradient = normal_of(normal[v])
        if not factor(own, damping, lower):
            return np.nan
        for i in range(6):
            eliminated[v, 0, i] = gradient[i]
            for k in range(1, columns):
                eliminated[v, k, i] = mixed[i, k - 1]
        for k in range(columns):
            substitute(lower, eliminated[v, k])
        for k in range(columns - 1):
            for i in range(6):
                step[views, k] += mixed[i, k] * eliminated[v, 0, i]
                for j in range(6):
                    reduced[j, k] -= mixed[i, j] * eliminated[v, k + 1, i]
    if cameras == 2:
        if not factor(reduced, 0.0, lower):
            return np.nan
        substitute(lower, step[views])
    for v in range(views):
        for i in range(6):
            step[v, i] = -eliminated[v, 0, i]
            for k in range(columns - 1):
                step[v, i] -= eliminated[v, k + 1, i] * step[views, k]
    return _squared_image_step(normal, cameras, step)


@njit(**BARE)
def _squared_image_step(normal, cameras, step):
    """Return |J d|^2."""
    total, views = 0.0, len(step) - 1
    for v in range(views - 1 + cameras):
        own, mixed, _ = normal_of(normal[v])
        for i in range(6):
            for k in range(6):
                total += step[v, i] * own[i, k] * step[v, k]
                if v < views and cameras == 2:
                    total += 2.0 * step[v, i] * mixed[i, k] * step[views, k]
    return total


@njit(**BARE)
def minimize(w, left, right, cameras, work, limit):
    """Move the first state to the minimum; return cost, iterations, how it ended, and where.

    limit: of the iterations.  How: 1: converged; 0: not; -1: given up for the reference, wherever
    it got to.  Where: which of the two states, and of the normal equations, are the last.
    """
    states, normals, step, eliminated, lower, room = work
    damping, growth, moved_before = FIRST_DAMPING, FIRST_GROWTH, 0.0
    iteration = ended = at = known = 0
    total = _rig_equations(w, left, right, cameras, states[at], normals[known], room)
    if not np.isfinite(total):
        return total, 0, -1 if np.isnan(total) else 0, at, known
    while iteration < limit:
        iteration += 1
        moved = _solve_damped(normals[known], cameras, damping, step, eliminated, lower)
        if np.isnan(moved):
            ended = -1
            break
        for v in range(len(step) - 2 + cameras):
            retract(*pose_of(states[at, v]), step[v], *pose_of(states[1 - at, v]))
        if marquardt.is_last(moved, moved_before, total, damping):
            at, total, ended = 1 - at, max(total - moved, 0.0), 1
            break
        cost = _rig_equations(w, left, right, cameras, states[1 - at], normals[1 - known], room)
        if np.isnan(cost):
            ended = -1
            break
        better = marquardt.is_better(cost, total)
        damping, growth = marquardt.update_damping(damping, growth, better, total - cost, moved)
        if better:
            total, moved_before, at, known = cost, moved, 1 - at, 1 - known
        elif damping >= STUCK:
            break
    return total, iteration, ended, at, known
