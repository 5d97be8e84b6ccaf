"""Image points are rounded to a grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import NoiseEffect, Parameter


@dataclass(frozen=True)
class QuantisationEffect(NoiseEffect):
    """u and v are whole multiples of a step."""

    name = 'quantisation'
    # Values on a lattice repeat with the place within a pixel by themselves.
    hides = ('detector_bias',)
    hidden_structure = ('pixel_phase',)
    signature = 'every image point is a multiple of one step'
    to_separate = 'store the image points with more digits, or refine to sub-pixel'

    parameters = (Parameter('step', 'px', 1.0),)

    def record_points(self, uv: Array, values: Array, rng: np.random.Generator) -> Array:
        return np.asarray(np.round(uv / values[0]) * values[0])
