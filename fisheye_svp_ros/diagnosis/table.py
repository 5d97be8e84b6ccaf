"""Causes and errors that lie in the table of image points, or in their noise."""

from __future__ import annotations

from typing import Any

import numpy as np

from fisheye_svp_ros.diagnosis.causes import Cause, plain_cause
from fisheye_svp_ros.diagnosis.noise import Gross, NoiseCause
from fisheye_svp_ros.diagnosis.structure import Structure
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.scene.photograph_names import photograph_entry


def table_causes(observations: Observations, gross: Gross, step: float) -> list[Cause]:
    """Return causes in the table: wrong ids, and rounding to a step (px; 0 for none)."""
    causes = []
    swapped = gross.swapped
    # One of many gross errors is chance.
    if swapped > 1 or 2 * swapped >= len(gross.rows) > 0:
        fraction = swapped / len(observations)
        value = {'value': fraction, 'stderr': fraction / np.sqrt(swapped), 'unit': '1'}
        causes.append(plain_cause('wrong_ids', {'fraction': value}, 0.0, 0.0))
    if step:
        value = {'value': step, 'stderr': 0.0, 'unit': 'px'}
        causes.append(plain_cause('quantisation', {'step': value}, 0.0, 0.0))
    return causes


def growth_cause(growth: NoiseCause | None) -> list[Cause]:
    """Return noise that grows with the angle as a cause, if it does."""
    if growth is None:
        return []
    value = {'value': growth.value, 'stderr': growth.stderr, 'unit': '1/rad^2'}
    return [plain_cause('noise_vs_angle', {'growth': value}, growth.p_value, 0.0)]


def with_outliers(
    left: list[Structure], gross: Gross, observations: int
) -> list[Structure]:
    """Return what remains, with gross errors that are no mere wrong ids."""
    far = len(gross.rows) - gross.swapped
    if not far:
        return left
    rest = [s for s in left if s.variable != 'outliers']
    return [*rest, Structure('outliers', 0.0, far / observations)]


def gross_rows(
    observations: Observations, gross: Gross, where: str = ''
) -> list[dict[str, Any]]:
    """Return gross errors by frame and landmark, the farthest first."""
    found = []
    for i in np.argsort(-gross.px, kind='stable'):
        row = gross.rows[i]
        frame = int(observations.frame[row])
        camera = observations.cameras[observations.camera[row]]
        found.append({
            'frame': frame, **photograph_entry(observations, frame, camera),
            'landmark': int(observations.landmark[row]),
            'px': float(gross.px[i]), 'why': where + gross.why[i],
            **({'camera': camera} if len(observations.cameras) > 1 else {}),
        })
    return found
