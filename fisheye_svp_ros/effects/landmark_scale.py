"""The target is larger or smaller than stated, or stretched."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Effect, Parameter, Scene
from fisheye_svp_ros.scene.boards import find_boards


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
        whole, = find_boards(points, np.zeros(len(points), dtype=np.int64))
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
            return np.stack([arm @ one / 2 for one in stretches], axis=-1)
        contrasts = np.array([[0.5, -0.5, 0.0], [0.0, 0.0, 1.0]])[: self.axes - 1]
        return np.asarray(arm[..., None] * contrasts.T)
