"""The target is larger or smaller than it is said to be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Effect, Parameter, Scene


@dataclass(frozen=True)
class LandmarkScaleEffect(Effect):
    """A relative change of scale, of the whole target or along each of its axes."""

    axes: int = 1
    centre: tuple[float, ...] = field(default=(0.0, 0.0, 0.0), metadata={'key': False})

    name: ClassVar[str] = 'landmark_scale'
    stage: ClassVar[str] = 'target'
    signature: ClassVar[str] = (
        'residuals as if all landmarks had moved away from the centre of the target'
    )
    confused_with: ClassVar[str] = (
        'focal_length with known poses; with unknown poses one camera cannot see a uniform scale'
    )
    to_separate: ClassVar[str] = (
        'measure one long distance on the target; a rig of known baseline; known poses'
    )

    @classmethod
    def candidates(cls, scene: Scene) -> Sequence[Effect]:
        centre = scene.views.points[scene.views.used].mean(axis=0)
        where = tuple(float(x) for x in np.round(centre, 9))
        return [cls(1, where), cls(3, where)]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        names = ('relative',) if self.axes == 1 else ('relative_x', 'relative_y', 'relative_z')
        return tuple(Parameter(name, '1', 0.01) for name in names)

    def columns(self, scene: Scene) -> Array:
        arm = scene.views.points - np.array(self.centre)
        return np.asarray(arm[..., None] * (1.0 if self.axes == 1 else np.eye(3)))
