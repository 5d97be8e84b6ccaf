"""Stereo calibration: exact with the true lens, Kita's errors with SVP, honest covariances."""

import numpy as np
import pytest
from helpers.differences import jacobian
from scipy.optimize import least_squares

from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import GeometryError, ObservationError
from fisheye_svp_ros.io.landmark_files import environment
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.pose import Pose, axis_angle_between
from fisheye_svp_ros.scene.observations import RADII, stereo_views, views_of
from fisheye_svp_ros.scene.rigs import STYLES, calibration_poses, rig
from fisheye_svp_ros.simulate.simulation import simulate, simulate_stereo
from fisheye_svp_ros.solve.stereo_calibration import calibrate_stereo

pytestmark = pytest.mark.usefixtures('engine')

MODELS = {name: ForwardModel(load_lens(lens_path(name))) for name in ('fish180', 'fish214')}
SVP = {name: ForwardModel(model.lens.svp()) for name, model in MODELS.items()}
# Kita, tables 3 and 4: mean residual, px, by radius; parallel, vergent, divergent.
RESIDUALS = {
    ('fish180', 2.0): (0.0430, 0.0429, 0.0430),
    ('fish180', 0.5): (0.1428, 0.1418, 0.1463),
    ('fish214', 2.0): (None, 0.5903, 0.5814),
    ('fish214', 0.5): (2.3258, 2.2687, 2.3784),
}


def observed(left, right, style='parallel', radius=0.5, spread='whole', sigma=0.0, seed=61):
    table = simulate_stereo(
        left,
        right,
        environment(spread, radius),
        rig(style),
        calibration_poses(),
        sigma,
        np.random.default_rng(seed),
    )
    return stereo_views(table)


def mean_residual(solved):
    both = np.concatenate([solved.left_residual, solved.right_residual], axis=-2)
    return np.nanmean(np.linalg.norm(both, axis=-1))


@pytest.mark.parametrize('name', MODELS)
@pytest.mark.parametrize('style', STYLES)
@pytest.mark.parametrize('radius', RADII)
def test_errors_vanish_with_the_true_lens(name, style, radius):
    model = MODELS[name]
    solved = calibrate_stereo(model, model, *observed(model, model, style, radius))
    assert solved.converged.all()
    assert np.abs(solved.rig.difference(rig(style))).max() < 1e-9
    assert np.abs(solved.pose.difference(calibration_poses())).max() < 1e-9
    assert mean_residual(solved) < 1e-9


@pytest.mark.parametrize('name', MODELS)
@pytest.mark.parametrize('style', STYLES)
@pytest.mark.parametrize('radius', RADII)
def test_svp_errors_have_the_papers_size(name, style, radius):
    views = observed(MODELS[name], MODELS[name], style, radius)
    solved = calibrate_stereo(SVP[name], SVP[name], *views)
    assert solved.converged.all()
    error_mm = np.abs(solved.rig.position[0] - rig(style).position).max() * 1e3
    angle = np.degrees(axis_angle_between(solved.rig, rig(style)))[0]
    largest_mm, largest_deg = {'fish180': (0.2, 0.05), 'fish214': (0.7, 0.6)}[name]
    assert 1e-3 < error_mm < largest_mm
    assert 1e-4 < angle < largest_deg
    published = RESIDUALS.get((name, radius), (None,) * 3)[list(STYLES).index(style)]
    if published:
        assert mean_residual(solved) == pytest.approx(published, rel=0.3)


def test_fish180_at_two_metres_has_the_papers_signs():
    for style, x_mm in (('parallel', -0.0070), ('vergent', 0.0200), ('divergent', -0.0510)):
        views = observed(MODELS['fish180'], MODELS['fish180'], style, 2.0)
        solved = calibrate_stereo(SVP['fish180'], SVP['fish180'], *views)
        error = solved.rig.position[0, 0] - rig(style).position[0]
        assert 0.5 < error * 1e3 / x_mm < 2


def test_two_different_lenses():
    left, right = MODELS['fish180'], MODELS['fish214']
    solved = calibrate_stereo(left, right, *observed(left, right, 'vergent'))
    assert np.abs(solved.rig.difference(rig('vergent'))).max() < 1e-9


def noisy_systems(model, systems, sigma, rng):
    """Views of many random rigs: 4 views of the 15 inner landmarks each."""
    true_rig = Pose(*(a[None] for a in rig('vergent'))).retract(
        rng.normal(size=(systems, 6)) * 0.02
    )
    chosen = calibration_poses().take([0, 2, 5, 7])
    right = Pose(*(np.broadcast_to(a, (systems, *a.shape)) for a in chosen))
    left = right.compose(true_rig.take(np.s_[:, None]))
    points = environment('inner', 0.5).points
    pair = []
    for pose in (left, right):
        flat = Pose(pose.rotation.reshape(-1, 3, 3), pose.position.reshape(-1, 3))
        blank = views_of(points, np.zeros((len(flat.position), len(points), 2)))
        uv = model.predict(flat, blank).uv
        uv = uv + sigma * rng.normal(size=uv.shape)
        pair.append(views_of(points, uv, np.full(uv.shape[:2], 1 / sigma)))
    return true_rig, right, pair


@pytest.mark.parametrize('name', MODELS)
def test_covariance_holds_over_noisy_solves(name):
    model = MODELS[name]
    true_rig, right, pair = noisy_systems(model, 400, 0.2, np.random.default_rng(62))
    solved = calibrate_stereo(model, model, *pair, systems=400)
    assert solved.converged.all()
    error = solved.rig.difference(true_rig)
    nees = np.einsum('si,sij,sj->s', error, np.linalg.inv(solved.rig_covariance), error)
    assert nees.mean() == pytest.approx(6.0, abs=0.5)
    error = solved.pose.difference(right)
    nees = np.einsum('svi,svij,svj->sv', error, np.linalg.inv(solved.pose_covariance), error)
    assert nees.mean() == pytest.approx(6.0, abs=0.3)
    rows = 4 * np.isfinite(np.stack([solved.left_residual, solved.right_residual])[..., 0])
    freedom = rows.sum(axis=(0, 2, 3)) / 2 - 30
    assert (solved.cost / freedom).mean() == pytest.approx(1.0, abs=0.03)


def test_systems_are_independent():
    model = MODELS['fish214']
    _, _, (left, right) = noisy_systems(model, 3, 0.5, np.random.default_rng(63))
    together = calibrate_stereo(model, model, left, right, systems=3)
    for i in range(3):
        mine = np.arange(4 * i, 4 * i + 4)
        alone = calibrate_stereo(model, model, left.take(mine), right.take(mine))
        assert np.abs(alone.rig.difference(together.rig.take([i]))).max() < 1e-10
        np.testing.assert_allclose(alone.rig_covariance[0], together.rig_covariance[i], rtol=1e-6)


def test_equals_scipy():
    model = SVP['fish180']
    left, right = observed(MODELS['fish180'], MODELS['fish180'], 'divergent', 0.5, 'inner', 0.3)
    solved = calibrate_stereo(model, model, left, right)

    def residual(change):
        pose = calibration_poses().retract(change[6:].reshape(10, 6))
        place = pose.compose(rig('divergent').retract(change[:6]))
        return np.concatenate(
            [
                ((model.predict(p, v, False).uv - v.uv) * v.weight[..., None]).ravel()
                for p, v in ((place, left), (pose, right))
            ]
        )

    found = least_squares(
        residual, np.zeros(66), jacobian(residual), method='lm', xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    expected = rig('divergent').retract(found.x[:6])
    assert np.abs(solved.rig.position[0] - expected.position).max() < 1e-10
    assert np.abs(solved.rig.rotation[0] - expected.rotation).max() < 1e-10
    assert solved.cost[0] == pytest.approx(2 * found.cost, rel=1e-12)


def test_missing_points_and_missing_views():
    rng = np.random.default_rng(64)
    model = MODELS['fish214']
    left, right = observed(model, model)
    for views in (left, right):
        views.weight[rng.uniform(size=views.weight.shape) < 0.3] = 0.0
    left.weight[3] = 0.0
    right.weight[4, 2:] = 0.0
    solved = calibrate_stereo(model, model, left, right)
    assert np.abs(solved.rig.difference(rig('parallel'))).max() < 1e-9
    assert np.abs(solved.pose.difference(calibration_poses())).max() < 1e-9


def test_a_view_gone_wrong_does_not_spoil_the_start():
    model = MODELS['fish180']
    left, right = observed(model, model, 'parallel', 2.0, sigma=0.1)
    good = calibrate_stereo(model, model, left, right)
    left.uv[0] = left.uv[0, ::-1]
    left.weight[0] *= 1e-9
    solved = calibrate_stereo(model, model, left, right)
    assert solved.converged.all()
    sigma = np.sqrt(np.diagonal(good.rig_covariance[0]))
    assert np.all(np.abs(solved.rig.difference(good.rig)[0]) < 3 * sigma)


def test_views_that_cannot_be_posed_are_named():
    model = MODELS['fish214']
    left, right = observed(model, model)
    left.weight[6, 3:] = right.weight[6, 3:] = 0.0
    with pytest.raises(GeometryError, match='frame 6 cannot be posed in either camera'):
        calibrate_stereo(model, model, left, right)
    left, right = observed(model, model)
    left.weight[:5] = right.weight[5:] = 0.0
    with pytest.raises(GeometryError, match='no view can be posed in both cameras'):
        calibrate_stereo(model, model, left, right)


def test_stereo_views_share_frames_and_slots():
    model = MODELS['fish180']
    table = simulate_stereo(
        model,
        model,
        environment('outer', 0.5),
        rig('divergent'),
        calibration_poses(),
        0.2,
        np.random.default_rng(65),
    )
    kept = np.flatnonzero(~((table.frame == 4) & (table.camera == 0)))
    left, right = stereo_views(table.take(np.random.default_rng(66).permutation(kept)))
    assert left.frame.tolist() == right.frame.tolist() == list(range(10))
    assert not left.used[4].any()
    assert right.used[4].any()
    both = left.used & right.used
    assert both.sum() > 100
    np.testing.assert_array_equal(left.landmark[both], right.landmark[both])
    np.testing.assert_array_equal(left.points[both], right.points[both])
    np.testing.assert_allclose(left.weight[left.used], 5.0)


def test_stereo_views_refuse_what_is_not_stereo():
    model = MODELS['fish180']
    mono = simulate(
        model, environment('inner', 0.5), calibration_poses(), 0.0, np.random.default_rng(0)
    )
    with pytest.raises(ObservationError, match=r'left and right .* holds one camera, without a'):
        stereo_views(mono)
    table = simulate_stereo(
        model,
        model,
        environment('inner', 0.5),
        rig('parallel'),
        calibration_poses(),
        0.0,
        np.random.default_rng(0),
    )
    with pytest.raises(ObservationError, match='it holds no observation'):
        stereo_views(table.take(np.arange(0)))
    twice = table.take(np.array([0, 1, 2, 1]))
    with pytest.raises(ObservationError, match='landmark 1 is listed twice in frame 0'):
        stereo_views(twice)
