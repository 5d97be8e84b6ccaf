"""The principal point differs from the one assumed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Effect, Parameter, Scene
from fisheye_svp_ros.optics.lens import Lens


@dataclass(frozen=True)
class PrincipalPointEffect(Effect):
    """A shift of the whole image."""

    name = 'principal_point'
    stage = 'image'
    signature = 'residuals with a constant part that no rotation of the camera absorbs'
    to_separate = 'landmarks over the whole field of view; views turned about the axis'

    parameters = (Parameter('cx', 'px', 10.0), Parameter('cy', 'px', 10.0))

    def columns(self, scene: Scene) -> Array:
        return np.broadcast_to(np.eye(2), (*scene.uv.shape, 2))

    def extend(self, lens: Lens, values: Array) -> Lens:
        return replace(lens, cx=lens.cx + float(values[0]), cy=lens.cy + float(values[1]))
