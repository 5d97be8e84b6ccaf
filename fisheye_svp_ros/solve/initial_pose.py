"""Poses from rays and landmarks without a start value, for rays in any direction.

Landmarks' squared distances from their rays are, once the translation is eliminated, a quadratic
form in the nine numbers of R (Lu, Hager, Mjolsness, PAMI 2000): the points are summed up once, and
any number of turns is then polished without them.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.pose import Pose, cross_matrix, nearest_rotation, rotation_from_vector

_STEPS, _MORE_STEPS = 4, 10  # Gauss-Newton, of an algebraic turn and of any turn
_MAX_TURN = 0.7  # rad, a step
_DOUBTFUL = 1e-3  # mean squared sine (about 2 degrees) above which evenly spread starts are tried
_FLOOR = 1e-12  # relative; keeps rays that are all parallel invertible


class _Problem(NamedTuple):
    """S sets of landmarks in their own principal axes, over their size.

    local, direction (S, N, 3), zero where not seen; axes (S, 3, 3), scale (S,), center (S, 3).
    form (S, 9, 9): the squared distances of landmarks from their rays are r^T form r, r = columns
    of R; pull (S, 3, 9): the best translation is pull r.
    """

    local: Array
    direction: Array
    axes: Array
    scale: Array
    center: Array
    form: Array
    pull: Array

    def take(self, rows: Index) -> _Problem:
        """Return some of the sets."""
        return _Problem(*(part[rows] for part in self))

    def camera(self, rotation: Array, translation: Array) -> Pose:
        """Return cameras in the world from turns (S, ..., 3, 3) and translations (S, ..., 3)."""
        more = (slice(None), *[None] * (rotation.ndim - 3))
        place = Pose(rotation @ self.axes[more], translation * self.scale[more][..., None])
        camera = place.inverse()
        return Pose(camera.rotation, camera.position + self.center[more])


def initial_poses(points: Array, direction: Array, weight: Array, spread: bool = True) -> Pose:
    """Return poses (S,) of the camera in the world from landmarks and viewing directions.

    points (S, N, 3), m; direction (S, N, 3), unit, camera frame; weight (S, N), 0 = ignore.
    Candidates for R come from the smallest eigenvectors of the misfit, which need six points, or
    four in a plane, and where those fail, if `spread`, from evenly spread turns.
    """
    problem = _problem(points, direction, weight)
    rotation, translation, error = _best_turn(_algebraic_rotations(problem), problem, _STEPS)
    rows = np.flatnonzero(error > _DOUBTFUL) if spread else np.empty(0, dtype=np.int64)
    if rows.size:
        turns = np.broadcast_to(_cube_turns(), (len(rows), 24, 3, 3))
        mirrored = _best_turn(turns, problem.take(rows), _MORE_STEPS)
        better = mirrored[2] < error[rows]
        rotation[rows[better]], translation[rows[better]] = (
            mirrored[0][better],
            mirrored[1][better],
        )
    return problem.camera(rotation, translation)


def candidate_poses(points: Array, direction: Array, weight: Array) -> Pose:
    """Return the poses (S, C) that evenly spread turns lead to, for sets with several minima."""
    problem = _problem(points, direction, weight)
    turns = np.broadcast_to(_cube_turns(), (len(points), 24, 3, 3))
    rotation = _polish(turns, problem.form[:, None], _MORE_STEPS)
    return problem.camera(rotation, _translation(problem, rotation))


def _problem(points: Array, direction: Array, weight: Array) -> _Problem:
    seen = (weight > 0) & np.isfinite(direction).all(axis=-1)
    count = np.maximum(seen.sum(1), 1)
    d = np.where(seen[..., None], direction, 0.0)
    center = np.where(seen[..., None], points, 0.0).sum(1) / count[:, None]
    local = np.where(seen[..., None], points - center[:, None], 0.0)
    # In their own principal axes: a flat target then lacks the third one exactly.
    axes = nearest_rotation(
        np.swapaxes(np.linalg.eigh(np.swapaxes(local, -1, -2) @ local)[1], -1, -2)[:, ::-1]
    )
    scale = np.maximum(np.sqrt((local**2).sum((1, 2)) / count), 1e-12)
    local = local @ np.swapaxes(axes, -1, -2) / scale[:, None, None]
    return _Problem(local, d, axes, scale, center, *_sum_points(local, d))


def _sum_points(local: Array, d: Array) -> tuple[Array, Array]:
    """Return form and pull of a problem."""
    systems, count = local.shape[:2]
    seen = np.any(d, axis=-1)
    across = (np.eye(3) - d[..., :, None] * d[..., None, :]) * seen[..., None, None]
    flat = across.reshape(systems, count, 9)
    # Sums over the points of X (x) across and of X X^T (x) across; across is a projection, its
    # own square.
    mixed = (np.swapaxes(local, -1, -2) @ flat).reshape(systems, 9, 3)
    squares = (local[..., :, None] * local[..., None, :]).reshape(systems, count, 9)
    form = (np.swapaxes(squares, -1, -2) @ flat).reshape(systems, 3, 3, 3, 3)
    form = form.transpose(0, 1, 3, 2, 4).reshape(systems, 9, 9)
    rays = across.sum(axis=1)
    rays[:, range(3), range(3)] += _FLOOR * count
    pull = -np.linalg.solve(rays, np.swapaxes(mixed, -1, -2))
    return form + mixed @ pull, pull


def _best_turn(candidates: Array, problem: _Problem, steps: int) -> tuple[Array, Array, Array]:
    """Polish candidates (S, C, 3, 3) and return the best turn, its translation and its error.

    error (S,): mean squared sine between rays and landmarks; 1 for a landmark behind its ray.
    """
    local, d = problem.local, problem.direction
    rotation = _polish(candidates, problem.form[:, None], steps)
    translation = _translation(problem, rotation)
    placed = local[:, None] @ np.swapaxes(rotation, -1, -2) + translation[:, :, None]
    along = (placed * d[:, None]).sum(-1)
    cos2 = np.where(along > 0, along**2 / np.maximum((placed**2).sum(-1), 1e-18), 0.0)
    seen = np.any(d, axis=-1).sum(-1)[:, None]
    error = 1.0 - cos2.sum(-1) / np.maximum(seen, 1)
    best, rows = np.argmin(error, axis=1), np.arange(len(local))
    return rotation[rows, best], translation[rows, best], error[rows, best]


def _translation(problem: _Problem, rotation: Array) -> Array:
    """Return the best translations (S, C, 3) for turns (S, C, 3, 3)."""
    return np.asarray((problem.pull[:, None] @ _columns(rotation)[..., None])[..., 0])


def _polish(rotation: Array, form: Array, steps: int) -> Array:
    """Reduce the misfit of turns (S, C, 3, 3) by Gauss-Newton steps."""
    for _ in range(steps):
        slope = -cross_matrix(np.swapaxes(rotation, -1, -2))
        slope = slope.reshape(*slope.shape[:-3], 9, 3)
        image = np.swapaxes(form @ slope, -1, -2)
        hessian = image @ slope
        damping = 1e-6 * np.trace(hessian, axis1=-2, axis2=-1) + 1e-300
        hessian[..., range(3), range(3)] += damping[..., None]
        step = -np.linalg.solve(hessian, image @ _columns(rotation)[..., None])[..., 0]
        size = np.linalg.norm(step, axis=-1, keepdims=True)
        part = _MAX_TURN / np.maximum(size, _MAX_TURN)
        rotation = rotation_from_vector(step * part) @ rotation
    return rotation


def _columns(rotation: Array) -> Array:
    return np.swapaxes(rotation, -1, -2).reshape(*rotation.shape[:-2], 9)


def _algebraic_rotations(problem: _Problem) -> Array:
    """Rotations (S, 2, 3, 3) from the eigenvector of the smallest misfit, one sign each way."""
    flat = (np.abs(problem.local[..., 2]).max(axis=1) < 1e-6)[:, None, None]
    form = problem.form.copy()
    form[:, 6:, :] = 0
    form[:, :, 6:] = 0
    form[:, range(6, 9), range(6, 9)] = 1e9
    vectors = np.linalg.eigh(np.where(flat, form, problem.form))[1]
    columns = np.swapaxes(vectors[..., 0].reshape(-1, 3, 3), -1, -2)
    # A first column of zeros is no turn, but must not end the other views' search.
    size = np.maximum(np.linalg.norm(columns[..., 0], axis=-1), 1e-9)
    columns = columns / size[:, None, None]
    m = np.stack([columns, -columns], axis=1)
    third = np.cross(m[..., 0], m[..., 1])
    return nearest_rotation(
        np.where(flat[:, None], np.stack([m[..., 0], m[..., 1], third], axis=-1), m)
    )


@cache
def _cube_turns() -> Array:
    """Return the 24 turns of a cube (24, 3, 3): evenly spread starts."""
    quarter = [rotation_from_vector(np.pi / 2 * axis) for axis in np.eye(3)]
    group = [np.eye(3)]
    for turn in group:
        for generator in quarter:
            new = turn @ generator
            if not any(np.allclose(new, old) for old in group):
                group.append(new)
    return np.stack(group)
