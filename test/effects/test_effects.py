"""Every effect: its columns, its YAML, its physics where an exact answer is at hand."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.scenes import lens, scene

from fisheye_svp_ros.effects.base import ModelTerm, Scene, Untestable
from fisheye_svp_ros.effects.catalogue import CATALOGUE, load_effects
from fisheye_svp_ros.effects.extension import extend_lens
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.effects.ray_effects import PupilDecenteringEffect
from fisheye_svp_ros.effects.rig_effect import rig_kind
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.lens_files import load_lens, save_lens
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.optics.curves import FlatPort
from fisheye_svp_ros.optics.ports import DomeGlass
from fisheye_svp_ros.pose import Pose, identity, rotation_from_vector
from fisheye_svp_ros.scene.observations import views_of

DESIGN_NAMES = {
    'viewpoint_shift',
    'radial_profile',
    'focal_length',
    'principal_point',
    'aspect',
    'skew',
    'decentering',
    'sensor_tilt',
    'pupil_decentering',
    'flat_port',
    'focal_drift',
    'session_step',
    'landmark_survey',
    'landmark_scale',
    'target_shape',
    'board_pose',
    'dot_centroid',
    'detector_bias',
    'rolling_shutter',
    'stereo_time_offset',
    'rig_flex',
    'wrong_ids',
    'quantisation',
    'noise_vs_angle',
}


@pytest.fixture(scope='module', params=['fish214', 'fish180'])
def linearized(request):
    """Return a model, its views from two cameras, and the scene that effects look at."""
    rng = np.random.default_rng(4)
    pose, views = scene(rng, cameras=2, frames=8)
    model = ForwardModel(lens(request.param), ())
    linear = model.linearize(pose, views)
    return model, pose, views, linear, model.scene(pose, views, linear)


def forms(name, scene_):
    try:
        several = CATALOGUE[name].candidates(scene_)
    except Untestable as why:
        pytest.skip(str(why))
    return [several[0], several[-1]]


def test_catalogue_holds_the_names_of_the_design():
    assert set(CATALOGUE) >= DESIGN_NAMES  # files and commands have them


@pytest.mark.parametrize('name', sorted(CATALOGUE))
def test_words_say_what_to_look_for_and_what_to_do(name):
    kind = CATALOGUE[name]
    assert kind.signature and kind.to_separate


@pytest.mark.parametrize('name', sorted(CATALOGUE))
def test_columns_are_the_derivatives_of_the_prediction(name, linearized):
    model, pose, views, linear, scene_ = linearized
    for effect in forms(name, scene_):
        if effect.stage == 'noise':
            continue
        columns = model.effect_columns(effect, scene_, linear)
        for i, parameter in list(enumerate(effect.parameters))[:7]:
            step = np.zeros(len(effect.parameters))
            step[i] = 1e-6 * parameter.large
            up, down = (
                ForwardModel(model.lens, [ModelTerm(effect, sign * step)])
                .predict(pose, views, False)
                .uv
                for sign in (1, -1)
            )
            expected = (up - down) / (2 * step[i])
            assert np.nanmax(np.abs(columns[..., i])) > 0
            np.testing.assert_allclose(
                columns[..., i], expected, atol=2e-5 * np.nanmax(np.abs(expected))
            )


@pytest.mark.parametrize('name', sorted(CATALOGUE))
def test_lens_file_keeps_effects(name, linearized, tmp_path):
    model, pose, views, _, scene_ = linearized
    rng = np.random.default_rng(1)
    for effect in forms(name, scene_):
        values = rng.normal(size=len(effect.parameters)) * 1e-4
        extended = extend_lens(model.lens, [ModelTerm(effect, values)])
        save_lens(extended, tmp_path / 'lens.yaml')
        assert load_lens(tmp_path / 'lens.yaml') == extended
        np.testing.assert_allclose(
            ForwardModel(extended).predict(pose, views, False).uv,
            ForwardModel(model.lens, [ModelTerm(effect, values)]).predict(pose, views, False).uv,
            rtol=0,
            atol=1e-9,
        )


@pytest.mark.parametrize('normal', [0, 1, 2])
def test_a_flat_target_is_stretched_within_its_plane(normal, linearized, tmp_path):
    model, _, views, _, scene_ = linearized
    views = views._replace(points=np.where(np.arange(3) == normal, 0.3, views.points))
    whole, plane = CATALOGUE['landmark_scale'].candidates(replace(scene_, views=views))
    moved = plane.displacement(replace(scene_, views=views), np.array([0.01, 0.004]))
    arm = views.points[0] - np.array(plane.centre)
    stretch = np.linalg.lstsq(arm, moved[0], rcond=None)[0]
    assert np.abs(stretch[normal]).max() < 1e-12 and np.abs(moved[..., normal]).max() < 1e-12
    np.testing.assert_allclose(
        np.linalg.eigvalsh(stretch), np.hypot(0.005, 0.002) * np.array([-1, 0, 1]), atol=1e-12
    )
    assert whole.key == 'landmark_scale(axes=1)' and plane.key == 'landmark_scale(axes=2)'
    extended = extend_lens(model.lens, [ModelTerm(plane, np.array([0.01, 0.004]))])
    save_lens(extended, tmp_path / 'lens.yaml')
    assert load_lens(tmp_path / 'lens.yaml') == extended


def test_a_stretch_of_an_older_lens_file_is_read():
    entry = {'axes': 2, 'centre': [0.0, 0.0, 0.0], 'parameters': {'x_over_y': 0.01}}
    (term,) = load_effects({'landmark_scale': entry}, 'lens.yaml')
    effect, values = term.effect, term.values
    assert effect.axes == 2 and not effect.plane and values.tolist() == [0.01]


@pytest.mark.parametrize('name', sorted(CATALOGUE))
def test_no_views_are_no_trouble(name, linearized):
    model, pose, views, _, scene_ = linearized
    for effect in forms(name, scene_):
        extended = ForwardModel(
            model.lens, [ModelTerm(effect, np.full(len(effect.parameters), 1e-5))]
        )
        none = np.zeros(0, dtype=int)
        assert extended.predict(pose.take(none), views.take(none)).uv.shape == (0, 60, 2)


def test_unknown_and_incomplete_effects_are_refused():
    with pytest.raises(LensError, match="effect 'bent' is unknown"):
        load_effects({'bent': {}}, 'lens.yaml')
    with pytest.raises(LensError, match=r'lens\.yaml: effect skew is incomplete'):
        load_effects({'skew': {'parameters': {}}}, 'lens.yaml')
    with pytest.raises(LensError, match='skew has bend, which does not belong'):
        load_effects({'skew': {'parameters': {'shear': 0.1, 'bend': 1.0}}}, 'lens.yaml')
    with pytest.raises(LensError, match=r'skew has shear, .* in a mapping, parameters'):
        load_effects({'skew': {'shear': 0.1, 'bend': 1.0}}, 'lens.yaml')


def test_flat_port_is_snells_law():
    thickness, index = 0.01, 1.5
    theta = np.linspace(0.05, 1.4, 20)
    inside = np.arcsin(np.sin(theta) / index)
    # A ray through a pane leaves displaced sideways; along the axis that is:
    exact = thickness * (1 - np.tan(inside) / np.tan(theta))
    shift, slope = FlatPort(thickness, index).value_and_slope(theta, np.tan(theta / 2))
    np.testing.assert_allclose(shift, exact, rtol=1e-12)
    np.testing.assert_allclose(slope[1:-1], np.gradient(exact, theta)[1:-1], rtol=0.01)


def test_dot_centroid_is_the_centroid_of_the_dots_image():
    rng = np.random.default_rng(7)
    pose, views = scene(rng, frames=3)
    model = ForwardModel(lens(), ())
    linear = model.linearize(pose, views)
    scene_ = model.scene(pose, views, linear)
    effect = CATALOGUE['dot_centroid'].candidates(scene_)[0]
    radius = 0.008
    bias = model.effect_columns(effect, scene_, linear)[..., 0] * radius**2
    board = scene_.boards[0]
    # Area by a fine grid of the disc, each piece weighted with the area of its image.
    ring, turn = np.meshgrid((np.arange(60) + 0.5) / 60, 2 * np.pi * np.arange(120) / 120)
    at = radius * np.stack([ring * np.cos(turn), ring * np.sin(turn)], axis=-1).reshape(-1, 2)
    for view, point in ((0, 3), (1, 11), (2, 17)):
        disc = views.points[view, point] + at @ board.axes[:2]
        inside = (disc - pose.position[view]) @ pose.rotation[view]
        uv = project(model.lens, inside).uv
        along = [
            project(model.lens, inside + 1e-7 * axis @ pose.rotation[view]).uv - uv
            for axis in board.axes[:2]
        ]
        area = np.abs(along[0][:, 0] * along[1][:, 1] - along[0][:, 1] * along[1][:, 0])
        weight = area * ring.ravel()
        exact = (weight[:, None] * uv).sum(0) / weight.sum() - linear.uv[view, point]
        np.testing.assert_allclose(bias[view, point], exact, atol=0.03 * np.linalg.norm(exact))


def test_back_projection_undoes_image_effects():
    pose, views = scene(np.random.default_rng(2), frames=4)
    terms = [
        ModelTerm(CATALOGUE['decentering'](), np.array([0.002, -0.003])),
        ModelTerm(CATALOGUE['focal_length'](), np.array([0.01])),
        ModelTerm(CATALOGUE['viewpoint_shift'](1), np.array([0.01])),
    ]
    model = ForwardModel(lens(), terms)
    image = model.predict(pose, views)
    rays = model.back_project(image.uv)
    arm = pose.into_body(views.points) - rays.origin
    off = np.linalg.norm(np.cross(arm, rays.direction), axis=-1)
    assert image.valid.mean() > 0.9
    assert np.nanmax(off) < 1e-6


def test_a_profile_that_turns_back_past_its_data_is_used_up_to_there():
    effect = CATALOGUE['radial_profile'](4, 1.54)
    model = ForwardModel(lens(), (ModelTerm(effect, np.array([-1.3, -2.3, 1.4, -0.3]) * 2),))
    curve = model.lens.image_height
    assert np.radians(100) < curve.limit < np.radians(140)
    theta = np.linspace(0.0, curve.limit, 200)[:-1]
    np.testing.assert_allclose(curve.angle(curve.value_and_slope(theta)[0]), theta, atol=1e-9)
    assert model.lens.max_incidence <= curve.limit


def test_a_drift_leaves_the_mean_focal_length_to_the_lens(linearized):
    *_, scene_ = linearized
    late = scene_.views.frame > 2
    paused = scene_.views._replace(t=scene_.views.t + 50.0 * late[:, None])
    scene_ = replace(scene_, views=paused)
    for effect in CATALOGUE['focal_drift'].candidates(scene_):
        growth = effect.plane_columns(scene_) / scene_.normalized_uv()[..., None]
        assert np.abs(growth).max() > 0.5
        np.testing.assert_allclose(np.nanmean(growth, axis=(0, 1, 2)), 0.0, atol=1e-12)


def test_a_drift_needs_no_times_where_frames_are_in_order(linearized):
    *_, scene_ = linearized
    frame = scene_.views.frame.astype(float)
    bare, even = (
        replace(scene_, views=scene_.views._replace(t=np.broadcast_to(t, scene_.views.t.shape)))
        for t in (np.nan, frame[:, None])
    )
    forms = [CATALOGUE['focal_drift'].candidates(one) for one in (bare, even)]
    for untimed, timed in zip(*forms, strict=True):
        np.testing.assert_allclose(untimed.plane_columns(bare), timed.plane_columns(even))
        assert not untimed.holds_for(frame[:1], frame)


@pytest.mark.parametrize(('step', 'holds'), [(0.1, True), (0.2, True), (0.4, False)])
def test_frames_taken_more_slowly_do_not_refute_motion(step, holds):
    """A rolling shutter of 60 standard errors was not confirmed by every fourth frame."""
    known = np.repeat(0.1 * np.arange(30), 20)
    others = np.repeat(0.05 + step * np.arange(8), 20)
    assert CATALOGUE['rolling_shutter']().is_refutable_by(others, known) == holds
    assert CATALOGUE['viewpoint_shift']().is_refutable_by(others, known)


def test_a_drift_stays_as_it_was_where_the_recording_ends(linearized):
    *_, scene_ = linearized
    last = np.nanargmax(scene_.times)
    later = replace(scene_, views=scene_.views._replace(t=scene_.views.t + 1000.0))
    for effect in CATALOGUE['focal_drift'].candidates(scene_):
        known, after = (
            np.nanmean(effect.plane_columns(one) / one.normalized_uv()[..., None], axis=(1, 2))
            for one in (scene_, later)
        )
        np.testing.assert_allclose(after, np.broadcast_to(known[last], after.shape))


def test_steps_are_asked_for_after_pauses_and_every_few_frames_of_a_long_recording():
    t = 0.1 * np.arange(400) + 30.0 * (np.arange(400) >= 157)
    pose, views = scene(np.random.default_rng(2), frames=400)
    views = views._replace(t=np.broadcast_to(t[:, None], views.t.shape))
    looked = Scene(views, lens(), pose, views.uv)
    starts = [form.starts[0] for form in CATALOGUE['session_step'].candidates(looked)]
    assert len(starts) < 70 and np.abs(np.array(starts) - t[157]).min() < 1e-6
    assert max(np.diff(starts)) < 31.5


def test_every_effect_says_where_it_stands_in_the_budget_and_what_it_is():
    stages = {name: kind.budget_stage() for name, kind in CATALOGUE.items()}
    assert {name for name, stage in stages.items() if stage == 'frame'} == {
        'focal_drift',
        'session_step',
        'rolling_shutter',
        'stereo_time_offset',
        'rig_flex',
        'dot_centroid',
        'detector_bias',
    }
    assert {name for name, stage in stages.items() if stage == 'target'} == {
        'landmark_survey',
        'landmark_scale',
        'target_shape',
        'board_pose',
    }
    assert {name for name, stage in stages.items() if stage == 'noise'} == {
        'wrong_ids',
        'quantisation',
        'noise_vs_angle',
    }
    for name, kind in CATALOGUE.items():
        assert rig_kind(kind).budget_stage() == stages[name]
        assert kind.summary().endswith('.') and kind.to_separate and kind.signature
    assert 'along the axis' in CATALOGUE['viewpoint_shift'].summary()


def _views_at(t):
    views = views_of(np.eye(3), np.zeros((len(t), 3, 2)))
    return views._replace(t=np.broadcast_to(t[:, None], views.board.shape))


def test_no_motion_is_taken_from_a_pause():
    """Four frames, then two, then one, with seconds between: the last one's motion is unknown."""
    t = np.array([0.0, 0.1, 0.2, 0.3, 3.0, 3.1, 6.0])
    speed = np.array([0.2, -0.1, 0.3, 0.5, 0.2, -0.4])
    pose = identity(7).retract(t[:, None] * speed)
    pose.position[4:6] += 1.0
    twist = Scene(_views_at(t), lens(), pose, np.zeros((7, 3, 2))).twist
    assert twist[:6] == pytest.approx(np.tile(speed, (6, 1)), abs=1e-6)
    assert not twist[6].any()


def test_velocities_of_a_hand_are_those_of_its_path():
    """Three poses in two seconds, of swings that last four: parabolas lose a fifth."""
    swing, step = 1.65, 1e-5
    t = np.repeat(2 / 3 * np.arange(30), 2)[1:]  # but the first, every stamp comes twice

    def path(t):
        turns = np.stack([0.5 * np.sin(swing * t), 0.3 * np.cos(swing * t), 0 * t], axis=-1)
        return Pose(rotation_from_vector(turns), turns[:, [1, 2, 0]])

    expected = path(t + step).difference(path(t)) / step
    found = Scene(_views_at(t), lens(), path(t), np.zeros((len(t), 3, 2))).twist
    inner = slice(4, -4)
    error = np.sqrt(((found - expected)[inner] ** 2).mean() / (expected[inner] ** 2).mean())
    assert error < 0.02


@pytest.mark.parametrize('distance', [0.5, 1e3])
def test_a_dome_turns_rays_as_its_glass_does(distance):
    rng = np.random.default_rng(0)
    points = rng.normal([0.0, 0.0, 1.0], 1.0, (100, 3))
    points *= distance / np.linalg.norm(points, axis=1, keepdims=True)
    plain = lens('fish180')
    glass = DomeGlass(0.05, 1.0, 0.004, -0.003, 0.0, 0.004, 1.5)
    exact, air, found = (
        ForwardModel(one, terms).project(points)
        for one, terms in (
            (replace(plain, port=glass), ()),
            (plain, ()),
            (
                plain,
                [ModelTerm(CATALOGUE['dome_port'](0.05, 0.004, 1.5), np.array([0.004, -0.003]))],
            ),
        )
    )
    seen = exact.valid & found.valid
    moved = (exact.uv - air.uv)[seen]
    assert seen.sum() > 50 and np.abs(moved).max() > 0.3
    assert (found.uv - air.uv)[seen] == pytest.approx(moved, abs=0.03 * np.abs(moved).max())


def test_displaced_landmarks_are_named_unless_they_are_all():
    survey = CATALOGUE['landmark_survey']
    assert survey((7, 9)).key == 'landmark_survey(landmarks=7 9)'
    assert survey((7, 9), everywhere=True).key == 'landmark_survey(landmarks=all)'


def test_rays_of_a_pupil_that_moves_sideways_meet_the_points_that_they_are_of():
    model = ForwardModel(lens(), [ModelTerm(PupilDecenteringEffect(), np.array([2e-3, -1e-3]))])
    theta, azimuth = np.meshgrid(np.linspace(0.1, 1.6, 9), np.linspace(0, 6, 7))
    ahead = np.stack(
        [np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)], axis=-1
    )
    points = 0.2 * ahead.reshape(-1, 3)
    image = model.project(points)
    rays = model.back_project(image.uv[None]).reshape((len(points),))
    off = np.linalg.norm(np.cross(points - rays.origin, rays.direction), axis=-1)
    assert off.max() < 1e-8
    central = ForwardModel(lens(), ()).project(points).uv
    assert np.abs(image.uv - central).max() > 0.5
