"""The focal length differs from the one assumed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Effect, Parameter, Scene


@dataclass(frozen=True)
class FocalLengthEffect(Effect):
    """A relative change of the focal length."""

    name: ClassVar[str] = 'focal_length'
    stage: ClassVar[str] = 'image'
    signature: ClassVar[str] = (
        'residuals along the radius in proportion to the image height'
    )
    confused_with: ClassVar[str] = 'radial_profile, landmark_scale with known poses'
    to_separate: ClassVar[str] = (
        'landmarks over the whole field of view; a calibration of this very camera'
    )

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter('relative', '1', 0.02),)

    def columns(self, scene: Scene) -> Array:
        focal = np.array([scene.lens.fx, scene.lens.fy])
        return np.asarray((scene.normalised() * focal)[..., None])
