"""Effects on the target: single landmarks, its scale, its boards."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from numpy.polynomial import polynomial

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.effects.base import Effect, Parameter, Scene, Untestable
from fisheye_svp_ros.pose import cross_matrix
from fisheye_svp_ros.scene.boards import Board, find_boards

MIN_VIEWS = 3  # a landmark seen less often has no residual left to speak of
# id, center (3), axis a (3), axis b (3), size: what places a board in the target frame.
BoardAxes = tuple[float, ...]

_DEGREES = (2, 3, 4, 6)


@dataclass(frozen=True)
class LandmarkSurveyEffect(Effect):
    """A displacement of each of the named landmarks; `everywhere` says that all are meant."""

    landmarks: tuple[int, ...] = ()
    everywhere: bool = False

    name = 'landmark_survey'
    headline = 'Single landmarks are displaced'
    meaning = 'Single landmarks are displaced.'
    stage = 'target'
    target_map = 'single'
    asked_last = True
    signature = 'residuals of one landmark that point to the same place in space from every view'
    to_separate = 'measure the named landmarks again, by other means or from other sides'

    @classmethod
    def candidates(cls, scene: Scene) -> Sequence[Effect]:
        """Return the form with all landmarks; single ones are found by a scan of their own."""
        ids, counts = np.unique(scene.views.landmark[scene.views.used], return_counts=True)
        often = ids[counts >= MIN_VIEWS]
        if not often.size:
            raise Untestable(f'no landmark is seen {MIN_VIEWS} times')
        return [cls(tuple(int(i) for i in often), everywhere=True)]

    def merge_with(self, other: Self) -> Effect:
        if other.everywhere:
            return other
        return replace(self, landmarks=tuple(dict.fromkeys((*self.landmarks, *other.landmarks))))

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(
            Parameter(f'{landmark}.{axis}', 'm', 0.02)
            for landmark in self.landmarks
            for axis in 'xyz'
        )

    @property
    def key(self) -> str:
        what = 'all' if self.everywhere else ' '.join(map(str, self.landmarks))
        return f'{self.name}(landmarks={what})'

    def slots(self, landmark: Index) -> Index:
        """Return the place (...) of each landmark among the displaced ones, -1 for the others."""
        landmarks = np.array(self.landmarks)
        order = np.argsort(landmarks)
        slot = np.clip(np.searchsorted(landmarks, landmark, sorter=order), 0, len(landmarks) - 1)
        return np.where(landmarks[order[slot]] == landmark, order[slot], -1)

    def columns(self, scene: Scene) -> Array:
        slot = self.slots(scene.views.landmark)
        columns = np.zeros((*slot.shape, 3, len(self.landmarks), 3))
        view, point = np.nonzero(slot >= 0)
        columns[view, point, :, slot[view, point]] = np.eye(3)
        return columns.reshape(*slot.shape, 3, len(self.parameters))

    def displacement(self, scene: Scene, values: Array) -> Array:
        slot = self.slots(scene.views.landmark)
        moves = np.concatenate([values.reshape(-1, 3), np.zeros((1, 3))])
        return np.asarray(moves[slot])


@dataclass(frozen=True)
class LandmarkScaleEffect(Effect):
    """A relative change of scale: 1 of the whole target, 2 of x over y, 3 of z as well.

    plane: directions x (3,) and y (3,) along a flat target, which may be stretched along its
    diagonals, too (2); empty for those of the target's frame.
    """

    axes: int = 1
    centre: tuple[float, ...] = field(default=(0.0, 0.0, 0.0), metadata={'key': False})
    plane: tuple[float, ...] = field(default=(), metadata={'key': False})

    name = 'landmark_scale'
    headline = 'The scale of the target is wrong'
    meaning = 'The target is larger or smaller than stated, or stretched.'
    stage = 'target'
    signature = (
        'residuals as if all landmarks had moved away from the center of the target, or away from '
        'one line and towards another'
    )
    to_separate = (
        'measure one long distance on the target, and both its diagonals; a rig of known '
        'baseline; known poses'
    )

    @classmethod
    def candidates(cls, scene: Scene) -> Sequence[Effect]:
        points = scene.views.points[scene.views.used]
        where = tuple(float(x) for x in np.round(points.mean(axis=0), 9))
        (whole,) = find_boards(points, np.zeros(len(points), dtype=np.int64))
        # Several boards may each be stretched their own way: the null model knows how much.
        plane = tuple(float(x) for x in np.round(whole.axes[:2].ravel(), 9))
        return [cls(1, where), cls(2, where, plane) if whole.flat else cls(3, where)]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        names = ('relative',) if self.axes == 1 else ('x_over_y', 'z_over_xy')[: self.axes - 1]
        if self.plane:
            names = 'x_over_y', 'xy_shear'
        return tuple(Parameter(name, '1', 0.01) for name in names)

    def columns(self, scene: Scene) -> Array:
        arm = scene.views.points - np.array(self.centre)
        if self.axes == 1:
            return np.asarray(arm[..., None])
        if self.plane:
            x, y = np.reshape(self.plane, (2, 3))
            stretches = np.outer(x, x) - np.outer(y, y), np.outer(x, y) + np.outer(y, x)
            return np.stack([arm @ stretch / 2 for stretch in stretches], axis=-1)
        contrasts = np.array([[0.5, -0.5, 0.0], [0.0, 0.0, 1.0]])[: self.axes - 1]
        return np.asarray(arm[..., None] * contrasts.T)


@dataclass(frozen=True)
class TargetShapeEffect(Effect):
    """A displacement along the normal, a polynomial of the place on the board from degree 2."""

    degree: int = 2
    boards: tuple[BoardAxes, ...] = field(default=(), metadata={'key': False})

    name = 'target_shape'
    meaning = 'A board is bowed or warped, smoothly.'
    stage = 'target'
    target_map = 'smooth'
    signature = (
        'residuals fixed to the board: the same place has the same height error in every view'
    )
    to_separate = (
        'turn the board about its normal and tilt it between views; measure its flatness with a '
        'ruler'
    )

    @classmethod
    def candidates(cls, scene: Scene) -> Sequence[Effect]:
        boards = [board for board in scene.boards if board.flat]
        if not boards:
            raise Untestable('no landmarks lie on a flat board that could be bowed')
        every = tuple(_board_axes(board) for board in boards)
        highest = min(board.highest_degree for board in boards)
        forms: list[Effect] = [cls(degree, every) for degree in _DEGREES if degree <= highest]
        if len(every) > 1:
            forms.extend(cls(2, (number,)) for number in every)
        return forms

    def merge_with(self, other: Self) -> Effect:
        boards = tuple(dict.fromkeys((*self.boards, *other.boards)))
        return TargetShapeEffect(max(self.degree, other.degree), boards)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(
            Parameter(f'board{int(board[0])}.z{i}{j}', 'm', 0.005)
            for board in self.boards
            for i, j in _monomials(self.degree)
        )

    @property
    def key(self) -> str:
        ids = ' '.join(str(int(board[0])) for board in self.boards)
        return f'{self.name}(degree={self.degree}, boards={ids})'

    def columns(self, scene: Scene) -> Array:
        views = scene.views
        blocks = []
        for number, ox, oy, oz, ax, ay, az, bx, by, bz, size in self.boards:
            arm = (views.points - np.array([ox, oy, oz])) / size
            first, second = np.array([ax, ay, az]), np.array([bx, by, bz])
            a, b = (polynomial.polyvander(arm @ axis, self.degree) for axis in (first, second))
            shape = np.stack([a[..., i] * b[..., j] for i, j in _monomials(self.degree)], axis=-1)
            shape = shape * (views.board == number)[..., None]
            blocks.append(shape[..., None, :] * np.cross(first, second)[:, None])
        return np.concatenate(blocks, axis=-1)


def _monomials(degree: int) -> list[tuple[int, int]]:
    return [(total - j, j) for total in range(2, degree + 1) for j in range(total + 1)]


def _board_axes(board: Board) -> BoardAxes:
    flat = (float(board.id), *board.center, *board.axes[0], *board.axes[1], board.size)
    return tuple(float(x) for x in np.round(flat, 9))


@dataclass(frozen=True)
class BoardPoseEffect(Effect):
    """A shift and a turn of each named board about its center."""

    boards: tuple[tuple[float, ...], ...] = field(default=(), metadata={'key': False})

    name = 'board_pose'
    headline = 'The relative poses of the boards are wrong'
    meaning = 'The relative poses of the boards of one target are wrong.'
    stage = 'target'
    signature = (
        'residuals of a whole board that point to the same small motion of it in every view'
    )
    to_separate = 'views that show the board together with the others, from several sides'

    @classmethod
    def candidates(cls, scene: Scene) -> Sequence[Effect]:
        if len(scene.boards) < 2:
            raise Untestable('the target is one rigid piece (no second board)')
        labels, counts = np.unique(scene.views.board[scene.views.used], return_counts=True)
        reference = labels[np.argmax(counts)]
        boards = [
            (float(board.id), *(float(x) for x in np.round(board.center, 9)))
            for board in scene.boards
            if board.id != reference
        ]
        forms: list[Effect] = [cls((landmark,)) for landmark in boards]
        return forms if len(boards) == 1 else [cls(tuple(boards)), *forms]

    def merge_with(self, other: Self) -> Effect:
        return replace(self, boards=tuple(dict.fromkeys((*self.boards, *other.boards))))

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(
            Parameter(f'board{int(board[0])}.{axis}', unit, 0.01)
            for board in self.boards
            for unit, axes in (('m', ('x', 'y', 'z')), ('rad', ('rx', 'ry', 'rz')))
            for axis in axes
        )

    @property
    def key(self) -> str:
        return f'{self.name}(boards={" ".join(str(int(board[0])) for board in self.boards)})'

    def columns(self, scene: Scene) -> Array:
        blocks = []
        for number, *center in self.boards:
            on_board = (scene.views.board == number)[..., None, None]
            arm = scene.views.points - np.array(center)
            shift = np.broadcast_to(np.eye(3), (*arm.shape, 3))
            blocks.append(np.concatenate([shift, -cross_matrix(arm)], axis=-1) * on_board)
        return np.concatenate(blocks, axis=-1)
