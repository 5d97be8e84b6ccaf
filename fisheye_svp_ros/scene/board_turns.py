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
_MIN_SHARE = 0.9  # of the landmarks that a turn carries onto others: corners may be out of view


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
    return [BoardTurn(board, degrees, ids[paired], ids[partner[paired]], ids[~paired], matrix)
            for degrees, (partner, matrix) in found.items()]
