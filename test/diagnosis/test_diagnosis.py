"""Diagnosis: what it says of small scenes."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import scenes
from helpers.scenes import lens, observe

from fisheye_svp_ros.diagnosis import Action, DiagnosisOptions, diagnose
from fisheye_svp_ros.diagnosis.problem import Inputs, Problem
from fisheye_svp_ros.diagnosis.selection import select_causes
from fisheye_svp_ros.diagnosis.uncertainty import standard_errors
from fisheye_svp_ros.effects.base import ModelTerm
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.effects.extension import extend_lens
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.effects.target_effects import LandmarkSurveyEffect
from fisheye_svp_ros.errors import ObservationError, ParameterError
from fisheye_svp_ros.optics.curves import Gennery
from fisheye_svp_ros.optics.lens import intrinsic_names
from fisheye_svp_ros.reporting.diagnosis_document import diagnosis_document
from fisheye_svp_ros.scene.observations import Observations, views_of
from fisheye_svp_ros.scene.table_checks import quantization_step, thin_out
from fisheye_svp_ros.solve.bundle_adjustment import adjust
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.outliers import FRAME, VIEW, find_outliers
from fisheye_svp_ros.solve.rig_state import Linearization, group_by_frame

SIGMA = 0.2


def scene(rng, cameras=1, frames=16):
    """Return views and poses of few frames, by which the cost of a diagnosis goes."""
    return scenes.scene(rng, cameras, frames)


def fitted(seed, terms=(), cameras=1, free=(), simulated=None):
    rng = np.random.default_rng(seed)
    pose, views = scene(rng, cameras)
    observations = observe(simulated or lens(), terms, pose, views, SIGMA, rng)
    data = group_by_frame(observations)
    state = adjust(data, initial_state(data, lens()), free)
    return data, state, Linearization(data, state, free)


@pytest.mark.parametrize('cameras', [1, 2])
def test_linearized_columns_are_derivatives_of_the_residual(cameras):
    free = intrinsic_names(lens())
    data, state, linear = fitted(3, cameras=cameras, free=free)
    step = 1e-6
    for i in range(6):
        change = np.zeros((data.frames, 6))
        change[:, i] = step
        up, down = (
            Linearization(data, replace(state, pose=state.pose.retract(s * change)), free).residual
            for s in (1, -1)
        )
        np.testing.assert_allclose(
            linear.frame_columns[..., i], -(up - down) / (2 * step), rtol=1e-5, atol=1e-2
        )
    for i in range(6 * (cameras - 1)):
        change = np.zeros((cameras, 6))
        change[1, i] = step
        up, down = (
            Linearization(data, replace(state, rig=state.rig.retract(s * change)), free).residual
            for s in (1, -1)
        )
        np.testing.assert_allclose(
            linear.shared_columns[..., i], -(up - down) / (2 * step), rtol=1e-5, atol=1e-2
        )


def test_clean_data_is_adequate():
    rng = np.random.default_rng(11)
    pose, views = scene(rng)
    found = diagnose(observe(lens(), (), pose, views, SIGMA, rng), lens())
    assert found.verdict == 'adequate'
    assert not found.causes and not found.remaining
    assert found.noise_px == pytest.approx(SIGMA, rel=0.1)


@pytest.mark.parametrize('terms', [(), (ModelTerm(CATALOGUE['skew'](), np.array([0.002])),)])
def test_rounding_is_no_cause(terms):
    """Points simulated without noise are exact but for what their numbers round to."""
    rng = np.random.default_rng(11)
    pose, views = scene(rng, frames=12)
    found = diagnose(observe(lens(), terms, pose, views, 0.0, rng), lens())
    assert [cause.effect for cause in found.causes] == ['skew'][: len(terms)]
    assert not found.remaining and found.noise_px < 2e-6


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
    observations = observe(lens(), [ModelTerm(effect, np.array(values))], pose, views, SIGMA, rng)
    found = diagnose(observations, lens())
    assert found.verdict == 'explained'
    assert [cause.effect for cause in found.causes] == [name]
    assert found.causes[0].gain > 0.85
    assert found.figures.extended.rms_px == pytest.approx(SIGMA * np.sqrt(2), rel=0.1)
    for parameter, true in zip(found.causes[0].parameters.values(), values, strict=True):
        assert abs(parameter['value'] - true) < 5 * parameter['stderr']


@pytest.mark.parametrize('axes', [(0, 1, 2), (1, 2, 0)])
def test_a_flat_board_is_stretched_in_whatever_plane_it_lies(axes):
    """Along and across it, and along its diagonals; on a wall z may be one of its directions."""
    rng = np.random.default_rng(14)
    pose, views = scene(rng)
    views = views._replace(points=views.points * [1, 1, 0], board=np.zeros_like(views.board))
    truth = views.points + views.points[..., [1, 0, 2]] * [0.002, 0.002, 0]
    seen = observe(lens(), (), pose, views._replace(points=truth), SIGMA, rng)
    said = views.points[0][seen.landmark][:, axes]
    found = diagnose(replace(seen, xyz=said), lens())
    (cause,) = found.causes
    assert (found.verdict, cause.effect) == ('explained', 'landmark_scale')
    stretch, shear = cause.parameters['x_over_y'], cause.parameters['xy_shear']
    assert shear['value'] == pytest.approx(0.004, abs=4 * shear['stderr'])
    assert abs(stretch['value']) < 4 * stretch['stderr'] < 0.0012


def test_a_finely_warped_board_of_many_landmarks_has_a_name():
    rng = np.random.default_rng(15)
    pose, views = scene(rng, frames=12)
    x, y = (np.ravel(one) for one in np.meshgrid(np.linspace(-1, 1, 13), np.linspace(-1, 1, 10)))
    said = np.column_stack([0.5 * x, 0.4 * y, 0 * x])
    truth = said + 0.001 * np.outer(np.cos(6 * np.arccos(x)), [0, 0, 1])
    views = views_of(truth, np.zeros((12, len(x), 2)))._replace(frame=views.frame)
    seen = observe(lens(), (), pose, views, SIGMA, rng)
    found = diagnose(replace(seen, xyz=said[seen.landmark]), lens())
    assert (found.verdict, *(cause.effect for cause in found.causes)) == (
        'explained',
        'target_shape',
    )
    assert found.figures.base.heldout_rms_px > 1.15 * found.figures.named.heldout_rms_px
    assert found.figures.named.heldout_rms_px == pytest.approx(SIGMA * np.sqrt(2), rel=0.05)


def test_true_poses_reveal_what_free_poses_hide():
    rng = np.random.default_rng(13)
    pose, views = scene(rng)
    scale = CATALOGUE['landmark_scale'].candidates(fitted(13)[2].scene)[0]
    observations = observe(lens(), [ModelTerm(scale, np.array([0.004]))], pose, views, SIGMA, rng)
    assert diagnose(observations, lens()).verdict == 'adequate'
    poses = {int(frame): pose.take(int(frame)) for frame in np.unique(views.frame)}
    (cause,) = diagnose(observations, lens(), poses=poses).causes
    assert cause.effect == 'landmark_scale'
    found = cause.parameters['relative']
    assert abs(found['value'] - 0.004) < 3 * found['stderr'] < 0.0004


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
    assert found.figures.extended.rms_px == pytest.approx(SIGMA * np.sqrt(2), rel=0.1)


@pytest.mark.parametrize('seed', [0, 1])
def test_a_single_landmark_keeps_its_name_beside_landmarks_that_are_all_a_little_off(seed):
    rng = np.random.default_rng(seed)
    pose, views = scene(rng)
    moves = 2e-4 * rng.normal(size=(60, 3))
    moves[7] = [3e-3, -3e-3, 3e-3]
    all_of_them = LandmarkSurveyEffect(tuple(range(60)))
    table = observe(lens(), [ModelTerm(all_of_them, moves.ravel())], pose, views, SIGMA, rng)
    found = diagnose(table, lens())
    assert [cause.effect for cause in found.causes] == ['landmark_survey']
    values = found.causes[0].parameters
    assert list(values) == ['7.x', '7.y', '7.z']
    for parameter, true in zip(values.values(), moves[7], strict=True):
        assert abs(parameter['value'] - true) < 4 * parameter['stderr']


@pytest.mark.parametrize('seed', [0, 1])
def test_four_landmarks_far_off_are_single_ones_and_no_scatter_of_all(seed):
    """Once "Keep the target": they were taken for the tail of a scatter of 0.2 mm."""
    rng = np.random.default_rng(seed)
    pose, views = scene(rng)
    moved = {7: [4e-3, 0, 0], 21: [0, -4e-3, 1e-3], 38: [3e-3, 3e-3, 0], 51: [0, 3e-3, -3e-3]}
    effect, moves = LandmarkSurveyEffect((*moved,)), np.concatenate([*moved.values()])
    table = observe(lens(), [ModelTerm(effect, moves)], pose, views, SIGMA, rng)
    (cause,) = diagnose(table, lens()).causes
    assert cause.effect == 'landmark_survey'
    assert {int(name.partition('.')[0]) for name in cause.parameters} == {*moved}


def test_landmarks_far_from_their_place_are_no_gross_errors():
    rng = np.random.default_rng(20)
    pose, views = scene(rng)
    moves = np.array([0.15, 0.1, 0.0, 0.1, -0.15, 0.0])
    table = observe(
        lens(), [ModelTerm(LandmarkSurveyEffect((3, 44)), moves)], pose, views, SIGMA, rng
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


def test_near_points_that_a_cause_explains_are_no_gross_errors():
    rng = np.random.default_rng(0)
    pose, views = scene(rng)
    pose.position[7] = views.points[7, 0] - [0.05, 0.0, 0.08]
    pose.rotation[7] = np.eye(3)
    hidden = replace(lens(), viewpoint_shift=Gennery(0.0, 0.004))
    table = observe(hidden, (), pose, views, SIGMA / 2, rng)
    wrong = np.flatnonzero(table.frame == 11)[3]
    table.uv[wrong] += [9.0, -5.0]
    data = group_by_frame(table)
    near = find_outliers(data, initial_state(data, lens()))[1]
    assert {7, 11} == set(table.frame[near.rows].tolist())
    found = diagnose(table, lens())
    assert [cause.effect for cause in found.causes] == ['viewpoint_shift']
    (error,) = found.causes[0].parameters.values()
    assert abs(error['value'] - 0.004) < 3 * error['stderr'] < 0.0004
    left = [(g['frame'], g['landmark']) for g in found.gross]
    assert left == [(11, int(table.landmark[wrong]))]
    assert found.evaluation.fixed_model.data.views.used.sum() == len(table) - 1


def test_points_that_say_themselves_how_unsure_they_are_are_no_gross_errors():
    rng = np.random.default_rng(22)
    pose, views = scene(rng, frames=24)
    clean = observe(lens(), (), pose, views, 0.0, rng)
    sigma = np.full(len(clean), SIGMA)
    sigma[::40] = 6 * SIGMA
    uv = clean.uv + sigma[:, None] * rng.normal(size=clean.uv.shape)
    uv[40] = clean.uv[40] + 10 * SIGMA
    table = replace(clean, uv=uv, sigma=sigma)
    data = group_by_frame(table)
    assert not len(find_outliers(data, initial_state(data, lens()))[1].rows)
    data = group_by_frame(replace(table, sigma=np.full(len(clean), SIGMA)))
    gross = find_outliers(data, initial_state(data, lens()))[1]
    assert 40 in gross.rows.tolist()
    assert gross.px[gross.rows == 40] == pytest.approx(10 * SIGMA * np.sqrt(2), rel=0.3)


@pytest.mark.parametrize(('bad', 'named'), [([7], True), ([1, 4, 7, 11, 15, 19, 22], False)])
def test_a_view_is_off_as_a_whole_where_most_are_not(bad, named):
    rng = np.random.default_rng(17)
    pose, views = scene(rng)
    clean = observe(lens(), (), pose, views, SIGMA, rng)
    off = 30 * rng.normal(size=clean.uv.shape) * np.isin(clean.frame, bad)[:, None]
    data = group_by_frame(replace(clean, uv=clean.uv + off))
    gross = find_outliers(data, initial_state(data, lens()))[1]
    assert (VIEW in gross.why) == named
    frames = {
        int(clean.frame[row])
        for row, why in zip(gross.rows, gross.why, strict=True)
        if why == VIEW
    }
    assert frames == (set(bad) if named else set())


def test_one_camera_of_three_that_the_others_contradict_is_to_blame():
    rng = np.random.default_rng(3)
    pose, views = scene(rng, 3, 12)
    table = replace(observe(lens(), (), pose, views, SIGMA, rng), cameras=('a', 'b', 'c'))
    bad = np.flatnonzero((table.frame == 5) & (table.camera == 2))
    table.uv[bad] = table.uv[bad[::-1]]
    data = group_by_frame(table)
    gross = find_outliers(data, initial_state(data, lens()))[1]
    assert set(gross.why) == {FRAME} and sorted(gross.rows.tolist()) == bad.tolist()


def test_quantisation_is_read_off_the_numbers():
    rng = np.random.default_rng(15)
    uv = rng.uniform(0, 1000, (500, 2))
    assert quantization_step(np.round(uv)) == 1.0
    assert quantization_step(np.round(uv * 4) / 4) == 0.25
    assert quantization_step(uv) == 0.0
    pose, views = scene(rng)
    table = observe(lens(), (), pose, views, SIGMA, rng)
    rough = observe(lens(), (), pose, views, 0.1, rng)
    found = diagnose(replace(rough, uv=np.round(rough.uv)), lens())
    assert found.verdict == 'explained'  # that they depend on the place within a pixel, too
    (cause,) = diagnose(replace(table, uv=np.round(table.uv)), lens()).causes
    assert cause.effect == 'quantisation' and cause.parameters['step']['value'] == 1.0
    assert cause.parameters['step']['stderr'] == 0.0


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


def test_a_fine_ripple_of_the_image_has_its_place():
    rng = np.random.default_rng(18)
    pose, views = scene(rng, frames=40)
    table = observe(lens(), (), pose, views, SIGMA, rng)
    turns = 2 * np.pi * table.uv / 153.6
    ripple = 0.6 * np.stack([np.sin(turns[:, 1]), np.cos(turns[:, 0])], axis=-1)
    found = diagnose(replace(table, uv=table.uv + ripple), lens())
    assert found.verdict == 'unexplained'
    assert [s.variable for s in found.remaining] == ['image']
    lens_share = sum(part.share for part in found.components if part.stage == 'lens')
    assert lens_share > 0.7


def test_what_the_user_knows_is_taken_in_or_left_out():
    rng = np.random.default_rng(19)
    pose, views = scene(rng)
    table = observe(
        lens(), [ModelTerm(CATALOGUE['skew'](), np.array([0.002]))], pose, views, SIGMA, rng
    )
    known = diagnose(table, lens(), options=DiagnosisOptions(included=('aspect',), quick=True))
    assert {cause.effect for cause in known.causes} == {'aspect', 'skew'}
    without = diagnose(table, lens(), options=DiagnosisOptions(left_out=('skew',), quick=True))
    assert 'skew' not in {cause.effect for cause in without.causes}
    assert without.verdict != 'adequate'
    with pytest.raises(ParameterError, match='choose from'):
        DiagnosisOptions(left_out=('skwe',))
    with pytest.raises(ParameterError, match='without a test'):
        DiagnosisOptions(included=('wrong_ids',))


def table_of(seed, frames=12, cameras=1, terms=()):
    rng = np.random.default_rng(seed)
    pose, views = scene(rng, cameras, frames)
    return observe(lens(), terms, pose, views, SIGMA, rng)


def test_what_the_user_knows_is_a_cause_that_the_simulation_lacked():
    terms = [ModelTerm(CATALOGUE['skew'](), np.array([0.002]))]
    table, held_out = table_of(27, terms=terms), table_of(28, terms=terms)
    found, known = (
        diagnose(table, lens(), held_out=held_out, options=DiagnosisOptions(names, quick=True))
        for names in ((), ('skew',))
    )
    assert [cause.effect for cause in (*found.causes, *known.causes)] == ['skew', 'skew']
    assert known.figures.base.rms_px == pytest.approx(found.figures.base.rms_px)
    assert known.figures.base.heldout_rms_px == pytest.approx(found.figures.base.heldout_rms_px)
    assert known.causes[0].gain == pytest.approx(found.causes[0].gain, rel=1e-3)
    assert known.causes[0].gain > 0.5


def test_boards_are_known_by_the_landmarks_where_a_table_does_not_tell_of_them():
    model, seen = ForwardModel(lens(), ()), scene(np.random.default_rng(30))
    shape = CATALOGUE['target_shape'].candidates(model.scene(*seen, model.linearize(*seen)))[0]
    values = np.resize([0.004, -0.003, 0.005, 0.006], len(shape.parameters))
    table, other = (
        observe(lens(), [ModelTerm(shape, values)], *seen, SIGMA, np.random.default_rng(seed))
        for seed in (1, 2)
    )
    bare = replace(other, board=np.zeros_like(other.board))
    extended = extend_lens(lens(), [ModelTerm(shape, values)], table)
    assert diagnose(bare, extended, options=DiagnosisOptions(quick=True)).verdict == 'adequate'
    found = diagnose(table, lens(), held_out=bare, options=DiagnosisOptions(quick=True))
    assert [cause.effect for cause in found.causes] == ['target_shape']
    assert found.figures.named.heldout_rms_px == pytest.approx(SIGMA * np.sqrt(2), rel=0.1)


@pytest.mark.parametrize('cameras', [('left', 'right'), ('right', 'left')])
def test_true_poses_of_a_rig_are_those_of_its_right_camera(cameras):
    rng = np.random.default_rng(31)
    pose, views = scene(rng, 2, 12)
    table = replace(observe(lens(), (), pose, views, SIGMA, rng), cameras=cameras)
    right = np.flatnonzero(views.camera == cameras.index('right'))
    poses = {int(views.frame[i]): pose.take(i) for i in right}
    found = diagnose(table, lens(), poses=poses, options=DiagnosisOptions(quick=True))
    assert found.verdict == 'adequate'
    assert found.figures.base.rms_px == pytest.approx(SIGMA * np.sqrt(2), rel=0.05)


@pytest.mark.parametrize(
    ('cameras', 'names', 'x'),
    [
        (('left', 'right'), ('left', 'right'), -0.15),
        (('right', 'left'), ('left', 'right'), 0.15),
        (('cam0', 'cam1'), ('cam0', 'cam1'), -0.15),
    ],
)
def test_a_rig_is_the_first_camera_in_the_second(cameras, names, x):
    table = replace(table_of(29, cameras=2), cameras=cameras)
    found = diagnose(table, lens(), options=DiagnosisOptions(quick=True))
    assert found.rig is not None and found.rig[0] == names
    np.testing.assert_allclose(found.rig[1].position, [x, 0, 0], atol=2e-3)
    alone = replace(table, frame=2 * table.frame + table.camera)
    assert diagnose(alone, lens(), options=DiagnosisOptions(quick=True)).rig is None


def test_what_the_lens_already_holds_is_no_cause_again():
    effect, values = CATALOGUE['decentering'](), np.array([0.002, -0.001])
    table = table_of(21, 24, terms=[ModelTerm(effect, values)])
    known = replace(lens(), corrections={'decentering': effect.to_dict(values)})
    found = diagnose(table, known)
    assert found.verdict == 'adequate' and not found.causes
    corrections = found.lens.corrections['decentering']['parameters']
    assert corrections['p1'] == pytest.approx(0.002, abs=2e-4)


def test_what_happened_to_a_recording_is_no_part_of_the_lens():
    step = CATALOGUE['session_step']((12.0,), False)
    table = table_of(22, 24, terms=[ModelTerm(step, np.array([0.002, 1.0, 0.0]))])
    found = diagnose(table, lens(), held_out=table_of(23, 8))
    assert [cause.effect for cause in found.causes] == ['session_step']
    assert not found.lens.corrections
    # The frames of a table of its own are not those that the step is between.
    assert found.figures.named.heldout_rms_px == pytest.approx(SIGMA * np.sqrt(2), rel=0.1)


def test_a_lens_that_is_fitted_is_that_of_the_mean_session():
    step, first = CATALOGUE['session_step']((12.0,), False), lens()
    table = table_of(22, 24, terms=[ModelTerm(step, np.array([0.004, 1.0, -2.0]))])
    found = diagnose(table, first, free_intrinsics=True)
    assert [cause.effect for cause in found.causes] == ['session_step']
    cx, cy, fx = (found.evaluation.intrinsics[name] for name in ('cx', 'cy', 'fx'))
    assert abs(cx.after - first.cx - 0.5) < 3 * cx.after_stderr
    assert abs(cy.after - first.cy + 1.0) < 3 * cy.after_stderr
    assert abs(fx.after / first.fx - 1.002) < 3 * fx.after_stderr / first.fx


@pytest.mark.parametrize(
    'kept',
    [
        lambda t: t.frame < 1,
        lambda t: t.frame < 2,
        lambda t: ~((t.camera == 0) & np.isin(t.frame, [0, 3, 11])),
        lambda t: ~((t.camera == 1) & (t.frame > 1)),
        lambda t: (t.camera == 1) == (t.frame > 5),
        lambda t: (t.landmark % 9 == 0) | (t.frame > 6),
    ],
    ids=['one frame', 'two frames', 'first blind', 'second seldom', 'never both', 'few points'],
)
def test_rigs_and_frames_that_see_little(kept):
    table = table_of(24, 12, 2)
    found = diagnose(table.take(kept(table)), lens(), free_intrinsics=True)
    assert not found.causes
    assert np.isfinite(found.figures.extended.rms_px)
    diagnosis_document(found)


def test_the_last_fit_is_the_best_under_the_last_variances():
    rng = np.random.default_rng(25)
    pose, views = scene(rng, frames=24)
    moves = rng.normal(size=views.points[0].shape) * 1e-3
    terms = [
        ModelTerm(
            CATALOGUE['viewpoint_shift'].candidates(fitted(25)[2].scene)[0], np.array([0.02])
        )
    ]
    table = observe(lens(), terms, pose, views._replace(points=views.points + moves), SIGMA, rng)
    table = replace(table, xyz=views.points[0][table.landmark])
    inputs = Inputs.check(table, lens(), DiagnosisOptions())
    found = select_causes(Problem.prepare(inputs), lambda *_: None)
    own, information = found.null.included_columns, found.null.information
    step = np.linalg.solve(information[np.ix_(own, own)], information[own, -1])
    errors = standard_errors(found.null) * found.null.scale[own]
    assert [cause.name for cause in found.causes] == ['viewpoint_shift']
    assert np.abs(step / errors).max() < 0.1


@pytest.mark.parametrize('spread', [1.0, 3.0])
def test_frames_that_scatter_more_than_their_noise_widen_the_standard_error(spread):
    """One parameter, of which each frame gives an estimate of unit variance: their mean."""

    def information(values):
        return np.array([[len(values), values.sum()], [values.sum(), (values**2).sum()]])

    values = spread * np.random.default_rng(27).normal(size=40)
    null = SimpleNamespace(
        column_count=1,
        included_columns=np.arange(1),
        terms=[],
        scale=np.array([2.0]),
        information=information(values),
        information_without_poses=lambda at: [
            information(np.delete(values, i)) for i in range(40)
        ],
        linear=SimpleNamespace(data=SimpleNamespace(frames=40)),
    )
    expected = 1 if spread == 1 else values.std(ddof=1)
    assert standard_errors(null) == pytest.approx(expected / np.sqrt(40) / 2)
    assert standard_errors(null, jackknife=False) == pytest.approx(1 / np.sqrt(40) / 2)


def test_what_one_frame_alone_tells_is_as_sure_as_that_frame():
    """The mean of frames, and an offset of the last one, which is open without it."""
    rows = np.column_stack([np.ones(40), np.arange(40) == 39, np.zeros(40)])
    rows[:, 2] = np.random.default_rng(28).normal(size=40) + 100 * rows[:, 1]
    without = [np.delete(rows, i, axis=0) for i in range(40)]
    null = SimpleNamespace(
        column_count=2,
        included_columns=np.arange(2),
        terms=[],
        scale=np.ones(2),
        information=rows.T @ rows,
        information_without_poses=lambda at: [w.T @ w for w in without],
        linear=SimpleNamespace(data=SimpleNamespace(frames=40)),
    )
    assert standard_errors(null) == pytest.approx([39**-0.5, (1 + 1 / 39) ** 0.5])


def rig_table(seed, right_terms=(), frames=16):
    """Return what two cameras with lenses of their own see, and the lenses."""
    lenses = {'left': lens(), 'right': replace(lens(), fx=395.0, fy=395.0, cx=775.0, name='right')}
    seen = []
    for camera, (one, terms) in enumerate(zip(lenses.values(), ((), right_terms), strict=True)):
        rng = np.random.default_rng(seed)
        pose, views = scene(rng, 2, frames)
        table = observe(one, terms, pose, views, SIGMA, rng)
        seen.append(table.take(table.camera == camera))
    both = {
        name: np.concatenate([getattr(part, name) for part in seen])
        for name in ('frame', 'landmark', 'board', 'camera', 'uv', 'xyz', 't', 'sigma')
    }
    return replace(seen[0], cameras=('left', 'right'), **both), lenses


def test_each_camera_of_a_rig_has_causes_of_its_own():
    skew = CATALOGUE['skew']()
    table, lenses = rig_table(26, [ModelTerm(skew, np.array([0.002]))], 10)
    found = diagnose(table, lenses, free_intrinsics=True)
    models = [found.evaluation.fixed_model.state.model.camera(camera) for camera in (0, 1)]
    assert [model.lens.name for model in models] == ['fish214', 'right']
    assert [cause.effect for cause in found.causes] == ['skew']
    assert list(found.causes[0].parameters) == ['right.shear']
    assert found.causes[0].parameters['right.shear']['value'] == pytest.approx(0.002, abs=5e-4)
    assert not found.lenses['left'].corrections
    assert set(found.lenses['right'].corrections) == {'skew'}
    assert found.lenses['right'].fx == pytest.approx(395.0, abs=1.0)
    assert {'left.fx', 'right.fx'} <= set(found.evaluation.intrinsics)
    again = diagnose(table, found.lenses)
    assert again.verdict == 'adequate' and not again.causes


def test_a_frame_of_a_rig_from_another_moment_is_named():
    table, lenses = rig_table(27)
    uv = table.uv.copy()
    place = {
        key: i
        for i, key in enumerate(
            zip(table.frame.tolist(), table.camera.tolist(), table.landmark.tolist(), strict=True)
        )
    }
    moved = [
        (i, place[9, 1, n])
        for (f, c, n), i in place.items()
        if (f, c) == (4, 1) and (9, 1, n) in place
    ]
    here, there = np.array(moved).T
    uv[here] = table.uv[there]
    wrong = (table.frame == 4) & (table.camera == 1)
    kept = ~wrong | np.isin(np.arange(len(table)), here)
    found = diagnose(replace(table, uv=uv).take(kept), lenses)
    assert not found.causes
    assert {row['frame'] for row in found.gross} == {4}
    assert [one.frames for one in found.advice if one.action is Action.CHECK_FRAMES] == [[4]]


def test_a_rig_needs_a_lens_for_each_camera():
    table, lenses = rig_table(28, frames=4)
    with pytest.raises(ObservationError, match='right'):
        diagnose(table, {'left': lenses['left']})
    with pytest.raises(ObservationError, match='not those of the rig'):
        diagnose(table, lenses, held_out=replace(table, cameras=('a', 'b')))


def test_a_quick_diagnosis_takes_a_part_of_many_points() -> None:
    """Small views stay whole, or nothing could be said of their frames."""
    frame = np.repeat([0, 1, 2], [2400, 2100, 30])
    landmark = np.concatenate([np.arange(2400), np.arange(2100), np.arange(30)])
    none = np.full(len(frame), np.nan)
    table = Observations(
        frame,
        landmark,
        np.zeros((len(frame), 2)),
        np.zeros((len(frame), 3)),
        np.zeros_like(frame),
        np.zeros_like(frame),
        none,
        none,
    )
    kept = thin_out(table)
    assert np.bincount(kept.frame).tolist() == [800, 700, 30]
    assert set(kept.landmark[kept.frame == 1]) == set(range(0, 2100, 3))
    assert len(thin_out(kept)) == len(kept)
