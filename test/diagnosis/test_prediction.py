"""Predictions of frames that were not used."""

import numpy as np
import pytest
from helpers.scenes import lens, observe, scene

from fisheye_svp_ros.diagnosis import NullModel
from fisheye_svp_ros.diagnosis.cross_validation import fit_without_causes
from fisheye_svp_ros.effects.base import ModelTerm
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.mixed_model import project_out
from fisheye_svp_ros.solve.bundle_adjustment import adjust, adjust_poses
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.rig_state import Linearization, group_by_frame, with_effect

FREE = ('fx', 'fy', 'cx', 'cy')


@pytest.mark.parametrize('size', [0.002, 0.1])
def test_without_a_cause_the_rest_is_fitted_anew_however_large_it_is(size):
    """A cause that moves points by many px hides intrinsics that no linear step finds."""
    rng = np.random.default_rng(4)
    pose, views = scene(rng, 1, 12)
    cause = ModelTerm(CATALOGUE['decentering'](), np.array([size, size / 2]))
    data = group_by_frame(observe(lens(), (cause,), pose, views, 0.1, rng))
    state = adjust(
        data, with_effect(initial_state(data, lens()), cause.effect, cause.values), FREE
    )
    null = NullModel.with_variances(data, state, FREE)
    without = fit_without_causes(null, ['decentering'], FREE)
    assert not without.terms
    best = adjust(data, initial_state(data, lens()), FREE)
    rms = [Linearization(data, one, ()).rms_px for one in (adjust_poses(data, without), best)]
    assert rms[0] == pytest.approx(rms[1], rel=1e-3)


def test_a_pose_takes_up_what_its_columns_do_and_nothing_else():
    rng = np.random.default_rng(0)
    columns, rows = rng.normal(size=(3, 20, 6)), rng.normal(size=(3, 20, 2))
    left = project_out(rows, columns)
    np.testing.assert_allclose(np.swapaxes(columns, -1, -2) @ left, 0.0, atol=1e-12)
    moved = project_out(rows + columns @ rng.normal(size=(3, 6, 2)), columns)
    np.testing.assert_allclose(moved, left, atol=1e-12)
