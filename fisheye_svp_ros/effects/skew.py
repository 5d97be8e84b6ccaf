"""The pixel axes are not square to each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Parameter, PlaneEffect, Scene


@dataclass(frozen=True)
class SkewEffect(PlaneEffect):
    """A shear: u grows with v."""

    name = 'skew'
    signature = (
        'residuals like a shear of the image: outward along one diagonal, inward along the '
        'other'
    )
    to_separate = 'views turned about the axis by 45 and 90 degrees'

    parameters = (Parameter('shear', '1', 0.01),)

    def plane_columns(self, scene: Scene) -> Array:
        column = np.zeros((*scene.uv.shape, 1))
        column[..., 0, 0] = scene.normalized_uv()[..., 1]
        return column
