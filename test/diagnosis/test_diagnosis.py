"""Criticism: the algebra of its tests, their rates, and what it says of small scenes."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.scenes import lens, observe, scene
from scipy import stats

from fisheye_svp_ros.diagnosis.correlation import Correlation
from fisheye_svp_ros.diagnosis.diagnosis import diagnose
from fisheye_svp_ros.diagnosis.held_out import held_out_gain
from fisheye_svp_ros.diagnosis.model import (
    Linearised,
    dense_frames,
    fit,
    flat_rows,
    intrinsic_names,
    prepare,
    start,
)
from fisheye_svp_ros.diagnosis.noise import quantisation_step
from fisheye_svp_ros.diagnosis.projection import Nuisance, score
from fisheye_svp_ros.diagnosis.screening import screen, single_landmarks, single_steps
from fisheye_svp_ros.diagnosis.standard_errors import standard_errors
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.effects.landmark_survey import LandmarkSurveyEffect

SIGMA = 0.2
INDEPENDENT = Correlation(0.0, 1.0, lambda _: 1.0)


def fitted(seed, terms=(), cameras=1, free=(), simulated=None):
    rng = np.random.default_rng(seed)
    pose, views = scene(rng, cameras)
    observations = observe(simulated or lens(), terms, pose, views, SIGMA, rng)
    data = prepare(observations)
    state = fit(data, start(data, lens()), free)
    return data, state, Linearised(data, state, free)


@pytest.mark.parametrize('cameras', [1, 2])
def test_linearised_columns_are_derivatives_of_the_residual(cameras):
    free = intrinsic_names(lens())
    data, state, linear = fitted(3, cameras=cameras, free=free)
    step = 1e-6
    for i in range(6):
        change = np.zeros((data.frames, 6))
        change[:, i] = step
        up, down = (
            Linearised(data, replace(state, pose=state.pose.retract(s * change)), free).residual
            for s in (1, -1)
        )
        np.testing.assert_allclose(
            linear.frame_columns[..., i], -(up - down) / (2 * step), rtol=1e-5, atol=1e-2
        )
    for i in range(6 * (cameras - 1)):
        change = np.zeros((cameras, 6))
        change[1, i] = step
        up, down = (
            Linearised(data, replace(state, rig=state.rig.retract(s * change)), free).residual
            for s in (1, -1)
        )
        np.testing.assert_allclose(
            linear.shared_columns[..., i], -(up - down) / (2 * step), rtol=1e-5, atol=1e-2
        )


def dense(linear):
    rows = linear.rows.used.ravel()
    poses = flat_rows(dense_frames(linear.frame_columns))[rows]
    return rows, np.concatenate([poses, flat_rows(linear.shared_columns)[rows]], axis=1)


def test_score_is_the_f_test_of_nested_models():
    free = intrinsic_names(lens())
    _, _, linear = fitted(5, free=free)
    columns = linear.effect_columns(CATALOGUE['decentering']())
    found = score(Nuisance(linear), columns)
    rows, design = dense(linear)
    y = linear.residual.ravel()[rows]
    wider = np.concatenate([design, flat_rows(columns)[rows]], axis=1)
    small, large = (
        float(((y - m @ np.linalg.lstsq(m, y, rcond=None)[0]) ** 2).sum()) for m in (design, wider)
    )
    left = len(y) - np.linalg.matrix_rank(wider)
    assert found.rank == 2
    assert found.statistic == pytest.approx(small - large, rel=1e-6)
    f = (small - large) / 2 / (large / left)
    assert found.p_value == pytest.approx(float(stats.f.sf(f, 2, left)), rel=1e-6)


def test_single_landmarks_are_scored_like_any_effect():
    _, _, linear = fitted(6, free=intrinsic_names(lens()))
    nuisance = Nuisance(linear)
    for effect, quick, _ in single_landmarks(linear, nuisance)[::9]:
        slow = score(nuisance, linear.effect_columns(effect))
        assert quick.statistic == pytest.approx(slow.statistic, rel=1e-6)
        np.testing.assert_allclose(quick.estimate, slow.estimate, rtol=1e-5)


def test_single_steps_are_scored_like_any_effect():
    _, _, linear = fitted(8, free=intrinsic_names(lens()))
    nuisance = Nuisance(linear)
    steps = CATALOGUE['session_step'].candidates(linear.scene)
    for effect, quick, count in single_steps(linear, nuisance, steps):
        slow = score(nuisance, linear.effect_columns(effect))
        assert quick.statistic == pytest.approx(slow.statistic, rel=1e-6)
        assert (quick.rank, count) == (slow.rank, len(steps))
        np.testing.assert_allclose(quick.estimate, slow.estimate, rtol=1e-5)


def test_all_landmarks_together_are_scored_like_nested_fits():
    _, _, linear = fitted(9)
    nuisance = Nuisance(linear)
    survey = LandmarkSurveyEffect.candidates(linear.scene)[0]
    freed = Nuisance(linear, survey=survey)
    found = next(c for c in screen(linear, nuisance, INDEPENDENT, ['landmark_survey']).candidates
                 if c.effect == survey)
    assert found.score.statistic == pytest.approx(nuisance.misfit - freed.misfit, rel=1e-6)
    assert found.score.rank == freed.rank - nuisance.rank


def test_free_landmarks_are_projected_out_like_any_columns():
    _, _, linear = fitted(7)
    survey = LandmarkSurveyEffect.candidates(linear.scene)[0]
    freed = Nuisance(linear, survey=survey)
    rows, design = dense(linear)
    wider = np.concatenate([design, flat_rows(linear.effect_columns(survey))[rows]], axis=1)
    y = linear.residual.ravel()[rows]
    left = y - wider @ np.linalg.lstsq(wider, y, rcond=1e-10)[0]
    assert freed.misfit == pytest.approx(float((left**2).sum()), rel=1e-6)
    assert freed.rank == np.linalg.matrix_rank(wider, tol=1e-8 * np.linalg.norm(wider, 2))


def test_p_values_are_uniform_without_an_effect():
    p_values = []
    for seed in range(25):
        _, _, linear = fitted(100 + seed)
        nuisance = Nuisance(linear)
        for name in ('viewpoint_shift', 'decentering', 'skew', 'rolling_shutter', 'target_shape'):
            effect = CATALOGUE[name].candidates(linear.scene)[0]
            p_values.append(score(nuisance, linear.effect_columns(effect)).p_value)
    # 125 values; a sound build fails this less than once in ten thousand runs.
    assert stats.kstest(p_values, 'uniform').pvalue > 1e-4


def test_clean_data_is_adequate():
    rng = np.random.default_rng(11)
    pose, views = scene(rng)
    found = diagnose(observe(lens(), (), pose, views, SIGMA, rng), lens())
    assert found.verdict == 'adequate'
    assert not found.causes and not found.remaining
    assert found.noise_px == pytest.approx(SIGMA, rel=0.1)


@pytest.mark.parametrize(
    ('name', 'values'),
    [
        ('viewpoint_shift', [0.02]),
        ('target_shape', [0.004, 0.0, -0.003] * 3),
        ('rolling_shutter', [0.03]),
        ('skew', [0.002]),
    ],
)
def test_hidden_effect_is_named_and_measured(name, values):
    rng = np.random.default_rng(12)
    pose, views = scene(rng)
    model_scene = fitted(12)[2].scene
    effect = CATALOGUE[name].candidates(model_scene)[0]
    observations = observe(lens(), [(effect, np.array(values))], pose, views, SIGMA, rng)
    found = diagnose(observations, lens())
    assert found.verdict == 'explained'
    assert [cause.effect for cause in found.causes] == [name]
    assert found.causes[0].gain > 0.9
    assert found.extended.rms_px == pytest.approx(SIGMA * np.sqrt(2), rel=0.1)
    for parameter, true in zip(found.causes[0].parameters.values(), values, strict=True):
        assert abs(parameter['value'] - true) < 5 * parameter['stderr']


def test_true_poses_reveal_what_free_poses_hide():
    rng = np.random.default_rng(13)
    pose, views = scene(rng)
    scale = CATALOGUE['landmark_scale'](1, (0.0, 0.0, 0.0))
    observations = observe(lens(), [(scale, np.array([0.004]))], pose, views, SIGMA, rng)
    poses = {int(frame): pose.take(int(frame)) for frame in np.unique(views.frame)}
    found = diagnose(observations, lens(), poses=poses)
    named = {cause.effect: cause.indistinguishable_from for cause in found.causes}
    assert any('landmark_scale' in (name, *same) for name, same in named.items())


def test_swapped_ids_are_found_and_left_out():
    rng = np.random.default_rng(14)
    pose, views = scene(rng)
    table = observe(lens(), (), pose, views, SIGMA, rng)
    uv = table.uv.copy()
    for frame in (2, 5, 9):
        rows = np.flatnonzero(table.frame == frame)[:2]
        uv[rows] = uv[rows[::-1]]
    found = diagnose(replace(table, uv=uv), lens())
    assert [cause.effect for cause in found.causes] == ['wrong_ids']
    value = found.causes[0].parameters['fraction']['value']
    assert value == pytest.approx(6 / len(table))
    assert found.extended.rms_px == pytest.approx(SIGMA * np.sqrt(2), rel=0.1)


def test_landmarks_far_from_their_place_are_no_gross_errors():
    rng = np.random.default_rng(20)
    pose, views = scene(rng)
    moves = np.array([0.15, 0.1, 0.0, 0.1, -0.15, 0.0])
    table = observe(
        lens(), [(LandmarkSurveyEffect((3, 44)), moves)], pose, views, SIGMA, rng
    )
    uv = table.uv.copy()
    uv[[5, 200, 700, 900]] += [15.0, -12.0]
    found = diagnose(replace(table, uv=uv), lens())
    assert [cause.effect for cause in found.causes] == ['landmark_survey']
    values = found.causes[0].parameters
    assert list(values) == ['3.x', '3.y', '3.z', '44.x', '44.y', '44.z']
    for parameter, true in zip(values.values(), moves, strict=True):
        assert abs(parameter['value'] - true) < 5 * parameter['stderr']
    assert [s.variable for s in found.remaining] == ['outliers']


def test_standard_errors_of_free_landmarks_are_those_of_the_dense_matrix():
    data, state, _ = fitted(21)
    often = LandmarkSurveyEffect(tuple(range(60)), everywhere=True)
    term = (often, np.zeros(180))
    linear = Linearised(data, replace(state, terms=(term,)), ())
    nuisance = Nuisance(linear)
    (errors,) = standard_errors(linear, nuisance, INDEPENDENT)
    rows, others = dense(linear)
    place = flat_rows(linear.effect_columns(often))[rows]
    outside = place - others @ np.linalg.lstsq(others, place, rcond=None)[0]
    covariance = np.linalg.pinv(outside.T @ outside, rcond=1e-9, hermitian=True)
    variance = nuisance.misfit / nuisance.freedom
    np.testing.assert_allclose(errors, np.sqrt(variance * np.diag(covariance)), rtol=1e-5)


def test_what_has_no_effect_has_no_standard_error():
    data, state, _ = fitted(22)
    nothing = (LandmarkSurveyEffect((4, 999)), np.zeros(6))
    linear = Linearised(data, replace(state, terms=(nothing,)), ())
    (errors,) = standard_errors(linear, Nuisance(linear), INDEPENDENT)
    assert np.isfinite(errors[:3]).all() and np.isnan(errors[3:]).all()


def test_a_range_band_objects_to_an_effect_that_holds_in_the_others_only():
    rng = np.random.default_rng(23)
    pose, views = scene(rng)
    near = np.linalg.norm(pose.into_body(views.points), axis=-1) < 0.8
    table = observe(lens(), (), pose, views, SIGMA, rng)
    skewed = observe(lens(), [(CATALOGUE['skew'](), np.array([0.004]))], pose, views, SIGMA, rng)
    here = near[table.frame, table.landmark][:, None]
    mixed = np.where(here, skewed.uv, 2 * table.uv - skewed.uv)
    for uv, holds in ((skewed.uv, True), (mixed, False)):
        data = prepare(replace(table, uv=uv))
        state = fit(data, start(data, lens()), ())
        linear = Linearised(data, state, ())
        gains = held_out_gain(data, linear, Nuisance(linear), (), CATALOGUE['skew']())
        assert (gains['range_bands'] > 0) == holds, gains


def test_quantisation_is_read_off_the_numbers():
    rng = np.random.default_rng(15)
    uv = rng.uniform(0, 1000, (500, 2))
    assert quantisation_step(np.round(uv)) == 1.0
    assert quantisation_step(np.round(uv * 4) / 4) == 0.25
    assert quantisation_step(uv) == 0.0


def test_noise_that_grows_with_the_angle_is_a_cause():
    rng = np.random.default_rng(16)
    pose, views = scene(rng)
    clean = observe(lens(), (), pose, views, 0.0, rng)
    theta = np.arctan2(np.hypot(*(clean.uv - 767.5).T), 380.0)
    noisy = clean.uv + rng.normal(size=clean.uv.shape) * SIGMA * np.exp(0.8 * theta**2)[:, None]
    found = diagnose(replace(clean, uv=noisy), lens())
    assert [cause.effect for cause in found.causes] == ['noise_vs_angle']


def test_what_no_effect_explains_stays_unexplained():
    rng = np.random.default_rng(17)
    pose, views = scene(rng)
    table = observe(lens(), (), pose, views, SIGMA, rng)
    azimuth = np.arctan2(table.uv[:, 1] - 767.5, table.uv[:, 0] - 767.5)
    ripple = 0.3 * np.stack([np.cos(5 * azimuth), np.sin(7 * azimuth)], axis=-1)
    found = diagnose(replace(table, uv=table.uv + ripple), lens())
    assert found.verdict in ('unexplained', 'partly_explained')
    assert 'image' in [s.variable for s in found.remaining]
