"""The relative poses of the boards of one target are wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Effect, Parameter, Scene, Untestable
from fisheye_svp_ros.pose import cross_matrix


@dataclass(frozen=True)
class BoardPoseEffect(Effect):
    """A shift and a turn of each named board about its centre."""

    boards: tuple[tuple[float, ...], ...] = field(default=(), metadata={'key': False})

    name = 'board_pose'
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
        others = [
            (float(board.id), *(float(x) for x in np.round(board.centre, 9)))
            for board in scene.boards if board.id != reference
        ]
        forms: list[Effect] = [cls((one,)) for one in others]
        return forms if len(others) == 1 else [cls(tuple(others)), *forms]

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
        for number, *centre in self.boards:
            mine = (scene.views.board == number)[..., None, None]
            arm = scene.views.points - np.array(centre)
            shift = np.broadcast_to(np.eye(3), (*arm.shape, 3))
            blocks.append(np.concatenate([shift, -cross_matrix(arm)], axis=-1) * mine)
        return np.concatenate(blocks, axis=-1)
