"""The variance budget: what several causes do together, shared between them."""

import numpy as np
import pytest
from helpers.scenes import lens, observe, scene

from fisheye_svp_ros.diagnosis import NullModel
from fisheye_svp_ros.diagnosis.variance_budget import cause_squares
from fisheye_svp_ros.effects.base import ModelTerm
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.solve.bundle_adjustment import adjust
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.rig_state import group_by_frame, with_effect


@pytest.fixture
def state():
    """Return data and a fit that holds three causes, two of which undo most of each other."""
    rng = np.random.default_rng(4)
    pose, views = scene(rng, 1, 12)
    terms = [
        ModelTerm(CATALOGUE['decentering'](), np.array([0.004, 0.002])),
        ModelTerm(CATALOGUE['skew'](), np.array([3e-4])),
    ]
    data = group_by_frame(observe(lens(), tuple(terms), pose, views, 0.1, rng))
    found = with_effect(initial_state(data, lens()), terms[0].effect, terms[0].values)
    for name in ('sensor_tilt', 'skew'):
        found = with_effect(found, CATALOGUE[name]())
    return data, adjust(data, found, ('cx', 'cy'))


def displacement(null, names):
    """Return the mean squared displacement by some causes, px^2, beside poses and intrinsics."""
    linear = null.linear
    shared = linear.shared_columns
    signal = np.zeros(linear.residual.shape)
    for term in null.terms:
        if term.name in names:
            signal += shared[..., term.columns] @ term.values
    frames, rows, _ = linear.frame_columns.shape
    poses = np.zeros((frames, rows, frames, 6))
    poses[np.arange(frames), :, np.arange(frames)] = linear.frame_columns
    taken = np.concatenate(
        [poses.reshape(frames * rows, -1), shared[..., :2].reshape(frames * rows, -1)], axis=1
    )
    apart = signal.ravel() - taken @ np.linalg.lstsq(taken, signal.ravel(), rcond=None)[0]
    weight = linear.row_weight[linear.row_mask]
    return 2 * float(np.mean((apart[linear.row_mask.ravel()] / weight) ** 2))


def test_shares_add_up_to_what_all_causes_do_together(state):
    """Two that undo each other are worth little, not one a lot and the other nothing."""
    null = NullModel.with_variances(*state, ('cx', 'cy'))
    squares = cause_squares(null, null.terms)
    assert list(squares) == ['decentering', 'sensor_tilt', 'skew']
    assert min(squares.values()) > 0
    assert sum(squares.values()) == pytest.approx(displacement(null, squares), rel=1e-6)
