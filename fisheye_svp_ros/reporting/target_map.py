"""The target as the extended model has it, against what it is said to be."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.model import Linearised
from fisheye_svp_ros.effects.base import Scene
from fisheye_svp_ros.effects.forward import Term
from fisheye_svp_ros.pose import cross_matrix, identity
from fisheye_svp_ros.scene.boards import find_boards
from fisheye_svp_ros.scene.observations import views_of


class BoardMap(NamedTuple):
    """Where the landmarks of one board are, relative to where they were said to be.

    place (L, 2), m, on the board; height (L,), m, off its plane; slide (L, 2), m, along it.  What
    a motion or a magnification of the board does is left out.
    """

    board: int
    place: Array
    height: Array
    slide: Array

    @property
    def spread_out(self) -> bool:
        """Whether the landmarks are not all on one line."""
        across = np.linalg.svd(self.place - self.place.mean(axis=0), compute_uv=False)
        return len(self.place) > 2 and bool(across[-1] > 1e-6 * across[0])

    @property
    def peak_to_valley(self) -> float:
        """From the lowest to the highest landmark, m."""
        return float(np.ptp(self.height))


def board_maps(linear: Linearised, names: tuple[str, ...] = ()) -> list[BoardMap]:
    """Return how effects on the target displace the landmarks; names: of these effects alone."""
    terms = [
        term for term in linear.state.terms
        if term[0].stage == 'target' and (not names or term[0].name in names)
    ]
    views = linear.data.views
    keys = np.stack([views.board, views.landmark], axis=-1)[views.used]
    rows, first = np.unique(keys, axis=0, return_index=True)
    board, landmark = rows.T
    points = views.points[views.used][first]
    moved = _displacement(linear, terms, points, board, landmark)
    maps = []
    for one in find_boards(points, board):
        mine = board == one.id
        local = _less_similarity(points[mine], moved[mine]) @ one.axes.T
        place = one.local(points[mine])[:, :2] * one.size
        maps.append(BoardMap(one.id, place, local[:, 2], local[:, :2]))
    return maps


def _displacement(
    linear: Linearised, terms: list[Term], points: Array, board: Index, landmark: Index
) -> Array:
    blank = np.zeros((1, len(points), 2))
    views = views_of(points[None], blank)._replace(board=board[None], landmark=landmark[None])
    scene = Scene(views, linear.state.lens, identity(1), blank)
    return np.asarray(
        sum((e.displacement(scene, v)[0] for e, v in terms), np.zeros_like(points))
    )


def _less_similarity(points: Array, moved: Array) -> Array:
    """Take the best small motion and magnification out of displacements (L, 3)."""
    arm = points - points.mean(axis=0)
    shift = np.broadcast_to(np.eye(3), (len(arm), 3, 3))
    columns = np.concatenate([shift, cross_matrix(arm), arm[..., None]], axis=-1).reshape(-1, 7)
    fitted = columns @ np.linalg.lstsq(columns, moved.ravel(), rcond=1e-9)[0]
    return np.asarray(moved - fitted.reshape(-1, 3))
