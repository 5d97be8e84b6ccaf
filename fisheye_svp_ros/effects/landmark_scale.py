"""The target is larger or smaller than it is said to be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Effect, Parameter, Scene


@dataclass(frozen=True)
class LandmarkScaleEffect(Effect):
    """A relative change of scale: 1 of the whole target, 2 of x over y, 3 of z as well."""

    axes: int = 1
    centre: tuple[float, ...] = field(default=(0.0, 0.0, 0.0), metadata={'key': False})

    name = 'landmark_scale'
    stage = 'target'
    signature = 'residuals as if all landmarks had moved away from the centre of the target'
    to_separate = 'measure one long distance on the target; a rig of known baseline; known poses'

    @classmethod
    def candidates(cls, scene: Scene) -> Sequence[Effect]:
        points = scene.views.points[scene.views.used]
        where = tuple(float(x) for x in np.round(points.mean(axis=0), 9))
        flat = np.ptp(points[:, 2]) < 1e-9
        return [cls(1, where), cls(2 if flat else 3, where)]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        names = ('relative',) if self.axes == 1 else ('x_over_y', 'z_over_xy')[: self.axes - 1]
        return tuple(Parameter(name, '1', 0.01) for name in names)

    def columns(self, scene: Scene) -> Array:
        arm = scene.views.points - np.array(self.centre)
        if self.axes == 1:
            return np.asarray(arm[..., None])
        contrasts = np.array([[0.5, -0.5, 0.0], [0.0, 0.0, 1.0]])[: self.axes - 1]
        return np.asarray(arm[..., None] * contrasts.T)
