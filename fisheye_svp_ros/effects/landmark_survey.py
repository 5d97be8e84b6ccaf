"""Single landmarks are not where they are said to be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Effect, Parameter, Scene, Untestable


@dataclass(frozen=True)
class LandmarkSurveyEffect(Effect):
    """A displacement of each of the named landmarks."""

    landmarks: tuple[int, ...] = ()

    name: ClassVar[str] = 'landmark_survey'
    stage: ClassVar[str] = 'target'
    signature: ClassVar[str] = (
        'residuals of one landmark that point to the same place in space from every view'
    )
    confused_with: ClassVar[str] = 'target_shape, wrong_ids'
    to_separate: ClassVar[str] = (
        'measure the named landmarks again, by other means or from other sides'
    )

    @classmethod
    def candidates(cls, scene: Scene) -> Sequence[Effect]:
        ids, counts = np.unique(scene.views.landmark[scene.views.used], return_counts=True)
        often = ids[counts >= 3]
        if not often.size:
            raise Untestable('no landmark is seen three times')
        single: list[Effect] = [cls((int(landmark),)) for landmark in often]
        return single

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(
            Parameter(f'{landmark}.{axis}', 'm', 0.02)
            for landmark in self.landmarks for axis in 'xyz'
        )

    def columns(self, scene: Scene) -> Array:
        mine = scene.views.landmark[..., None] == np.array(self.landmarks)
        blocks = mine[..., None, :, None] * np.eye(3)[:, None, :]
        return np.asarray(blocks.reshape(*mine.shape[:2], 3, -1))
