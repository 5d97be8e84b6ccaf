"""The sensor is not square to the optical axis."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Effect, Parameter, Scene


@dataclass(frozen=True)
class SensorTiltEffect(Effect):
    """Tilts about the image axes; first order, with the focal length as the image distance."""

    name: ClassVar[str] = 'sensor_tilt'
    stage: ClassVar[str] = 'image'
    signature: ClassVar[str] = (
        'residuals along the radius, outward on one side of the image and inward on the other'
    )
    confused_with: ClassVar[str] = 'decentering, principal_point'
    to_separate: ClassVar[str] = (
        'landmarks over the whole field of view, to its edge, on all sides'
    )

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter('about_x', 'rad', 0.01), Parameter('about_y', 'rad', 0.01))

    def columns(self, scene: Scene) -> Array:
        m = scene.normalised()
        focal = np.array([scene.lens.fx, scene.lens.fy])
        about_x, about_y = m * m[..., 1:], -m * m[..., :1]
        return np.asarray(np.stack([about_x, about_y], axis=-1) * focal[:, None])
