"""Contiguous thirds of the frames warn of a cause that only the others have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.water import AIR, photographs

from fisheye_svp_ros.diagnosis.cross_validation import contiguous_blocks, refuting_blocks
from fisheye_svp_ros.diagnosis.fitted_model import FittedModel
from fisheye_svp_ros.diagnosis.null_model import NullModel
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.solve.bundle_adjustment import adjust
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.rig_checks import unpair_cameras
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


def test_views_of_one_frame_without_a_rig_are_in_one_third():
    """Nine views of three frames that no rig holds together ended in an IndexError."""
    one = photographs(AIR, None, 6, 0.1, 2)
    both = {
        name: np.concatenate([getattr(one, name)] * 2)
        for name in ('frame', 'landmark', 'board', 'uv', 'xyz', 't', 'sigma')
    }
    camera = np.repeat([0, 1], len(one.frame))
    pair = replace(one, cameras=('left', 'right'), camera=camera, **both)
    data = unpair_cameras(group_by_frame(pair))
    assert data.frames == 12
    block, ends = contiguous_blocks(data)
    assert ends == [(0, 1), (2, 3), (4, 5)]
    assert block.tolist() == (data.views.frame // 2).tolist()
    alone, same = contiguous_blocks(group_by_frame(one))
    assert same == ends and alone.tolist() == [0, 0, 1, 1, 2, 2]
