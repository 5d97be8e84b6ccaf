"""The second camera of a rig exposes later than its stamp says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Effect, Parameter, Scene, require_cameras, require_motion


@dataclass(frozen=True)
class StereoTimeOffsetEffect(Effect):
    """A delay of every camera but the first; motion from the neighbouring frames."""

    name = 'stereo_time_offset'
    stage = 'pose'
    of_motion = True
    of_frames = True
    signature = 'residuals of one camera against the other that grow with the speed of the rig'
    to_separate = 'the same scene with the rig at rest; a flash of light visible to both cameras'

    @classmethod
    def candidates(cls, scene: Scene) -> Sequence[Effect]:
        require_cameras(scene)
        require_motion(scene)
        return [cls()]

    parameters = (Parameter('delay', 's', 0.05),)

    def columns(self, scene: Scene) -> Array:
        later = scene.twist * (scene.views.camera > 0)[:, None]
        return np.broadcast_to(later[:, None, :, None], (*scene.uv.shape[:2], 6, 1))
