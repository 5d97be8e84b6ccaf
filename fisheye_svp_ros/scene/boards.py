"""Boards: the rigid pieces of a target, with axes of their own."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index

_MIN_LANDMARKS_DEGREE_6 = 100  # landmarks: four for each coefficient from degree 2 to 6


MAX_THICKNESS = 0.02  # thickness of a board over its length


class Board(NamedTuple):
    """A board's id, centre (3,), axes (3, 3; rows a, b, normal), size (m) and flatness.

    size: half the extent along its longer side; flat: four or more landmarks, all in one plane;
    landmarks: how many it has.
    """

    id: int
    centre: Array
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
        return np.asarray((points - self.centre) @ self.axes.T / self.size)


def spacing(points: Array) -> float:
    """Return the median distance of points (M, 3) to their nearest neighbours."""
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
    centre = (distinct.min(axis=0) + distinct.max(axis=0)) / 2
    local = distinct - distinct.mean(axis=0)
    axes = np.linalg.svd(local, full_matrices=True)[2] if len(distinct) > 2 else np.eye(3)
    # Axes along the target's own where the board lies square to them: readable coefficients.
    if np.abs(axes[2]).max() > 1 - 1e-9:
        axes = np.roll(np.eye(3), 2 - int(np.argmax(np.abs(axes[2]))), axis=0)
    axes[2] = np.cross(axes[0], axes[1])
    along = (distinct - centre) @ axes.T
    size = float(np.abs(along).max(initial=1e-9))
    off = np.abs(along[:, 2] - along[:, 2].mean()).max(initial=0.0)
    flat = len(distinct) > 3 and bool(off < 1e-6 + 1e-3 * size)
    return Board(label, centre, axes, size, flat, len(distinct))
