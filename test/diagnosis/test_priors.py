"""The prior of a viewpoint shift: in the refit and in the null model's products."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.scenes import lens, observe, scene

from fisheye_svp_ros.diagnosis import NullModel
from fisheye_svp_ros.diagnosis.fitted_model import refit
from fisheye_svp_ros.diagnosis.random_effects import NAMES
from fisheye_svp_ros.diagnosis.uncertainty import standard_errors
from fisheye_svp_ros.effects.base import ModelTerm
from fisheye_svp_ros.effects.ray_effects import ViewpointShiftEffect
from fisheye_svp_ros.effects.rig_effect import assign_camera
from fisheye_svp_ros.mixed_model import Variances, no_variances
from fisheye_svp_ros.optics.lens import intrinsic_names
from fisheye_svp_ros.solve.bundle_adjustment import Prior, adjust
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.rig_state import Linearization, RigState, RigViews, group_by_frame

SIGMA, SHIFT, ORDER = 0.2, 0.003, 3
FREE = intrinsic_names(lens())
LARGE = 0.01  # m
EFFECT = ViewpointShiftEffect(ORDER)


def few_views(seed: int = 2) -> tuple[RigViews, RigState, Variances]:
    """Return views that tell little of a shift of three orders, a state with it, and noise."""
    rng = np.random.default_rng(seed)
    pose, views = scene(rng, frames=5)
    terms = [ModelTerm(ViewpointShiftEffect(1), np.array([SHIFT]))]
    data = group_by_frame(observe(lens(), terms, pose, views, SIGMA, rng))
    state = adjust(data, initial_state(data, lens()), FREE)
    landmarks = len(np.unique(data.views.landmark[data.views.used]))
    variances = replace(no_variances(len(NAMES), landmarks), sigma=SIGMA)
    return data, replace(state, terms=(ModelTerm(EFFECT, np.zeros(ORDER)),)), variances


def prior_of(data: RigViews, state: RigState) -> np.ndarray:
    return EFFECT.prior_sigma(Linearization(data, state, FREE).scene)


def test_wild_orders_stay_within_the_prior() -> None:
    data, state, variances = few_views()
    expected = prior_of(data, state)
    free = adjust(data, state, FREE).terms[0].values
    assert (np.abs(free) > 3 * expected).any()
    fitted = refit(data, adjust(data, state, FREE), FREE, variances).terms[0].values
    assert (np.abs(fitted) < 2 * expected).all()


def test_the_refit_is_the_adjustment_under_the_same_prior() -> None:
    data, state, variances = few_views()
    root = np.diag(SIGMA / prior_of(data, state))
    fitted = refit(data, state, FREE, variances)
    whole = adjust(data, state, FREE, Prior(np.zeros(ORDER), root))
    expected = prior_of(data, state)
    off = (fitted.terms[0].values - whole.terms[0].values) / expected
    assert np.abs(off).max() < 0.02, off

    null = NullModel.with_variances(data, whole, FREE, variances)
    own = null.included_columns
    error = np.sqrt(np.diag(np.linalg.inv(null.information[np.ix_(own, own)])))
    assert np.abs(null.information[own, -1] * error).max() < 1e-3  # no gradient is left
    assert (standard_errors(null, jackknife=False)[-ORDER:] < expected).all()


def test_higher_orders_are_known_by_what_they_do_at_the_edge_of_the_field() -> None:
    data, state, _ = few_views()
    view = Linearization(data, state, FREE).scene
    sizes = EFFECT.prior_sigma(view) * view.lens.max_incidence ** (2 * np.arange(ORDER))
    assert sizes == pytest.approx(LARGE)
    left = assign_camera(ViewpointShiftEffect(1), 0, 'left')
    each = left.merge_with(assign_camera(ViewpointShiftEffect(2), 1, 'right'))
    rig = replace(view, cameras=((np.arange(1), 0, view), (np.arange(1), 1, view)))
    assert each.prior_sigma(rig) == pytest.approx(
        [LARGE, LARGE, LARGE / view.lens.max_incidence**2]
    )
