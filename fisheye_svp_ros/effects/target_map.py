"""The target as the extended model has it, against what it is said to be."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.effects.base import ModelTerm, Scene
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import cross_matrix, identity
from fisheye_svp_ros.scene.boards import find_boards
from fisheye_svp_ros.scene.observations import Views, views_of


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
    def spans_plane(self) -> bool:
        """Whether the landmarks are not all on one line."""
        across = np.linalg.svd(self.place - self.place.mean(axis=0), compute_uv=False)
        return bool(across[-1] > 1e-6 * across[0])

    @property
    def peak_to_valley(self) -> float:
        """From the lowest to the highest landmark, m."""
        return float(np.ptp(self.height))


class KnownTarget(NamedTuple):
    """The landmarks of a table: numbers (L,), ascending, boards (L,), places (L, 3), m."""

    landmark: Index
    board: Index
    points: Array

    @classmethod
    def from_views(cls, views: Views) -> KnownTarget:
        """Return the landmarks that views show."""
        numbers, first = np.unique(views.landmark[views.used], return_index=True)
        return cls(numbers, views.board[views.used][first], views.points[views.used][first])

    def displacements(self, terms: Sequence[ModelTerm], lens: Lens) -> Array:
        """Return the displacements (L, 3), m, by the effects on the target among some terms."""
        views = views_of(self.points[None], np.zeros((1, len(self.points), 2)))
        views = views._replace(board=self.board[None], landmark=self.landmark[None])
        scene = Scene(views, lens, identity(1), views.uv)
        moved = np.zeros_like(self.points)
        for term in terms:
            if term.effect.stage == 'target':
                moved = moved + term.displacement(scene)[0]
        return moved

    def maps(self, moved: Array) -> list[BoardMap]:
        """Return displacements (L, 3) board by board."""
        maps = []
        for board in find_boards(self.points, self.board):
            on_board = self.board == board.id
            local = less_similarity(self.points[on_board], moved[on_board]) @ board.axes.T
            place = board.to_board(self.points[on_board])[:, :2] * board.size
            maps.append(BoardMap(board.id, place, local[:, 2], local[:, :2]))
        return maps


def find_landmarks(landmark: Index, views: Views) -> tuple[Index, Mask]:
    """Return places (S, N) of the landmarks of views among ascending ones, and which are there."""
    slot = np.searchsorted(landmark, views.landmark).clip(max=len(landmark) - 1)
    return slot, np.asarray(landmark[slot] == views.landmark)


def at_landmarks(views: Views, landmark: Index, values: Array) -> Array:
    """Return values (L, D) of landmarks (L,), ascending, where views (S, N) show them, else 0."""
    slot, is_listed = find_landmarks(landmark, views)
    return np.where((is_listed & views.used)[..., None], values[slot], 0.0)


def board_maps(views: Views, terms: Sequence[ModelTerm], lens: Lens) -> list[BoardMap]:
    """Return how effects on the target, among some terms, displace the landmarks of views."""
    target = KnownTarget.from_views(views)
    return target.maps(target.displacements(terms, lens))


def less_similarity(points: Array, moved: Array) -> Array:
    """Take the best small motion and magnification out of displacements (L, 3)."""
    arm = points - points.mean(axis=0)
    shift = np.broadcast_to(np.eye(3), (len(arm), 3, 3))
    columns = np.concatenate([shift, cross_matrix(arm), arm[..., None]], axis=-1).reshape(-1, 7)
    fitted = columns @ np.linalg.lstsq(columns, moved.ravel(), rcond=1e-9)[0]
    return np.asarray(moved - fitted.reshape(-1, 3))
