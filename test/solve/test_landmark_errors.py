"""Poses by landmarks that are known with errors: their covariances hold, and so do the tests."""

import numpy as np
import pytest
from scipy.stats import chi2

from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.optics.curves import KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, cross_matrix, rotation_from_vector
from fisheye_svp_ros.scene.observations import views_of
from fisheye_svp_ros.solve.localization import localize
from fisheye_svp_ros.solve.poses import solve_poses

MODEL = ForwardModel(
    Lens('made', 1280, 960, 330.0, 331.0, 640.5, 479.5, KannalaBrandt(0.03, -0.01), 1.5)
)
SIGMA = 0.2  # px
SQUARE = 0.1 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])


def maps(systems, tags, rng, independent=True):
    """Return corners (S, T, 4, 3), m, as stated, of maps with errors, and their covariance.

    Errors of tags grow away from the first, as those of a map do, and each tag has its own.
    """
    turn = rotation_from_vector(rng.normal(0, 0.4, (systems, tags, 3)))
    place = rng.uniform([-1.5, -1.0, 1.5], [1.5, 1.0, 3.0], (systems, tags, 3))
    arm = SQUARE @ np.swapaxes(turn, -1, -2)
    by_tag = np.concatenate([np.tile(np.eye(3), (systems, tags, 4, 1, 1)), -cross_matrix(arm)], -1)
    whole = np.concatenate(
        [np.tile(np.eye(3), (systems, tags, 4, 1, 1)), -cross_matrix(place[:, :, None] + arm)], -1
    )
    scale = np.array([0.02, 0.02, 0.02, 0.01, 0.01, 0.01])  # m, rad
    shared = (whole * scale).reshape(systems, 12 * tags, 6)
    covariance = shared @ np.swapaxes(shared, -1, -2)
    if independent:
        size = rng.uniform(0.5, 4.0, tags)[:, None] * [0.002, 0.002, 0.002, 0.004, 0.004, 0.004]
        own = np.zeros((systems, tags, 12, tags, 6))
        for tag in range(tags):
            own[:, tag, :, tag] = (by_tag[:, tag] * size[tag]).reshape(systems, 12, 6)
        own = own.reshape(systems, 12 * tags, 6 * tags)
        covariance = covariance + own @ np.swapaxes(own, -1, -2)
    return place[:, :, None] + arm, covariance


def seen_by(systems, tags, seed, **more):
    """Return views of maps (S,) that are off as their covariances say, and the true poses."""
    rng = np.random.default_rng(seed)
    stated, covariance = maps(systems, tags, rng, **more)
    root = np.linalg.cholesky(covariance + 1e-16 * np.eye(12 * tags))
    off = (root @ rng.normal(size=(systems, 12 * tags, 1))).reshape(systems, -1, 3)
    true = Pose(
        rotation_from_vector(rng.normal(0, 0.2, (systems, 3))),
        rng.normal(0, 0.2, (systems, 3)),
    )
    points = stated.reshape(systems, -1, 3)
    uv = MODEL.predict(true, views_of(points + off)).uv
    uv = uv + rng.normal(0, SIGMA, uv.shape)
    views = views_of(points, uv, np.full(uv.shape[:2], 1 / SIGMA))
    shape = systems, 4 * tags, 3, 4 * tags, 3
    return views._replace(landmark_covariance=covariance.reshape(shape)), true


def nees(solution, true):
    """Return the normalized squared errors (S,) of poses."""
    error = solution.pose.difference(true)
    return (error * np.linalg.solve(solution.covariance, error[..., None])[..., 0]).sum(axis=-1)


@pytest.mark.parametrize('tags', [1, 2, 6])
def test_covariances_hold_the_errors_of_a_map(tags):
    views, true = seen_by(200, tags, 3 + tags)
    solved = solve_poses(MODEL, views)
    squares, freedom = nees(solved.result, true), 8 * tags - 6
    assert 0.91 < (squares < chi2.ppf(0.95, 6)).mean() < 0.99
    assert squares.mean() == pytest.approx(6.0, abs=0.8)
    # The test of residuals knows of them, too: nothing is suspected.
    assert solved.result.cost.mean() / freedom == pytest.approx(
        1.0, abs=3.5 * (200 * freedom / 2) ** -0.5
    )
    assert sum(map(bool, solved.reasons)) <= 1 and solved.passes(3.0).all()


def test_tags_are_weighed_by_their_errors():
    views, true = seen_by(60, 6, 9)
    weighed = localize(MODEL, views).pose.difference(true)
    alike = localize(MODEL, views._replace(landmark_covariance=None)).pose.difference(true)
    assert np.linalg.norm(weighed[:, :3]) < 0.92 * np.linalg.norm(alike[:, :3])


def test_what_a_whole_map_shares_is_no_noise_of_a_set():
    views, true = seen_by(20, 4, 5, independent=False)
    exact = views._replace(landmark_covariance=None)
    shared, alone = localize(MODEL, views), localize(MODEL, exact)
    np.testing.assert_allclose(shared.cost, alone.cost, rtol=0.02)
    assert 4.0 < nees(shared, true).mean() < 8.0 < 100.0 < nees(alone, true).mean()
    views.uv[:, 7, 0] += 4.0  # px, less than the map is off by, and more than a corner is
    found = solve_poses(MODEL, views)
    assert all(reason.startswith('outliers rejected: landmark 7 (') for reason in found.reasons)


def test_views_without_a_pose_stay_without():
    views, true = seen_by(3, 2, 6)
    line = views.points[1, :1] + np.arange(8)[:, None] * [0.1, 0.0, 0.0]
    views = views._replace(points=np.stack([views.points[0], line, views.points[2]]))
    solved = solve_poses(MODEL, views)
    assert solved.result.converged.tolist() == [True, False, True]
    assert np.isfinite(nees(solved.result, true)[[0, 2]]).all()
