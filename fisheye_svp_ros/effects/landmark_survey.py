"""Single landmarks are displaced."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.effects.base import Effect, Parameter, Scene, Untestable

MIN_VIEWS = 3  # a landmark seen less often has no residual left to speak of


@dataclass(frozen=True)
class LandmarkSurveyEffect(Effect):
    """A displacement of each of the named landmarks; `everywhere` says that all are meant."""

    landmarks: tuple[int, ...] = ()
    everywhere: bool = False

    name = 'landmark_survey'
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
            for landmark in self.landmarks for axis in 'xyz'
        )

    @property
    def key(self) -> str:
        what = 'all' if self.everywhere else ' '.join(map(str, self.landmarks))
        return f'{self.name}(landmarks={what})'

    def slots(self, landmark: Index) -> Index:
        """Return the place (...) of each landmark among the displaced ones, -1 for the others."""
        known = np.array(self.landmarks)
        order = np.argsort(known)
        slot = np.clip(np.searchsorted(known, landmark, sorter=order), 0, len(known) - 1)
        return np.where(known[order[slot]] == landmark, order[slot], -1)

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
