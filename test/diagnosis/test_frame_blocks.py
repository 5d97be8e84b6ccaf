"""Contiguous thirds of the frames warn of a cause that only the others have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.water import AIR, photographs

from fisheye_svp_ros.diagnosis.fitted_model import FittedModel
from fisheye_svp_ros.diagnosis.frame_blocks import refuting_blocks
from fisheye_svp_ros.diagnosis.null_model import NullModel
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.solve.bundle_adjustment import adjust
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.rig_state import group_by_frame, with_effect

SKEW = 3e-3


@pytest.mark.parametrize(('last', 'refuting'), [(0.0, {'skew': ((10, 14),)}), (SKEW, {})])
def test_a_third_without_it_refutes_a_cause(last, refuting):
    seen = photographs(AIR, None, 15, 0.1, 2)
    skew = np.where(seen.frame < 10, SKEW, last)
    moved = seen.uv + np.stack([skew * (seen.uv[:, 1] - AIR.cy), np.zeros(len(skew))], axis=-1)
    data = group_by_frame(replace(seen, uv=moved))
    state = with_effect(initial_state(data, AIR), CATALOGUE['skew']())
    null = NullModel.with_variances(data, adjust(data, state, ()), ())
    assert refuting_blocks(null, FittedModel.solve_null_model(null)) == refuting
