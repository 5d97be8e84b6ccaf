"""Turns of a board about its normal that carry its landmarks onto each other.

A detector that cannot tell the ends of such a board apart numbers it from either end.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.scene.boards import Board, find_boards, spacing
from fisheye_svp_ros.scene.landmarks import Landmarks
from fisheye_svp_ros.scene.observations import Observations

_TOLERANCE = 0.2  # of the spacing of landmarks: how far off its place one may be
_QUARTERS = 4


class BoardTurn(NamedTuple):
    """One turn of one board: by so many degrees about its normal.

    landmark, partner (L,): ids of its landmarks, and of the one that each is carried onto; matrix
    (3, 3): the turn in the board's axes.
    """

    board: Board
    degrees: int
    landmark: Index
    partner: Index
    matrix: Array

    def apply(self, table: Observations, rows: Mask) -> Observations:
        """Return a table in which some rows (N,), all of this board, have their partner's id."""
        known, rows = table.landmarks(), rows & np.isin(table.landmark, self.landmark)
        landmark, xyz = table.landmark.copy(), table.xyz.copy()
        landmark[rows] = self.partner[np.searchsorted(self.landmark, landmark[rows])]
        xyz[rows] = known.points[np.searchsorted(known.ids, landmark[rows])]
        return replace(table, landmark=landmark, xyz=xyz)


def board_turns(landmarks: Landmarks, board_of: Index) -> list[BoardTurn]:
    """Return every turn of every flat board; board_of (L,): of each landmark."""
    found = []
    for board in find_boards(landmarks.points, board_of):
        mine = board_of == board.id
        if board.flat:
            found += _turns(board, landmarks.ids[mine], landmarks.points[mine])
    return found


def _turns(board: Board, ids: Index, points: Array) -> list[BoardTurn]:
    place = (points - board.centre) @ board.axes.T
    reach, found = _TOLERANCE * spacing(points), []
    for quarter in range(1, _QUARTERS):
        cos, sin = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarter]
        matrix = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]], dtype=float)
        apart = np.linalg.norm((place @ matrix.T)[:, None] - place, axis=-1)
        partner = apart.argmin(axis=1)
        if apart.min(axis=1).max() < reach and len(np.unique(partner)) == len(ids):
            found.append(BoardTurn(
                board, 360 * quarter // _QUARTERS, ids, ids[partner], matrix))
    return found
