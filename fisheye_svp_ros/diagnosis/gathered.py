"""The points of all frames, gathered: what the random parts of the null model are built from."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.diagnosis.model import Linearised
from fisheye_svp_ros.effects.target import Target
from fisheye_svp_ros.scene.boards import Board, find_boards

MILLIMETRE = 1e-3  # unit of offsets on the target


class Setting(NamedTuple):
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
    def of(cls, linear: Linearised, finest: float, modes: Array, alone: Array) -> Setting:
        """Return that of a linearised state; modes, alone: see above."""
        views = linear.data.views
        used = views.used
        landmark, first = np.unique(views.landmark[used], return_index=True)
        return cls(GatheredPoints.of(linear).extents, finest, landmark,
                   views.board[used][first], views.points[used][first], modes, alone)


class GatheredPoints(NamedTuple):
    """The points of all frames, (F, N) each: N of all cameras; what a design is built from.

    used; uv (F, N, 2), px; weight, 1/px; camera; slot: place among the landmarks, -1 for none,
    landmark (L,): their ids; board: place among the boards; local (F, N, 2): place on
    the board over its size; place (F, N, 2, 3): whitened derivatives by an offset along the
    board's axes, per mm.  extents (C, 2, 2), px: see `Setting`; boards, and of_landmark (L,): that
    of each landmark, at (L, 2): where it is on it.
    """

    used: Mask
    uv: Array
    weight: Array
    camera: Index
    slot: Index
    landmark: Index
    board: Index
    local: Array
    place: Array
    extents: Array
    boards: list[Board]
    of_landmark: Index
    at: Array

    @classmethod
    def of(cls, linear: Linearised, setting: Setting | None = None) -> GatheredPoints:
        """Gather the points of a linearised state; setting: None for its own."""
        data, views = linear.data, linear.data.views

        def rows(values: Array | Index) -> Array:
            return data.blocks(np.asarray(values, dtype=float)[..., None, :])

        weight = rows(linear.weight[..., None])[..., 0]
        used = weight > 0
        camera = np.broadcast_to(data.camera_of[:, None, None], (*views.landmark.shape, 1))
        camera = rows(camera)[..., 0].astype(np.int64)
        points, uv = rows(views.points), rows(np.nan_to_num(linear.linear.uv))
        landmark = rows(views.landmark[..., None])[..., 0].astype(np.int64)
        number = rows(views.board[..., None])[..., 0].astype(np.int64)
        if setting is None:
            known, shown, boards = np.unique(landmark[used]), used, linear.scene.boards
            extents = _extents(uv, used, camera)
        else:
            target = Target((), setting.landmark, setting.board, setting.points)
            there = rows(target.shown(views).astype(float)[..., None])[..., 0] > 0
            known, shown = setting.landmark, used & there
            boards, extents = find_boards(setting.points, setting.board), setting.extents
        slot = np.where(shown, np.searchsorted(known, landmark).clip(max=len(known) - 1), -1)
        if setting is not None:
            number, points = setting.board[slot], setting.points[slot]
        place = linear.whitened(linear.linear.d_target).reshape(*used.shape, 2, 3) * MILLIMETRE
        board, local = np.zeros(used.shape, dtype=np.int64), np.zeros((*used.shape, 2))
        for i, one in enumerate(boards):
            mine = shown & (number == one.id)
            board[mine], local[mine] = i, one.local(points[mine])[:, :2]
            place[mine] = place[mine] @ one.axes.T
        of_landmark, at = np.zeros(len(known), dtype=np.int64), np.zeros((len(known), 2))
        if setting is None:
            of_landmark[slot[used]], at[slot[used]] = board[used], local[used]
        else:
            of_landmark = np.searchsorted([one.id for one in boards], setting.board)
            for i, one in enumerate(boards):
                mine = of_landmark == i
                at[mine] = one.local(setting.points[mine])[:, :2]
        return cls(used, uv, weight, camera, slot, known, board, local, place, extents, boards,
                   of_landmark, at)


def _extents(uv: Array, used: Mask, camera: Index) -> Array:
    """Return the least and the largest u, v of each camera, (C, 2, 2), px; NaN without points."""
    extents = np.full((int(camera.max()) + 1, 2, 2), np.nan)
    for i in range(len(extents)):
        mine = used & (camera == i)
        if mine.any():
            extents[i] = uv[mine].min(axis=0), uv[mine].max(axis=0)
    return extents
