"""Contiguous thirds of the frames warn of a cause that only the others have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.water import AIR, photographs

from fisheye_svp_ros.diagnosis.cross_validation import (
    HeldOut,
    contiguous_blocks,
    cross_validate,
    predictable_rows,
    refuting_blocks,
)
from fisheye_svp_ros.diagnosis.fitted_model import FittedModel
from fisheye_svp_ros.diagnosis.null_model import NullModel
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.solve.bundle_adjustment import adjust
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.rig_checks import unpair_cameras
from fisheye_svp_ros.solve.rig_state import Linearization, group_by_frame, with_effect

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


def _one_frame_far_out(frames):
    """Return frames within 40 deg of the axis, and one that reaches to its edge, with its mask."""
    seen = photographs(AIR, None, frames, 0.1, 2)
    theta = np.hypot(*((seen.uv - [AIR.cx, AIR.cy]) / AIR.fx).T)
    far = seen.frame == 3
    kept = far | (theta < 0.7)
    return group_by_frame(seen.take(kept)), theta[kept], far[kept]


def test_frames_predict_no_points_farther_out_than_theirs():
    data, theta, _ = _one_frame_far_out(8)
    linear = Linearization(data, initial_state(data, AIR), ())
    rows = predictable_rows(linear)
    table = data.observations
    for frame in range(data.frames):
        mine = table.frame == data.frame_numbers[frame]
        expected = theta[mine].max(initial=0.0), theta[~mine].max()
        seen = np.count_nonzero(rows[frame]) / 2
        inside = np.count_nonzero(theta[mine] <= expected[1])
        assert seen == pytest.approx(inside, abs=1)
    assert 0 < np.count_nonzero(rows[3]) < np.count_nonzero(linear.row_mask[3])
    together = np.zeros(data.frames, dtype=np.int64)  # nothing is left to predict them
    assert (predictable_rows(linear, together) == linear.row_mask).all()


def test_what_a_lens_is_extrapolated_to_is_no_evidence_against_an_effect():
    """One frame that alone reached the edge refuted what made all the others better."""
    data, theta, far = _one_frame_far_out(8)
    table = data.observations
    bent = table.uv + np.where(far & (theta > 0.75), 30.0, 0.0)[:, None]
    data = group_by_frame(replace(table, uv=bent))
    null = NullModel.with_variances(data, initial_state(data, AIR), ('fx', 'fy'))
    held_out = cross_validate(null)
    assert np.sqrt(held_out.squares[3] / held_out.counts[3]) < 1.0
    rest = np.arange(data.frames) != 3
    assert (held_out.counts[rest] >= null.linear.row_mask[rest].sum(axis=1) / 2 - 1).all()


def test_a_frame_that_none_predicts_is_no_part_of_an_excess():
    both = HeldOut(np.array([80.0, 0.0]), np.array([43.0, 0.0]))
    assert both.excess(1.0, np.array([[0, 1]])) == pytest.approx(0.0)
    assert both.is_predictable.tolist() == [True, True]
