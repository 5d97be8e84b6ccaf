"""The same order of corners in every photograph of a board that looks the same when turned.

Single corners are never quite where they should be, and what is wrong with them turns with the
board.  After a calibration that believes them, each view's residuals are a picture of those
errors; views are turned until their pictures agree.  Cameras of a rig see one board at one moment:
their views are turned so that the cameras stand alike in all frames, and then as one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.detect.patterns import Turn, local_axes
from fisheye_svp_ros.pose import Pose

_ROUNDS = 30
_SHUFFLES = 8
_MAX_FRAMES = 50  # frames, each of which may say how two cameras stand
_MAX_SPREAD = 0.1  # rad, and of the distance of the board, by which half of the frames may differ


class Agreement(NamedTuple):
    """Which turn each view (V,) needs, and how likely it is the right one of two, 0.5 to 1."""

    turn: Index
    certainty: Array


def board_residuals(points: Array, uv: Array, residual: Array) -> Array:
    """Return residuals (M, 2), px, of points (M, 2), m, seen at uv (M, 2), as m on the board."""
    axes = local_axes(points, uv)
    return np.asarray(np.linalg.solve(np.swapaxes(axes, -1, -2), residual[..., None])[..., 0])


def turn_field(field: Array, turn: Turn) -> Array:
    """Return residuals (..., N, 2) on the board as they are once the board is turned."""
    return np.asarray(field[..., turn.source, :] @ turn.matrix.T)


def of_rig(one: Pose, other: Pose, points: Array, turns: tuple[Turn, ...]) -> Index | None:
    """Return which turns of `other` let two cameras stand alike in all frames (F,).

    one, other: of the cameras before the board with points (N, 2), m.  None where there is no
    such turn for most frames: the cameras are no rig.
    """
    rotation = np.tile(np.eye(3), (len(turns), 1, 1, 1))
    place = np.zeros((len(turns), 1, 3))
    for i, turn in enumerate(turns):
        rotation[i, 0, :2, :2] = turn.matrix
        place[i, 0, :2] = (points - points[turn.source] @ turn.matrix.T).mean(axis=0)
    between = one.inverse().compose(Pose(rotation, place).compose(other))
    tried = Pose(*(part[:, :_MAX_FRAMES].reshape(-1, *part.shape[2:]) for part in between))
    cosine = np.einsum('hij,gfij->hgf', tried.rotation, between.rotation) / 2 - 0.5
    away = np.linalg.norm(one.position - [*points.mean(axis=0), 0.0], axis=-1)
    off = (
        np.arccos(np.clip(cosine, -1, 1))
        + np.linalg.norm(tried.position[:, None, None] - between.position, axis=-1) / away
    )
    typical = np.median(off.min(axis=1), axis=-1)
    best = int(typical.argmin())
    return off[best].argmin(axis=0) if typical[best] < _MAX_SPREAD else None


def agree(field: Array, turns: tuple[Turn, ...]) -> Agreement:
    """Return how views must be turned to agree on residuals (V, N, 2) on the board, NaN unseen.

    turns: those that nothing in the print tells apart, the first of them none.
    """
    field = np.nan_to_num(field)
    choice, margin = _best_turns(field, turns)
    # Views can be turned to agree a little on anything: as much as they do once mixed up.
    rng = np.random.default_rng(0)
    mixed = [np.stack([rng.permutation(view) for view in field]) for _ in range(_SHUFFLES)]
    chance = float(np.mean([_best_turns(one, turns)[1].mean() for one in mixed]))
    return Agreement(choice, _certainty(margin, chance))


def _best_turns(field: Array, turns: tuple[Turn, ...]) -> tuple[Index, Array]:
    """Return the best turns (V,) and how much better each is than the next, (V,)."""
    ways = np.stack([turn_field(field, turn) for turn in turns])
    ways = ways.reshape(len(turns), len(field), -1)
    ways -= ways.mean(axis=0)  # what looks the same in all turns tells nothing
    ways /= np.maximum(np.linalg.norm(ways, axis=-1, keepdims=True), 1e-30)
    # Views alike in all turns say nothing: start from each view in turn, keep the best agreement.
    found = [_resolve_turns(ways, ways[0, seed]) for seed in range(len(field))]
    choice = max(found, key=lambda one: _likeness(ways, one)[one, np.arange(len(one))].sum())
    likeness = _likeness(ways, choice)
    ranked = np.sort(likeness, axis=0)
    return choice, np.asarray(ranked[-1] - ranked[-2]) / 2


def _resolve_turns(ways: Array, first: Array) -> Index:
    choice: Index = (ways @ first).argmax(axis=0)
    for _ in range(_ROUNDS):
        better = _likeness(ways, choice).argmax(axis=0)
        if np.array_equal(better, choice):
            break
        choice = better
    return choice


def _likeness(ways: Array, choice: Index) -> Array:
    """Likeness (G, V) of each view, in each turn, to the mean of all others."""
    chosen = ways[choice, np.arange(len(choice))]
    others = chosen.sum(axis=0) - chosen
    others /= np.maximum(np.linalg.norm(others, axis=-1, keepdims=True), 1e-30)
    return np.asarray((ways * others).sum(axis=-1))


def _certainty(margin: Array, chance: float) -> Array:
    """Chances, from margins that are +-mean with Gaussian scatter, by their moments.

    The fourth moment tells a mean from scatter, although every view was turned to agree; what
    margins are by chance is taken off.
    """
    second, fourth = (margin**2).mean(), (margin**4).mean()
    mean2 = np.sqrt(max((3 * second**2 - fourth) / 2, 0.0))
    scatter2 = max(second - mean2, 1e-3 * second, chance**2, 1e-30)
    mean = max(float(np.sqrt(mean2)) - chance, 0.0)
    return np.asarray(1 / (1 + np.exp(-np.minimum(2 * mean * margin / scatter2, 50))))
