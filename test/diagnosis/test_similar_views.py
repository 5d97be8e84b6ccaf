"""What landmarks err by alike in similar views: found, predicted, and not seen in mere noise."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.scenes import lens, observe, scene

from fisheye_svp_ros.diagnosis import Action, diagnose
from fisheye_svp_ros.diagnosis.similar_views import similar_views
from fisheye_svp_ros.diagnosis.variance_budget import REPEATED_COMPONENT
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.solve.bundle_adjustment import adjust
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.rig_state import Linearization, group_by_frame

NOISE = 0.05
SESSIONS, FRAMES = 4, 24


def photographed(spread=0.0, seed=0):
    """Return a table of sessions a minute apart; spread: of what landmarks err by in each, px."""
    rng = np.random.default_rng(seed)
    pose, views = scene(rng, frames=FRAMES)
    session = np.arange(FRAMES) * SESSIONS // FRAMES
    views = views._replace(t=views.t + 60.0 * session[:, None])
    table = observe(lens(), (), pose, views, NOISE, rng)
    errs = spread * rng.normal(size=(SESSIONS, table.landmark.max() + 1, 2))
    return replace(table, uv=table.uv + errs[session[table.frame], table.landmark])


def linearized(table):
    data = group_by_frame(table)
    return Linearization(data, adjust(data, initial_state(data, lens()), ()), ())


def halves(table: Observations):
    """Return the even frames and the odd ones."""
    return table.take(table.frame % 2 == 0), table.take(table.frame % 2 == 1)


def test_what_repeats_is_found_predicted_and_told_of():
    """Of .1 px beside noise of .05 px most is predicted in frames that nothing was fitted to."""
    train, test = halves(photographed(0.1))
    found = diagnose(train, lens(), held_out=test)
    part = next(c for c in found.components if c.name == REPEATED_COMPONENT)
    noise = next(c for c in found.components if c.name == 'noise')
    assert part.p_value < 1e-12
    assert part.sd_px == pytest.approx(0.1, rel=0.3)
    assert noise.sd_px == pytest.approx(NOISE, rel=0.3)
    assert found.noise_px == pytest.approx(NOISE, rel=0.3)
    assert found.evaluation.scatter_px == pytest.approx(np.hypot(part.sd_px, noise.sd_px))
    assert found.figures.extended.heldout_rms_px < 0.75 * found.figures.base.heldout_rms_px
    assert found.verdict == 'unexplained'
    assert Action.VARY_VIEWS in {advice.action for advice in found.advice}


def test_frames_in_turn_gain_by_it_too():
    found = diagnose(photographed(0.1), lens())
    assert found.figures.extended.heldout_rms_px < 0.75 * found.figures.base.heldout_rms_px


def test_clean_data_have_nothing_of_it():
    """White residuals without any fit: the likelihood ratio raises no more alarms than it says."""
    linear = linearized(photographed())
    rng = np.random.default_rng(1)
    for _ in range(30):
        white = linear.row_mask * rng.normal(size=linear.row_mask.shape)
        assert similar_views(linear, white) is None
    assert all(c.name != REPEATED_COMPONENT for c in diagnose(photographed(), lens()).components)


def test_data_without_noise_have_nothing_of_it():
    linear = linearized(photographed())
    assert similar_views(linear, np.zeros_like(linear.residual)) is None


def test_each_view_is_predicted_from_the_others_of_its_landmark():
    """What `own` says of a frame is what the other frames say of it, and so by `at`."""
    linear = linearized(photographed(0.1))
    process = similar_views(linear, linear.residual)
    left = 7
    known = process.known
    view = known.row // linear.data.views.used.shape[1]
    view = np.where(known.mask, view, -1)
    kernel = np.exp(
        -((known.seen[:, :, None] - known.seen[:, None]) ** 2).sum(axis=-1)
        / (2 * process.reach**2)
        - np.abs(known.t[:, :, None] - known.t[:, None]) / process.lasting
    )
    rows = linear.residual.reshape(*linear.data.views.used.shape, 2)
    for landmark in (0, 11, 40):
        mine = view[landmark] == left
        others = known.mask[landmark] & ~mine
        covariance = process.variance * kernel[landmark] + np.eye(len(mine))
        told = rows[view[landmark][others], int(known.key[landmark, 1])]
        expected = (
            process.variance
            * kernel[landmark][np.ix_(mine, others)]
            @ np.linalg.solve(covariance[np.ix_(others, others)], told)
        )
        np.testing.assert_allclose(
            process.cross_predictions[left, int(known.key[landmark, 1])],
            expected[0],
            rtol=1e-6,
            atol=1e-9,
        )


def test_what_was_fitted_is_predicted_at_the_same_views():
    linear = linearized(photographed(0.3))
    process = similar_views(linear, linear.residual)
    rows = linear.residual.reshape(*linear.data.views.used.shape, 2)
    assert np.std(rows - process.predict(linear)) < 0.4 * np.std(rows)


def test_views_of_unknown_time_are_like_none():
    table = photographed(0.1)
    linear = linearized(table)
    process = similar_views(linear, linear.residual)
    assert np.isfinite(process.lasting)
    timeless = linearized(replace(table, t=np.full(len(table), np.nan)))
    assert not process.predict(timeless).any()
    assert similar_views(timeless, timeless.residual).lasting == np.inf


def test_a_table_that_does_not_state_sigma_is_predicted_by_one_that_does():
    """In px: the scale of sigma is no part of what comes again."""
    table = photographed(0.1)
    stated = replace(table, sigma=np.full(len(table), NOISE))
    linear, plain = linearized(stated), linearized(table)
    process = similar_views(linear, linear.residual)
    np.testing.assert_allclose(process.predict(plain), process.predict(linear), atol=1e-6)
    np.testing.assert_allclose(
        process.predict(plain),
        similar_views(plain, plain.residual).predict(plain),
        rtol=0.02,
        atol=2e-3,
    )


def test_landmarks_that_were_never_seen_are_left_alone():
    table = photographed(0.1)
    linear = linearized(table)
    process = similar_views(linear, linear.residual)
    other = linearized(replace(table, landmark=table.landmark + 1000))
    assert not process.predict(other).any()
