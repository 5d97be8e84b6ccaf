"""Lens elements are not centered on one axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Parameter, PlaneEffect, Scene


@dataclass(frozen=True)
class DecenteringEffect(PlaneEffect):
    """Brown and Conrady p1, p2, in image points over the focal length."""

    name = 'decentering'
    signature = (
        'residuals that grow with the square of the image height, strongest along one diameter'
    )
    to_separate = 'landmarks over the whole field of view, to its edge, on all sides'

    parameters = (Parameter('p1', '1', 0.005), Parameter('p2', '1', 0.005))

    def plane_columns(self, scene: Scene) -> Array:
        x, y = np.moveaxis(scene.normalized_uv(), -1, 0)
        r2 = x * x + y * y
        p1 = np.stack([2 * x * y, r2 + 2 * y * y], axis=-1)
        p2 = np.stack([r2 + 2 * x * x, 2 * x * y], axis=-1)
        return np.stack([p1, p2], axis=-1)
