"""A board is bowed or warped, smoothly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Self

import numpy as np
from numpy.polynomial import polynomial

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Effect, Parameter, Scene, Untestable
from fisheye_svp_ros.scene.boards import Board

# id, centre (3), axis a (3), axis b (3), size: what places a board in the target frame.
BoardAxes = tuple[float, ...]

_DEGREES = (2, 3, 4, 6)


@dataclass(frozen=True)
class TargetShapeEffect(Effect):
    """A displacement along the normal, a polynomial of the place on the board from degree 2."""

    degree: int = 2
    boards: tuple[BoardAxes, ...] = field(default=(), metadata={'key': False})

    name = 'target_shape'
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
        every = tuple(_axes(board) for board in boards)
        highest = min(board.highest_degree for board in boards)
        forms: list[Effect] = [cls(degree, every) for degree in _DEGREES if degree <= highest]
        if len(every) > 1:
            forms.extend(cls(2, (one,)) for one in every)
        return forms

    def merge_with(self, other: Self) -> Effect:
        boards = tuple(dict.fromkeys((*self.boards, *other.boards)))
        return TargetShapeEffect(max(self.degree, other.degree), boards)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(
            Parameter(f'board{int(board[0])}.z{i}{j}', 'm', 0.005)
            for board in self.boards for i, j in _powers(self.degree)
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
            shape = np.stack([a[..., i] * b[..., j] for i, j in _powers(self.degree)], axis=-1)
            shape = shape * (views.board == number)[..., None]
            blocks.append(shape[..., None, :] * np.cross(first, second)[:, None])
        return np.concatenate(blocks, axis=-1)


def _powers(degree: int) -> list[tuple[int, int]]:
    return [(total - j, j) for total in range(2, degree + 1) for j in range(total + 1)]


def _axes(board: Board) -> BoardAxes:
    flat = (float(board.id), *board.centre, *board.axes[0], *board.axes[1], board.size)
    return tuple(float(x) for x in np.round(flat, 9))
