"""Poses from rays and landmarks without a start value, for rays in any direction."""

from __future__ import annotations

from functools import cache

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.pose import Pose, nearest_rotation, rotation_from_vector

_TURNS = 4  # alternations that polish each candidate
_DOUBTFUL = 1e-3  # mean squared sine (about 2 degrees) above which evenly spread starts are tried


def initial_poses(points: Array, direction: Array, weight: Array) -> Pose:
    """Return poses (S,) of the camera in the world from landmarks and viewing directions.

    points (S, N, 3), m; direction (S, N, 3), unit, camera frame; weight (S, N), 0 = ignore.
    Minimises the landmarks' distances from their rays, linear in [R | t] (Lu, Hager, Mjolsness,
    PAMI 2000); candidates for R come from the smallest eigenvectors and, where those fail, from
    evenly spread turns.
    """
    seen = (weight > 0) & np.isfinite(direction).all(axis=-1)
    w = seen.astype(float)
    d = np.where(seen[..., None], direction, 0.0)
    centre = (w[..., None] * points).sum(1) / np.maximum(w.sum(1), 1)[:, None]
    local = np.where(seen[..., None], points - centre[:, None], 0.0)
    scale = np.sqrt((local**2).sum((1, 2)) / np.maximum(w.sum(1), 1))
    local /= np.maximum(scale, 1e-12)[:, None, None]
    across = (np.eye(3) - d[..., :, None] * d[..., None, :]) * w[..., None, None]
    rotation, translation, error = _best(_algebraic_rotations(local, across), local, d, across, w)
    doubtful = np.flatnonzero(error > _DOUBTFUL)
    if doubtful.size:
        rows = doubtful
        spread = np.broadcast_to(_cube_turns(), (len(rows), 24, 3, 3))
        other = _best(spread, local[rows], d[rows], across[rows], w[rows])
        better = other[2] < error[rows]
        rotation[rows[better]], translation[rows[better]] = other[0][better], other[1][better]
    camera = Pose(rotation, translation * scale[:, None]).inverse()
    return Pose(camera.rotation, camera.position + centre)


def _best(
    rotations: Array, local: Array, d: Array, across: Array, w: Array
) -> tuple[Array, Array, Array]:
    """Polish candidates (S, C, 3, 3) and return the best turn, its translation and its misfit."""
    rotation, translation = _polish(rotations, local, d, across, w)
    error = _ray_error(rotation, translation, local, d, across, w)
    best, rows = np.argmin(error, axis=1), np.arange(len(local))
    return rotation[rows, best], translation[rows, best], error[rows, best]


def _algebraic_rotations(local: Array, across: Array) -> Array:
    """Rotations (S, C, 3, 3) from the eigenvectors of the smallest misfit, one sign each way."""
    # Landmarks in their own principal axes: a flat target then lacks the third one exactly.
    spread = np.linalg.eigh(np.swapaxes(local, -1, -2) @ local)[1]
    axes = nearest_rotation(np.swapaxes(spread, -1, -2)[:, ::-1])
    own = local @ np.swapaxes(axes, -1, -2)
    flat = (np.abs(own[..., 2]).max(axis=1) < 1e-6)[:, None, None]
    # Misfit |across (R X + t)|^2 in the columns of R; across is a projection, its own square.
    # Sums over the points of X (x) across and of X X^T (x) across, then t eliminated.
    systems, count = own.shape[:2]
    flat_across = across.reshape(systems, count, 9)
    mixed = (np.swapaxes(own, -1, -2) @ flat_across).reshape(systems, 9, 3)
    squares = (own[..., :, None] * own[..., None, :]).reshape(systems, count, 9)
    omega = (np.swapaxes(squares, -1, -2) @ flat_across).reshape(systems, 3, 3, 3, 3)
    omega = omega.transpose(0, 1, 3, 2, 4).reshape(systems, 9, 9)
    omega -= mixed @ np.linalg.pinv(across.sum(axis=1)) @ np.swapaxes(mixed, -1, -2)
    omega_flat = omega.copy()
    omega_flat[:, 6:, :] = 0
    omega_flat[:, :, 6:] = 0
    omega_flat[:, range(6, 9), range(6, 9)] = 1e9
    vectors = np.linalg.eigh(np.where(flat, omega_flat, omega))[1]
    columns = np.swapaxes(vectors[..., 0].reshape(-1, 3, 3), -1, -2)
    columns = columns / np.linalg.norm(columns[..., 0], axis=-1)[:, None, None]
    candidates = []
    for sign in (1.0, -1.0):
        m = sign * columns
        third = np.cross(m[..., 0], m[..., 1])
        m = np.where(flat, np.stack([m[..., 0], m[..., 1], third], axis=-1), m)
        candidates.append(nearest_rotation(m) @ axes)
    return np.stack(candidates, axis=1)


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


def _polish(
    rotation: Array, local: Array, d: Array, across: Array, w: Array
) -> tuple[Array, Array]:
    """Alternate between the points on the rays and the best turn (orthogonal iteration)."""
    inverse = np.linalg.pinv(across.sum(1))
    count = np.maximum(w.sum(1), 1)[:, None, None]
    for _ in range(_TURNS):
        translation = _translation(rotation, local, across, inverse)
        placed = local[:, None] @ np.swapaxes(rotation, -1, -2) + translation[:, :, None]
        depth = np.maximum(np.einsum('scnk,snk->scn', placed, d), 0.0)
        target = depth[..., None] * d[:, None]
        target = target - (w[:, None, :, None] * target).sum(2, keepdims=True) / count[..., None]
        rotation = nearest_rotation(np.einsum('scni,snj->scij', target, w[..., None] * local))
    return rotation, _translation(rotation, local, across, inverse)


def _translation(rotation: Array, local: Array, across: Array, inverse: Array) -> Array:
    turned = local[:, None] @ np.swapaxes(rotation, -1, -2)
    pull = np.einsum('snij,scnj->sci', across, turned)
    translation: Array = -np.einsum('sij,scj->sci', inverse, pull)
    return translation


def _ray_error(
    rotation: Array, translation: Array, local: Array, d: Array, across: Array, w: Array
) -> Array:
    """Mean squared sine between rays and landmarks, (S, C); 1 for a landmark behind its ray."""
    placed = local[:, None] @ np.swapaxes(rotation, -1, -2) + translation[:, :, None]
    distance2 = np.maximum((placed**2).sum(-1), 1e-18)
    off = np.einsum('snij,scnj->scni', across, placed)
    ahead = np.einsum('scnk,snk->scn', placed, d) > 0
    sine2 = np.where(ahead, (off**2).sum(-1) / distance2, 1.0)
    error: Array = (w[:, None] * sine2).sum(-1) / np.maximum(w.sum(1), 1)[:, None]
    return error
