"""The rows of the image are exposed one after the other while the camera moves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Effect, Parameter, Scene, require_motion


@dataclass(frozen=True)
class RollingShutterEffect(Effect):
    """The read-out time from the first row to the last; motion from neighbours without a pause."""

    name = 'rolling_shutter'
    stage = 'pose'
    of_motion = True
    of_frames = True
    signature = (
        'residuals that grow with the distance from the middle row and with the camera speed'
    )
    to_separate = 'the same scene from a tripod: the residuals vanish when nothing moves'

    @classmethod
    def candidates(cls, scene: Scene) -> Sequence[Effect]:
        require_motion(scene)
        return [cls()]

    parameters = (Parameter('readout', 's', 0.05),)

    def columns(self, scene: Scene) -> Array:
        fraction = scene.uv[..., 1] / scene.lens.height - 0.5
        return np.asarray((fraction[..., None] * scene.twist[:, None, :])[..., None])
