"""The pixels are not square."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Parameter, PlaneEffect, Scene
from fisheye_svp_ros.optics.lens import Lens


@dataclass(frozen=True)
class AspectEffect(PlaneEffect):
    """A relative difference between fx and fy, their mean kept."""

    name = 'aspect'
    signature = 'residuals outward along one image axis and inward along the other'
    to_separate = 'views turned about the axis by 45 and 90 degrees'

    parameters = (Parameter('relative', '1', 0.01),)

    def plane_columns(self, scene: Scene) -> Array:
        return np.asarray((scene.normalized_uv() * [0.5, -0.5])[..., None])

    def extend(self, lens: Lens, values: Array) -> Lens:
        half = float(values[0]) / 2
        return replace(lens, fx=lens.fx * (1 + half), fy=lens.fy * (1 - half))

    def rescale_values(self, values: Array, ratio: float) -> Array:
        return values
