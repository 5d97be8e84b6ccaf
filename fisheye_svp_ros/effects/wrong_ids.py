"""Some image points carry the id of another landmark."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import NoiseEffect, Parameter


@dataclass(frozen=True)
class WrongIdsEffect(NoiseEffect):
    """A part of the observations is swapped with others of the same view."""

    name = 'wrong_ids'
    signature = 'a few huge residuals that end where another landmark is predicted'
    to_separate = 'check the named image points; match the ids again'

    parameters = (Parameter('fraction', '1', 0.02),)

    def record_points(self, uv: Array, values: Array, rng: np.random.Generator) -> Array:
        swapped = uv.copy()
        for view, seen in enumerate(np.asarray(np.isfinite(uv).all(axis=-1))):
            points = rng.permutation(np.flatnonzero(seen))
            pairs = points[: len(points) // 2 * 2].reshape(-1, 2)
            pairs = pairs[rng.random(len(pairs)) < values[0]]
            swapped[view, pairs] = uv[view, pairs[:, ::-1]]
        return swapped
