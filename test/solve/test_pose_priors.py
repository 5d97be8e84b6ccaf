"""A robot that drives on a plane: one tag no longer leaves a second pose."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.tag_room import LENS, MOUNT, TagRoom, oval

from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.scene.pose_priors import PlanarPrior
from fisheye_svp_ros.solve.poses import solve_poses
from fisheye_svp_ros.solve.weak_geometry import is_ambiguous

MODEL, ROOM = ForwardModel(LENS), TagRoom(16)
SIGMA = np.array([[0.02, 0.02]])


def prior(height: float = 0.0) -> PlanarPrior:
    return PlanarPrior(MOUNT.inverse().take(None), np.array([height]), SIGMA)


@pytest.mark.parametrize('tilt', [0.0, 0.02, 0.4, 2.5])
def test_normal_equations_are_derivatives_of_the_cost(tilt):
    rng = np.random.default_rng(1)
    base = Pose(rotation_from_vector(np.array([0.6 * tilt, -0.8 * tilt, 0.0])), rng.normal(size=3))
    camera = base.compose(MOUNT).take(None)
    cost, hessian, gradient = prior().equations(camera)
    assert cost[0] == pytest.approx((base.position[2] / 0.02) ** 2 + (tilt / 0.02) ** 2)
    steps = 1e-6 * np.eye(6)
    higher, lower = (
        np.array([prior().equations(camera.retract(sign * step[None]))[0][0] for step in steps])
        for sign in (1, -1)
    )
    np.testing.assert_allclose(gradient[0], (higher - lower) / 4e-6, rtol=1e-3, atol=0.3)
    values = np.linalg.eigvalsh(hessian[0])
    assert (values > 1e-6 * values[-1]).sum() == 3


def one_tag_sets(known, count, rng):
    """Return, of images of one tag, which are ambiguous and how far off they are, squared."""
    ambiguous, off = [], []
    for place in rng.uniform(size=count):
        camera = oval(place)
        tilt = rng.normal(size=6) * [0, 0, 0.02, 0.02, 0.02, 0]
        camera = camera.compose(MOUNT.inverse()).retract(tilt).compose(MOUNT)
        seen = rng.permutation(ROOM.visible(camera))[:1]
        views = ROOM.views(camera, ROOM.project(camera, seen), seen, 0.2, rng)
        views = views._replace(prior=prior() if known else None)
        solved = solve_poses(MODEL, views, tags=True)
        assert not solved.reasons[0]
        change = solved.pose.difference(camera.take(None))[0]
        ambiguous.append(bool(is_ambiguous(solved.result)[0]))
        off.append(change @ np.linalg.solve(solved.covariance[0], change))
    return np.array(ambiguous), np.array(off)


def test_ambiguous_poses_are_five_times_rarer_and_covariances_hold():
    (without, _), (planar, off) = (
        one_tag_sets(known, 100, np.random.default_rng(5)) for known in (False, True)
    )
    assert 5 * planar.sum() < without.sum()
    assert 4.5 < off.mean() < 7.5


def test_a_plane_elsewhere_contradicts_the_image():
    rng = np.random.default_rng(3)
    camera = oval(0.2)
    seen = ROOM.visible(camera)
    views = ROOM.views(camera, ROOM.project(camera, seen), seen, 0.2, rng)
    solved = solve_poses(MODEL, views._replace(prior=prior(0.5)), tags=True)
    assert solved.reasons[0]
