"""Boards: the rigid pieces of a target, with axes of their own, and their symmetries.

A detector that cannot tell the ends of a board apart numbers it from either end: turns about its
normal carry its landmarks onto each other.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.scene.observations import Landmarks, Observations

_MIN_LANDMARKS_DEGREE_6 = 100  # landmarks: four for each coefficient from degree 2 to 6


MAX_THICKNESS = 0.02  # thickness of a board over its length
_TOLERANCE = 0.2  # of the spacing of landmarks: how far off its place one may be
_QUARTERS = 4
_MIN_SHARE = 0.9  # of the landmarks that a turn carries onto others: corners may be out of view


class Board(NamedTuple):
    """A board's id, center (3,), axes (3, 3; rows a, b, normal), size (m) and flatness.

    size: half the extent along its longer side; flat: four or more landmarks, all in one plane;
    landmarks: how many it has.
    """

    id: int
    center: Array
    axes: Array
    size: float
    flat: bool
    landmarks: int

    @property
    def highest_degree(self) -> int:
        """The highest degree of a polynomial over the board that its landmarks can tell."""
        return 6 if self.landmarks >= _MIN_LANDMARKS_DEGREE_6 else 4

    def to_board(self, points: Array) -> Array:
        """Return points (..., 3) in the board's axes, over its size."""
        return np.asarray((points - self.center) @ self.axes.T / self.size)


def spacing(points: Array) -> float:
    """Return the median distance of points (M, 3) to their nearest neighbors."""
    from scipy.spatial import KDTree  # not loaded for the help of a command

    return float(np.median(np.asarray(KDTree(points).query(points, 2)[0])[:, 1]))


def is_flat(points: Array) -> bool:
    """Say whether points (N, 3) are one flat board: its thickness is little beside its length."""
    extent = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(len(extent) < 3 or extent[2] <= MAX_THICKNESS * extent[0])


def find_boards(points: Array, board: Index) -> list[Board]:
    """Return the boards of landmarks (M, 3), m, labelled by `board` (M,), largest id last."""
    return [_board(int(label), points[board == label]) for label in np.unique(board)]


def _board(label: int, points: Array) -> Board:
    distinct = np.unique(np.round(points, 9), axis=0)
    center = (distinct.min(axis=0) + distinct.max(axis=0)) / 2
    local = distinct - distinct.mean(axis=0)
    axes = np.linalg.svd(local, full_matrices=True)[2] if len(distinct) > 2 else np.eye(3)
    # Axes along the target's own where the board lies square to them: readable coefficients.
    if np.abs(axes[2]).max() > 1 - 1e-9:
        axes = np.roll(np.eye(3), 2 - int(np.argmax(np.abs(axes[2]))), axis=0)
    axes[2] = np.cross(axes[0], axes[1])
    along = (distinct - center) @ axes.T
    size = float(np.abs(along).max(initial=1e-9))
    off = np.abs(along[:, 2] - along[:, 2].mean()).max(initial=0.0)
    flat = len(distinct) > 3 and bool(off < 1e-6 + 1e-3 * size)
    return Board(label, center, axes, size, flat, len(distinct))


class BoardTurn(NamedTuple):
    """One turn of one board: by so many degrees about its normal.

    landmark, partner (L,): ids of its landmarks, and of the one that each is carried onto; alone:
    ids of those that are carried onto none, since no row has it; matrix (3, 3): the turn in the
    board's axes.
    """

    board: Board
    degrees: int
    landmark: Index
    partner: Index
    alone: Index
    matrix: Array

    def apply(self, table: Observations, rows: Mask) -> Observations:
        """Return a table in which some rows (N,), all of this board, have their partner's id.

        Those of landmarks without one are left out.
        """
        kept = ~(rows & np.isin(table.landmark, self.alone))
        table, rows = table.take(kept), rows[kept]
        landmarks, rows = table.landmarks(), rows & np.isin(table.landmark, self.landmark)
        landmark, xyz = table.landmark.copy(), table.xyz.copy()
        landmark[rows] = self.partner[np.searchsorted(self.landmark, landmark[rows])]
        xyz[rows] = landmarks.points[np.searchsorted(landmarks.ids, landmark[rows])]
        return replace(table, landmark=landmark, xyz=xyz)


def board_turns(landmarks: Landmarks, board_of: Index) -> list[BoardTurn]:
    """Return every turn of every flat board; board_of (L,): of each landmark."""
    boards = []
    for board in find_boards(landmarks.points, board_of):
        on_board = board_of == board.id
        if board.flat:
            boards += _turns(board, landmarks.ids[on_board], landmarks.points[on_board])
    return boards


def _turns(board: Board, ids: Index, points: Array) -> list[BoardTurn]:
    place = (points - board.center) @ board.axes.T
    reach, found = _TOLERANCE * spacing(points), dict[int, tuple[Index, Array]]()
    paired = np.ones(len(ids), dtype=bool)
    for quarter in range(1, _QUARTERS):
        cos, sin = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarter]
        matrix = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]], dtype=float)
        apart = np.linalg.norm((place @ matrix.T)[:, None] - place, axis=-1)
        partner = apart.argmin(axis=1)
        close = apart.min(axis=1) < reach
        if close.mean() >= _MIN_SHARE and len(np.unique(partner[close])) == close.sum():
            found[360 * quarter // _QUARTERS] = partner, matrix
            paired &= close
    for _ in found:
        for partner, _ in found.values():
            paired &= paired[partner]
    return [
        BoardTurn(board, degrees, ids[paired], ids[partner[paired]], ids[~paired], matrix)
        for degrees, (partner, matrix) in found.items()
    ]
