"""The scatter of the detector grows with the incidence angle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import NoiseEffect, Parameter, Scene


@dataclass(frozen=True)
class NoiseVsAngleEffect(NoiseEffect):
    """sigma(theta) = sigma(0) exp(growth theta^2)."""

    name = 'noise_vs_angle'
    signature = 'residuals without a pattern whose scatter grows towards the edge'
    to_separate = 'repeat the same view without moving anything: the scatter stays'

    parameters = (Parameter('growth', '1/rad^2', 0.5),)

    def noise_scale(self, scene: Scene, values: Array) -> Array:
        return np.asarray(np.exp(np.nan_to_num(values[0] * scene.theta**2)))
