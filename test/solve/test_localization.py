"""Self-localization: exact with the true lens, the paper's errors with SVP, honest covariances."""

import numpy as np
import pytest
from helpers import scenes
from helpers.differences import derivative, jacobian
from scipy.optimize import least_squares

from fisheye_svp_ros.effects.base import ModelTerm
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.io.landmark_files import environment
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.pose import Pose, axis_angle_between, rotation_from_vector
from fisheye_svp_ros.scene.observations import RADII, SPREADS, views_of
from fisheye_svp_ros.scene.rigs import paper_pose
from fisheye_svp_ros.solve.localization import localize, normal_equations

pytestmark = pytest.mark.usefixtures('engine')

LENSES = {name: load_lens(lens_path(name)) for name in ('fish180', 'fish214')}
# Kita, tables 1 and 2: z error in mm, residual in px; by radius for whole, inner, outer.
PUBLISHED = {
    'fish180': {
        2.0: [(-0.1148, 0.0399), (0.2372, 0.0281), (-1.5733, 0.0176)],
        0.5: [(-0.1614, 0.1642), (0.2363, 0.1131), (-1.6713, 0.0759)],
        0.2: [(-0.1631, 0.4136), (0.2369, 0.2847), (-1.6894, 0.1914)],
    },
    'fish214': {
        2.0: [(-5.4709, 0.5764), (0.2148, 0.1052), (-7.1621, 0.5007)],
        0.5: [(-5.6004, 2.3892), (0.2195, 0.4237), (-7.3370, 2.0930)],
        0.2: [(-5.8982, 6.4501), (0.2195, 1.0735), (-7.7370, 5.7515)],
    },
}
# A shift of the viewpoint is the same at every radius, and so is z: one published value is not.
CORRECTED = {('fish180', 2.0, 'whole'): -0.1614}
ALL = [(lens, radius, spread) for lens in LENSES for radius in RADII for spread in SPREADS]


def seen(lens, landmarks, true, sigma=0.0, rng=None):
    """Views of landmarks by a true lens from true poses, NaN where out of the field."""
    blank = views_of(landmarks, np.zeros((len(true.position), landmarks.shape[-2], 2)))
    uv = ForwardModel(lens).predict(true, blank).uv
    if sigma:
        uv = uv + sigma * rng.normal(size=uv.shape)
    return views_of(landmarks, uv, np.full(uv.shape[:2], 1 / sigma if sigma else 1.0))


def scattered_poses(rng, count, radius, shift=0.1, turn=0.3):
    scale = np.repeat([shift * radius, turn], 3)
    return paper_pose(count).retract(rng.normal(size=(count, 6)) * scale)


@pytest.mark.parametrize(('name', 'radius', 'spread'), ALL)
def test_errors_vanish_with_the_true_lens(name, radius, spread):
    rng = np.random.default_rng(31)
    points = environment(spread, radius).points
    true = scattered_poses(rng, 40, radius)
    true = Pose(*(np.concatenate([a, b]) for a, b in zip(paper_pose(1), true, strict=True)))
    views = seen(LENSES[name], points, true)
    enough = (views.weight > 0).sum(axis=1) >= 6
    assert enough.sum() >= 38
    solved = localize(ForwardModel(LENSES[name]), views.take(enough))
    assert solved.converged.all()
    assert np.abs(solved.pose.position - true.position[enough]).max() < 1e-9
    assert np.abs(solved.pose.difference(true.take(enough))).max() < 1e-9
    assert np.nanmax(np.abs(solved.residual)) < 1e-9


@pytest.mark.parametrize(('name', 'radius', 'spread'), ALL)
def test_svp_errors_have_the_papers_signs_and_sizes(name, radius, spread):
    lens = LENSES[name]
    solved = localize(
        ForwardModel(lens.svp()), seen(lens, environment(spread, radius).points, paper_pose(1))
    )
    z_mm, residual_px = PUBLISHED[name][radius][SPREADS.index(spread)]
    assert solved.converged.all()
    expected = CORRECTED.get((name, radius, spread), z_mm)
    assert solved.pose.position[0, 2] * 1e3 == pytest.approx(expected, rel=0.05)
    mean_residual = np.linalg.norm(solved.residual[0], axis=-1).mean()
    assert mean_residual == pytest.approx(residual_px, rel=0.08)
    assert np.abs(solved.pose.position[0, :2]).max() < 0.3e-3
    assert axis_angle_between(solved.pose, paper_pose(1))[0] < np.radians(0.15)


def test_derivatives_by_pose_and_target_equal_high_order_differences():
    rng = np.random.default_rng(32)
    points, pose = environment('whole', 0.5).points, scattered_poses(rng, 10, 0.5)
    for lens in (LENSES['fish214'], LENSES['fish214'].svp()):
        model = ForwardModel(lens)
        views = seen(lens, points, pose)
        linear = model.linearize(pose, views)
        derivatives = np.concatenate([linear.d_pose, linear.d_target], axis=-1)
        for axis, step in zip(np.eye(9), [1e-3] * 3 + [2e-3] * 3 + [1e-3] * 3, strict=True):

            def moved(size, axis=axis, model=model, views=views):
                camera = pose.retract(np.tile(size * axis[:6], (10, 1)))
                target = views._replace(points=views.points + size * axis[6:])
                return model.predict(camera, target, limited=False).uv

            expected = derivative(moved, step)
            ok = (views.weight > 0)[..., None]
            column = derivatives @ axis
            scale = np.abs(column).max(axis=-1, keepdims=True)
            off = np.where(ok, np.abs(column - expected) / scale, 0.0)
            assert off.max() < 1e-7


@pytest.mark.parametrize('name', LENSES)
@pytest.mark.parametrize(('radius', 'spread'), [(2.0, 'whole'), (0.5, 'inner'), (0.2, 'outer')])
def test_covariance_holds_over_1000_noisy_solves(name, radius, spread):
    rng = np.random.default_rng(33)
    lens, points = LENSES[name], environment(spread, radius).points
    true = scattered_poses(rng, 1000, radius, 0.05, 0.1)
    solved = localize(ForwardModel(lens), seen(lens, points, true, 0.2, rng))
    assert solved.converged.all()
    error = solved.pose.difference(true)
    nees = np.einsum('si,sij,sj->s', error, np.linalg.inv(solved.covariance), error)
    assert nees.mean() == pytest.approx(6.0, abs=0.3)
    count = 2 * np.isfinite(solved.residual[..., 0]).sum(axis=1) - 6
    assert (solved.cost / count).mean() == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize('shift', [True, False])
def test_equals_scipy(shift):
    rng = np.random.default_rng(34)
    lens = LENSES['fish214']
    # Nearer, scipy comes to rest before the pose does: it stops where the cost stands still.
    true = scattered_poses(rng, 6, 0.5)
    views = seen(lens, environment('whole', 2.0).points, true, 0.01, rng)
    model = ForwardModel(lens if shift else lens.svp())
    solved = localize(model, views)
    for i in range(6):
        view, start = views.take([i]), true.take([i])

        def residual(change, view=view, start=start):
            uv = model.predict(start.retract(change[None]), view, limited=False).uv
            return np.where(view.weight[..., None] > 0, uv - view.uv, 0.0).ravel()

        found = least_squares(
            residual,
            np.zeros(6),
            jacobian(residual),
            method='lm',
            xtol=1e-14,
            ftol=1e-14,
            gtol=1e-14,
        )
        expected = start.retract(found.x[None])
        assert np.abs(solved.pose.position[i] - expected.position[0]).max() < 1e-10
        assert np.abs(solved.pose.rotation[i] - expected.rotation[0]).max() < 1e-10


CORRECTIONS = [
    ('sensor_tilt', {}, 0.003),
    ('decentering', {}, 0.003),
    ('pupil_decentering', {}, 0.003),
    ('aspect', {}, 0.003),
    ('skew', {}, 0.003),
    ('dot_centroid', {}, 1e-3),
    ('detector_bias', {'order': 1}, -0.006),
    ('detector_bias', {'order': 2}, -0.006),
]


@pytest.mark.parametrize(('name', 'form', 'size'), CORRECTIONS)
def test_no_correction_keeps_a_pose_from_being_found(name, form, size):
    """What it does to an image point changes over the image, and within a pixel."""
    lens, rng = LENSES['fish180'].svp(), np.random.default_rng(0)
    effect = CATALOGUE[name](**form)
    values = np.full(len(effect.parameters), size)
    model = ForwardModel(lens, [ModelTerm(effect, values)])
    true = Pose(
        rotation_from_vector(rng.normal(scale=0.3, size=(20, 3))),
        rng.normal(scale=0.02, size=(20, 3)),
    )
    points = (
        np.stack(
            [
                *np.meshgrid(np.linspace(-0.5, 0.5, 7), np.linspace(-0.4, 0.4, 5)),
                np.full((5, 7), 0.6),
            ],
            axis=-1,
        )
        .reshape(1, -1, 3)
        .repeat(20, 0)
    )
    views = views_of(points)
    uv = model.predict(true, views).uv
    views = views._replace(
        uv=uv + rng.normal(scale=0.2, size=uv.shape), weight=np.full((20, 35), 5.0)
    )
    found = localize(model, views)
    assert found.converged.all()
    error = found.pose.difference(true)
    nees = np.einsum('si,sij,sj->s', error, np.linalg.inv(found.covariance), error)
    assert nees.mean() == pytest.approx(6.0, abs=2.0)


@pytest.mark.parametrize('name', ['sensor_tilt', 'decentering', 'skew', 'detector_bias'])
def test_a_solvers_derivatives_have_how_corrections_vary_over_the_image(name):
    rng = np.random.default_rng(36)
    effect = CATALOGUE[name]()
    model = ForwardModel(
        LENSES['fish180'], [ModelTerm(effect, np.full(len(effect.parameters), 0.003))]
    )
    pose = scattered_poses(rng, 10, 0.5)
    views = seen(LENSES['fish180'], environment('inner', 0.5).points, pose)
    found = model.d_pose(model.linearize(pose, views), views)
    for axis in np.eye(6):

        def moved(size, axis=axis):
            camera = pose.retract(np.tile(size * axis, (10, 1)))
            return model.predict(camera, views, limited=False).uv

        column, expected = found @ axis, derivative(moved, 1e-5)
        ok = (views.weight > 0)[..., None]
        scale = np.abs(column).max(axis=-1, keepdims=True)
        assert np.where(ok, np.abs(column - expected) / scale, 0.0).max() < 1e-6


def test_no_start_value_is_needed_from_any_pose():
    rng = np.random.default_rng(35)
    lens = LENSES['fish214']
    landmarks = rng.uniform(-2, 2, (40, 3))
    true = Pose(np.linalg.qr(rng.normal(size=(200, 3, 3)))[0], rng.uniform(-0.5, 0.5, (200, 3)))
    true.rotation[:] *= np.linalg.det(true.rotation)[:, None, None]
    views = seen(lens, landmarks, true)
    solved = localize(ForwardModel(lens), views)
    assert solved.converged.all()
    assert np.abs(solved.pose.difference(true)).max() < 1e-9


def test_planar_and_few_landmarks():
    rng = np.random.default_rng(36)
    lens = LENSES['fish180']
    flat = np.c_[rng.uniform(-1, 1, (20, 2)), np.full(20, -0.8)]
    true = scattered_poses(rng, 100, 1.0, 0.2, 0.2)
    solved = localize(ForwardModel(lens), seen(lens, flat, true))
    assert solved.converged.all()
    assert np.abs(solved.pose.difference(true)).max() < 1e-9
    four = np.array([[0.5, 0.1, -1], [-0.4, 0.5, -0.7], [0, -0.6, -1.2], [0.3, 0.4, -0.6]])
    solved = localize(ForwardModel(lens), seen(lens, four, paper_pose(1)))
    assert np.abs(solved.pose.difference(paper_pose(1))).max() < 1e-9


def test_a_start_value_is_used():
    lens = LENSES['fish180']
    views = seen(lens, environment('whole', 2.0).points, paper_pose(1))
    solved = localize(ForwardModel(lens), views, paper_pose(1))
    assert solved.iterations[0] == 1
    behind = paper_pose(1).retract(np.array([[0, 0, -30.0, 0, 0, 0]]))
    lost = localize(ForwardModel(lens), views, behind)
    assert not lost.converged[0]
    assert np.isinf(lost.cost[0])
    assert np.isnan(lost.covariance).all()


def test_weights_and_missing_points():
    rng = np.random.default_rng(37)
    lens, points = LENSES['fish214'], environment('whole', 0.5).points
    views = seen(lens, points, paper_pose(1))
    spoiled = views.uv.copy()
    spoiled[0, :10] += rng.normal(size=(10, 2)) * 50
    ignored = np.where(np.arange(33) < 10, 0.0, 1.0)[None]
    solved = localize(ForwardModel(lens), views_of(points, spoiled, ignored))
    assert np.abs(solved.pose.difference(paper_pose(1))).max() < 1e-9
    spoiled[0, :10] = np.nan
    solved = localize(ForwardModel(lens), views_of(points, spoiled))
    assert np.abs(solved.pose.difference(paper_pose(1))).max() < 1e-9
    assert np.isnan(solved.residual[0, :10]).all()
    # Twice the weight of a point is the point seen twice at half the variance.
    noisy = views.uv + rng.normal(size=views.uv.shape)
    heavy = np.where(np.arange(33) == 5, np.sqrt(2), 1.0)[None]
    once = localize(ForwardModel(lens), views_of(points, noisy, heavy))
    twice = localize(
        ForwardModel(lens),
        views_of(np.vstack([points, points[5]]), np.concatenate([noisy, noisy[:, 5:6]], axis=1)),
    )
    assert np.abs(once.pose.difference(twice.pose)).max() < 1e-10
    np.testing.assert_allclose(once.covariance, twice.covariance, rtol=1e-6, atol=1e-12)


def test_too_few_points_and_points_out_of_the_field_name_the_frame():
    lens, points = LENSES['fish180'], environment('whole', 2.0).points
    views = seen(lens, points, paper_pose(2))
    few = views._replace(frame=np.array([4, 9]), weight=views.weight.copy())
    few.weight[1, 3:] = 0.0
    with pytest.raises(GeometryError, match='frame 9 has 3 usable points in it; at least 4'):
        localize(ForwardModel(lens), few)
    outside = views._replace(frame=np.array([4, 9]), uv=views.uv.copy())
    outside.uv[0] = 5000.0
    with pytest.raises(GeometryError, match='frame 4 has 0 usable points inside the field of'):
        localize(ForwardModel(lens), outside)


@pytest.mark.parametrize(
    'points',
    [
        np.array([0.1, 0.2, -1]) + np.linspace(-1, 1, 9)[:, None] * [1, 0.3, 0.2],
        np.tile([0.1, 0.2, -1.0], (6, 1)),
    ],
    ids=['on one line', 'all the same'],
)
def test_points_that_do_not_fix_a_pose_are_reported(points):
    lens = LENSES['fish214']
    sound = environment('whole', 1.0).points[: len(points)]
    views = seen(lens, np.stack([points, sound]), paper_pose(2))
    solved = localize(ForwardModel(lens), views)
    assert solved.converged.tolist() == [False, True]
    assert np.isnan(solved.covariance[0]).all()
    assert np.isfinite(solved.covariance[1]).all()
    assert np.abs(solved.pose.take([1]).difference(paper_pose(1))).max() < 1e-9


def test_a_rolling_shutter_in_a_lens_follows_from_neighboring_poses():
    """Velocities that changed with every step of the poses lost a third of the frames."""
    rng = np.random.default_rng(4)
    pose, views = scenes.scene(rng, frames=30)
    shutter = ModelTerm(CATALOGUE['rolling_shutter'](), np.array([0.04]))
    model = ForwardModel(scenes.lens(), [shutter])
    uv = model.predict(pose, views).uv + rng.normal(size=views.uv.shape) * 0.1
    seen = views._replace(uv=uv, weight=np.where(np.isfinite(uv).all(axis=-1), 10.0, 0.0))
    found, ignored = localize(model, seen), localize(model.without_motion(), seen)
    assert found.converged.all()
    off, otherwise = (
        np.linalg.norm(one.pose.position - pose.position, axis=1) for one in (found, ignored)
    )
    assert np.median(off) < 0.5 * np.median(otherwise)
    chi2 = np.nansum((found.residual / 0.1) ** 2) / (2 * (seen.weight > 0).sum() - 6 * 30)
    assert chi2 == pytest.approx(1.0, abs=0.1)
    assert localize(model, seen.take([7])).converged.all()


def test_points_without_weight_cost_nothing():
    rng = np.random.default_rng(0)
    views = views_of(rng.normal(size=(4, 3)), rng.normal(size=(1, 4, 2)))
    views.weight[0] = 1.0, 0.0, 2.0, 0.0
    uv, columns = rng.normal(size=(1, 4, 2)), rng.normal(size=(1, 4, 2, 6))
    uv[0, 3] = np.nan
    cost, (hessian, gradient) = normal_equations(uv, columns, views)
    rows = ((uv - views.uv)[0, [0, 2]] * [[1.0], [2.0]]).ravel()
    weighted = (columns[0, [0, 2]] * np.array([1.0, 2.0])[:, None, None]).reshape(4, 6)
    assert cost == pytest.approx(rows @ rows)
    np.testing.assert_allclose(hessian[0], weighted.T @ weighted)
    np.testing.assert_allclose(gradient[0], weighted.T @ rows)
