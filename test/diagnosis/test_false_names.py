"""What must not be named after an effect that it resembles."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.scenes import lens, observe, scene
from scipy import stats

from fisheye_svp_ros.diagnosis import EffectTests, NullModel, diagnose
from fisheye_svp_ros.diagnosis.effect_tests import HeldOutGain, sum_gains
from fisheye_svp_ros.diagnosis.fitted_model import refit
from fisheye_svp_ros.diagnosis.stepwise import bulk_p_values
from fisheye_svp_ros.effects.base import ModelTerm, Scene
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.pose import Pose, identity, rotation_from_vector
from fisheye_svp_ros.scene.observations import views_of
from fisheye_svp_ros.solve.bundle_adjustment import adjust
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.rig_state import Linearization, group_by_frame, with_effect
from fisheye_svp_ros.study.trust import known_errors

SIGMA = 0.2


def test_intrinsics_that_are_wrong_throughout_are_no_step_after_the_first_frames():
    rng = np.random.default_rng(40)
    pose, views = scene(rng)
    true = lens().with_parameters(
        ('fx', 'fy', 'cx'), [1.002 * lens().fx, 1.002 * lens().fy, lens().cx + 0.6]
    )
    found = diagnose(observe(true, (), pose, views, SIGMA, rng), lens(), free_intrinsics=False)
    assert {cause.effect for cause in found.causes} == {'focal_length', 'principal_point'}


def test_landmarks_that_scatter_more_are_no_noise_that_grows_with_the_angle():
    rng = np.random.default_rng(51)
    pose, views = scene(rng)
    clean = observe(lens(), (), pose, views, 0.0, rng)
    sigma = np.where(clean.board == 0, 3 * SIGMA, SIGMA)[:, None]
    found = diagnose(replace(clean, uv=clean.uv + rng.normal(size=clean.uv.shape) * sigma), lens())
    assert [cause.effect for cause in found.causes] == []
    assert 'scatter_vs_theta' in [s.variable for s in found.remaining]


def test_ripples_that_grow_outward_are_no_noise():
    """A static error of the lens that no image field is fine enough for."""
    rng = np.random.default_rng(1)
    table = observe(lens(), (), *scene(rng, frames=30), SIGMA, rng)
    arm = (table.uv - [lens().cx, lens().cy]) / 700
    ripple = arm * np.sin(100 * np.linalg.norm(arm, axis=1, keepdims=True))
    found = diagnose(replace(table, uv=table.uv + 3 * SIGMA * ripple), lens())
    assert 'noise_vs_angle' not in {cause.effect for cause in found.causes}


def warped(warp, size, seed):
    """Return a set whose image points (M, 2) a warp moves by `size` noise levels, rms."""
    rng = np.random.default_rng(seed)
    table = observe(lens(), (), *scene(rng, frames=30), SIGMA, rng)
    moves = warp(table, table.uv - [lens().cx, lens().cy])
    return replace(table, uv=table.uv + size * SIGMA * moves / np.sqrt(np.mean(moves**2)))


def test_large_ripples_along_the_radius_are_no_noise():
    """Noise scatters across the radius, too."""

    def fine(table, arm):
        radius = np.linalg.norm(arm, axis=1, keepdims=True) / 500
        return arm * radius * np.sin(2 * np.pi * 16 * radius)

    found = diagnose(warped(fine, 3, 2), lens())
    assert 'noise_vs_angle' not in {cause.effect for cause in found.causes}


@pytest.mark.parametrize('seed', [0, 2])
def test_landmarks_of_two_colors_have_no_name(seed):
    """The lens magnifies one color more: its points err by more where the image is higher."""

    def two_colors(table, arm):
        return (table.landmark % 2 - 0.5)[:, None] * arm

    found = diagnose(warped(two_colors, 1, seed), lens())
    assert not found.causes
    assert 'landmark' in [s.variable for s in found.remaining]


@pytest.mark.parametrize(('radius', 'size'), [(0.07, 2), (0.12, 4)])
def test_large_dots_of_large_boards_are_no_boards_out_of_place(radius, size):
    rng = np.random.default_rng(0)
    pose, views = scene(rng)
    pose = Pose(pose.rotation, size * pose.position)
    views = views._replace(points=size * views.points)
    dots = CATALOGUE['dot_centroid']()
    table = observe(lens(), [ModelTerm(dots, np.array([radius**2]))], pose, views, SIGMA / 2, rng)
    found = diagnose(table, lens())
    assert [cause.effect for cause in found.causes] == ['dot_centroid']
    area = found.causes[0].parameters['radius_squared']
    assert abs(area['value'] - radius**2) < 3 * area['stderr']


def test_no_dot_reaches_its_neighbors():
    points = 0.02 * np.stack(np.meshgrid(np.arange(5), np.arange(4), [0]), -1).reshape(-1, 3)
    seen = Scene(views_of(points, np.zeros((1, 20, 2))), lens(), identity(1), np.zeros(0))
    dots = CATALOGUE['dot_centroid']()
    assert not dots.is_implausible(np.array([0.019**2]), seen)
    assert dots.is_implausible(np.array([0.021**2]), seen)


@pytest.mark.parametrize('seed', [3, 8, 10])
def test_a_smooth_image_field_is_not_named_after_the_effect_that_it_resembles(seed):
    rng = np.random.default_rng(seed)
    pose, views = scene(rng)
    table = observe(lens(), (), pose, views, SIGMA, rng)
    centers, widths = rng.uniform(0, 1536, (12, 2)), rng.uniform(150, 600, 12)
    heights = SIGMA / 2 * rng.normal(size=(12, 2))
    squares = ((table.uv[:, None] - centers) ** 2).sum(axis=-1)
    field = np.exp(-squares / 2 / widths**2) @ heights
    found = diagnose(replace(table, uv=table.uv + field), lens())
    assert [cause.effect for cause in found.causes] == []


@pytest.mark.parametrize('seed', [1, 2, 7])
def test_an_image_that_swings_is_no_step(seed):
    rng = np.random.default_rng(seed)
    pose, views = scene(rng, cameras=2)
    table = observe(lens(), (), pose, views, SIGMA, rng)
    swing = np.sin(rng.uniform(3, 8) * table.t + rng.uniform(0, 6))[:, None] * rng.normal(size=2)
    found = diagnose(
        replace(table, uv=table.uv + 10 * SIGMA * swing), lens(), free_intrinsics=False
    )
    assert [cause.effect for cause in found.causes] == []
    assert 'frame' in [s.variable for s in found.remaining]


@pytest.mark.parametrize('seed', [0, 3])
def test_a_focal_length_that_drifts_is_no_step_where_no_time_is_known(seed):
    rng = np.random.default_rng(seed)
    pose, views = scene(rng)
    table = observe(lens(), (), pose, views, SIGMA, rng)
    growth = 5e-3 * (2 * table.t[:, None] / table.t.max() - 1)
    table = replace(
        table,
        uv=table.uv + growth * (table.uv - [lens().cx, lens().cy]),
        t=np.full(len(table), np.nan),
    )
    found = diagnose(table, lens(), free_intrinsics=False)
    assert {cause.effect for cause in found.causes} == {'focal_drift'}


def test_gross_errors_that_hit_another_landmark_by_chance_are_no_wrong_ids():
    """Far points on a target whose landmarks are a few standard deviations apart."""
    rng = np.random.default_rng(17)
    pose, views = scene(rng)
    table = observe(lens(), (), pose, views, 5 * SIGMA, rng)
    rows = rng.random(len(table)) < 0.05
    thrown = rng.normal(size=(rows.sum(), 2)) * 50
    uv = table.uv.copy()
    uv[rows] += thrown
    found = diagnose(replace(table, uv=uv), lens())
    assert len(found.gross) > 40
    assert 'wrong_ids' not in {cause.effect for cause in found.causes}


@pytest.mark.parametrize('alone', [(), (1, 5, 9, 13)])
def test_a_rig_that_bends_anew_in_every_frame_is_no_image_that_moves(alone):
    """Each frame that both cameras saw has a turn beside their mean, with an honest error."""
    rng = np.random.default_rng(12)
    pose, views = scene(rng, cameras=2)
    angles = 1e-3 * rng.normal(size=(len(views.frame), 3)) * (views.camera > 0)[:, None]
    bent = pose.compose(Pose(rotation_from_vector(angles), np.zeros_like(angles)))
    table = observe(lens(), (), bent, views, SIGMA, rng)
    found = diagnose(table.take(~(np.isin(table.frame, alone) & (table.camera == 1))), lens())
    assert [cause.effect for cause in found.causes] == ['rig_flex']
    both = np.setdiff1d(np.arange(24), alone)
    parameters = found.causes[0].parameters
    assert [*parameters] == [f'{axis}_f{frame}' for frame in both for axis in 'xyz']
    value, error = (
        np.array([entry[key] for entry in parameters.values()]).reshape(-1, 3)
        for key in ('value', 'stderr')
    )
    turns = angles[views.camera > 0][both]
    off = (value - turns + turns.mean(axis=0)) / error
    assert 0.7 < np.sqrt((off**2).mean()) < 1.3
    # Where the rig stood in a frame that was left out is not known.
    fits = found.evaluation.simulation, found.evaluation.fixed_model
    assert 'depth_error_m' not in known_errors(*fits, ())


def test_one_frame_that_gains_most_is_no_reason_for_doubt_nor_for_trust():
    near = np.array([-0.4, -0.1, 11.4, 0.4, 2.2, 13.9, 0.6, 2.5, 330.4, 79.8, -0.6, 18.1])
    assert sum_gains(near).convincing
    alone = np.array([330.4, -0.4, 0.1, 0.4, -1.2, 0.9, -0.6, 0.5])
    assert not sum_gains(alone).convincing
    assert sum_gains(alone).value == pytest.approx(0.6)


def test_a_refit_beside_a_lens_that_is_far_off_leads_nowhere_worse():
    rng = np.random.default_rng(41)
    pose, views = scene(rng, frames=8)
    true = lens().with_parameters(('fx', 'fy'), [1.33 * lens().fx, 1.33 * lens().fy])
    data = group_by_frame(observe(true, (), pose, views, SIGMA, rng))
    state = adjust(data, initial_state(data, lens()), ())
    variances = NullModel.estimate(data, state, ()).variances
    shifted = with_effect(state, CATALOGUE['viewpoint_shift'](), np.array([0.03]))

    def misfit(state):
        return np.sqrt((Linearization(data, state, ()).residual ** 2).mean())

    # Without a limit it was five times as large; boards that bend need steps that raise it, too.
    assert misfit(refit(data, shifted, (), variances)) < 2 * misfit(shifted)


@pytest.mark.parametrize(('gain', 'named'), [(1.2, ['decentering']), (0.8, [])])
def test_what_was_taken_in_stays_for_as_long_as_it_gains_more_than_its_error(
    monkeypatch, gain, named
):
    """As for a stretched board, which held-out frames hardly miss beside offsets of landmarks."""
    rng = np.random.default_rng(61)
    pose, views = scene(rng)
    terms = [ModelTerm(CATALOGUE['decentering'](), np.array([2e-3, -1e-3]))]
    table = observe(lens(), terms, pose, views, SIGMA, rng)
    whole = EffectTests.held_out_gain

    def held_out_gain(tests, included, columns, effect):
        if np.isin(columns, tests.null.included_columns).all():  # it has been taken in
            return HeldOutGain(gain, 1.0)
        return whole(tests, included, columns, effect)

    monkeypatch.setattr(EffectTests, 'held_out_gain', held_out_gain)
    assert [cause.effect for cause in diagnose(table, lens()).causes] == named


def test_the_largest_of_landmarks_with_long_tails_is_no_single_one():
    rank, spots = np.full(60, 3), (np.arange(60) + 0.5) / 60
    normal, long = stats.f.ppf(spots, 3, 1e6) * 3, stats.f.ppf(spots, 3, 5) * 3
    assert normal.max() < long.max()
    far = bulk_p_values(np.append(normal[:-1], long.max()), rank, np.array([59]))[59]
    assert far < 1e-4
    assert bulk_p_values(long, rank, np.array([59]))[59] > 1e-3
    # One that is far beyond any tail is a single one beside either.
    assert bulk_p_values(np.append(long[:-1], 2000.0), rank, np.array([59]))[59] < 1e-5


@pytest.mark.parametrize('size', [0.7, 1.0, 30.0])
def test_no_tails_are_read_into_landmarks_that_are_off_by_noise_or_alike(size):
    rank, far = np.full(60, 3), 45.0 * max(size, 1.0)
    ordinary = size * stats.chi2.ppf((np.arange(60) + 0.5) / 60, 3)
    p = bulk_p_values(np.append(ordinary[:-1], far), rank, np.array([59]))
    assert p[59] == pytest.approx(stats.chi2.sf(45.0, 3), rel=1.0)


def test_landmarks_far_beyond_all_others_belong_to_no_tail():
    """They make others seem off, and so their tails long."""
    rank = np.full(60, 3)
    long = stats.f.ppf((np.arange(60) + 0.5) / 60, 3, 5) * 3
    both = np.append(long[:-2], [20.0 * long.max(), 2.0 * long.max()])
    p = bulk_p_values(both, rank, np.array([58, 59]))
    assert p[58] < 1e-100 < 1e-6 < p[59]
    everything = bulk_p_values(np.full(60, 30.0), rank, np.arange(60))
    assert everything == pytest.approx(stats.chi2.sf(30.0, 3))
