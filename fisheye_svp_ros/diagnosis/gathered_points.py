"""The points of all frames in one table, and the target they are on: what columns are built of."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.effects.extension import Target
from fisheye_svp_ros.scene.boards import Board, find_boards
from fisheye_svp_ros.solve.rig_state import Linearization

MILLIMETRE = 1e-3  # unit of offsets on the target


class ColumnGeometry(NamedTuple):
    """What the columns rest on, for data other than those that the variances are of.

    extents (C, 2, 2), px: least and largest u, v by camera; finest, px: pitch of the finest grid,
    NaN without one; landmark, board (L,), points (L, 3), m: the target, by ascending numbers;
    modes (L, 3, K) and alone (L, 3), m: how far its landmarks are off along the axes of their
    boards, each as a sum of the modes, drawn once for all, and of what it has alone.
    """

    extents: Array
    finest: float
    landmark: Index
    board: Index
    points: Array
    modes: Array
    alone: Array

    @classmethod
    def measure(
        cls, linear: Linearization, finest: float, modes: Array, alone: Array
    ) -> ColumnGeometry:
        """Return that of a linearised state; modes, alone: see above."""
        views = linear.data.views
        used = views.used
        landmark, first = np.unique(views.landmark[used], return_index=True)
        return cls(GatheredPoints.gather(linear).extents, finest, landmark,
                   views.board[used][first], views.points[used][first], modes, alone)


class BoardLandmarks(NamedTuple):
    """The landmarks of a design: ids (L,), their boards, by place (L,), and where on them (L, 2).

    board_of (L,): among `boards`; at (L, 2): place on the board over its size.
    """

    ids: Index
    boards: list[Board]
    board_of: Index
    at: Array

    @classmethod
    def of_geometry(cls, geometry: ColumnGeometry) -> BoardLandmarks:
        """Return those that a geometry is of."""
        boards = find_boards(geometry.points, geometry.board)
        board_of = np.searchsorted([one.id for one in boards], geometry.board)
        at = np.zeros((len(geometry.points), 2))
        for i, one in enumerate(boards):
            mine = board_of == i
            at[mine] = one.to_board(geometry.points[mine])[:, :2]
        return cls(geometry.landmark, boards, board_of, at)


class GatheredPoints(NamedTuple):
    """The points of all frames, (F, N) each: N of all cameras; what a design is built from.

    used; uv (F, N, 2), px; weight, 1/px; camera; slot: place among the landmarks, -1 for none;
    board: place among the boards; local (F, N, 2): place on the board over its size; place
    (F, N, 2, 3): whitened derivatives by an offset along the board's axes, per mm; extents
    (C, 2, 2), px: see `ColumnGeometry`.
    """

    used: Mask
    uv: Array
    weight: Array
    camera: Index
    slot: Index
    board: Index
    local: Array
    place: Array
    extents: Array
    landmarks: BoardLandmarks

    @classmethod
    def gather(
        cls, linear: Linearization, geometry: ColumnGeometry | None = None
    ) -> GatheredPoints:
        """Gather the points of a linearized state; geometry: None for its own."""
        data, views = linear.data, linear.data.views

        def rows(values: Array | Index) -> Array:
            return data.blocks(np.asarray(values, dtype=float)[..., None, :])

        weight = rows(linear.weight[..., None])[..., 0]
        shown = used = weight > 0
        camera = np.broadcast_to(data.camera_of[:, None, None], (*views.landmark.shape, 1))
        camera = rows(camera)[..., 0].astype(np.int64)
        points, uv = rows(views.points), rows(np.nan_to_num(linear.linear.uv))
        landmark = rows(views.landmark[..., None])[..., 0].astype(np.int64)
        number = rows(views.board[..., None])[..., 0].astype(np.int64)
        if geometry is None:
            ids, boards = np.unique(landmark[used]), linear.scene.boards
        else:
            target = Target((), geometry.landmark, geometry.board, geometry.points)
            shown = used & (rows(target.landmark_mask(views).astype(float)[..., None])[..., 0] > 0)
            known = BoardLandmarks.of_geometry(geometry)
            ids, boards = known.ids, known.boards
        slot = np.where(shown, np.searchsorted(ids, landmark).clip(max=len(ids) - 1), -1)
        if geometry is not None:
            number, points = geometry.board[slot], geometry.points[slot]
        place = linear.whiten(linear.linear.d_target).reshape(*used.shape, 2, 3) * MILLIMETRE
        board, local, place = _turn_to_boards(boards, shown, number, points, place)
        if geometry is None:
            known = BoardLandmarks(
                ids, boards, np.zeros(len(ids), dtype=np.int64), np.zeros((len(ids), 2)))
            known.board_of[slot[used]], known.at[slot[used]] = board[used], local[used]
        extents = _extents(uv, used, camera) if geometry is None else geometry.extents
        return cls(used, uv, weight, camera, slot, board, local, place, extents, known)


def _turn_to_boards(
    boards: list[Board], shown: Mask, number: Index, points: Array, place: Array
) -> tuple[Index, Array, Array]:
    """Return the board of each point, by place, where it is on it, derivatives along its axes."""
    board, local = np.zeros(shown.shape, dtype=np.int64), np.zeros((*shown.shape, 2))
    for i, one in enumerate(boards):
        mine = shown & (number == one.id)
        board[mine], local[mine] = i, one.to_board(points[mine])[:, :2]
        place[mine] = place[mine] @ one.axes.T
    return board, local, place


def _extents(uv: Array, used: Mask, camera: Index) -> Array:
    """Return the least and the largest u, v of each camera, (C, 2, 2), px; NaN without points."""
    extents = np.full((int(camera.max()) + 1, 2, 2), np.nan)
    for i in range(len(extents)):
        mine = used & (camera == i)
        if mine.any():
            extents[i] = uv[mine].min(axis=0), uv[mine].max(axis=0)
    return extents
