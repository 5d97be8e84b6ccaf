"""The sensor is not square to the optical axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Parameter, PlaneEffect, Scene


@dataclass(frozen=True)
class SensorTiltEffect(PlaneEffect):
    """Tilts about the image axes; first order, with the focal length as the image distance."""

    name = 'sensor_tilt'
    signature = (
        'residuals along the radius, outward on one side of the image and inward on the other'
    )
    to_separate = 'landmarks over the whole field of view, to its edge, on all sides'

    parameters = (Parameter('about_x', 'rad', 0.01), Parameter('about_y', 'rad', 0.01))

    def plane_columns(self, scene: Scene) -> Array:
        m = scene.normalized_uv()
        return np.stack([m * m[..., 1:], -m * m[..., :1]], axis=-1)
