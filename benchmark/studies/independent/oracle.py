"""The yardstick: the likelihood-ratio test that is told which effect to look for, and where.

Design, section 8.  Beside what is free (`Free`), an effect is one known direction of image points;
its amplitude over its standard error is normal where the effect is not there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import stats

from benchmark.studies.independent.adjust import Free
from benchmark.studies.independent.camera import Array
from benchmark.studies.independent.formation import Departure, form, simulated
from benchmark.studies.independent.scene import Scene

SIGNIFICANCE = 0.05  # of all effects of the design together


def amplitudes(
    scene: Scene, free: Free, uv: Array, departures: Sequence[Departure]
) -> list[float | None]:
    """Return each effect's fitted amplitude over its standard error.

    uv (M, 2): image points as they are handed over, px.  Held-out frames do not count.  None for
    what only changes noise, names or digits: it has no direction.
    """
    nominal, kept = simulated(scene), ~scene.held[scene.frame]
    left = free.step(uv - nominal).left[kept]
    scores: list[float | None] = []
    for departure in departures:
        known = free.step(form(scene, [departure]) - nominal).left[kept]
        length = float(np.linalg.norm(known))
        visible = length > 1e-6 * scene.noise
        scores.append(float((known * left).sum()) / (scene.noise * length) if visible else None)
    return scores


def finds(amplitude: float, effects: int) -> bool:
    """Whether the oracle finds an effect, at a significance divided by the number of effects."""
    return bool(2 * stats.norm.sf(abs(amplitude)) < SIGNIFICANCE / effects)
