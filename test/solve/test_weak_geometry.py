"""Covariances hold where the linearized one does not, and a second pose is reported."""

import numpy as np
import pytest
from helpers.tag_room import LENS, TagRoom, oval

from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.optics.curves import KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.scene.observations import make_observations, views_of
from fisheye_svp_ros.solve.localization import localize
from fisheye_svp_ros.solve.poses import solve_poses
from fisheye_svp_ros.solve.table_poses import solve_table
from fisheye_svp_ros.solve.weak_geometry import (
    CHI2_999,
    hold_weak_geometry,
    is_ambiguous,
    pose_odds,
    squared_distances,
)

SIGMA = 0.5  # px
KB = KannalaBrandt(0.03, -0.01, 0.002, -0.0005)
MODEL = ForwardModel(Lens('made', 1280, 960, 330.0, 331.0, 640.5, 479.5, KB, 1.5))
BOARD = np.array([[0.025 * x, 0.025 * y, 0] for y in range(6) for x in range(9)])
BOARD = BOARD - BOARD.mean(axis=0)
TAG = np.array([[-0.05, -0.05, 0], [0.05, -0.05, 0], [0.05, 0.05, 0], [-0.05, 0.05, 0]])


def noisy_views(points, turn, place, count=150, model=MODEL, sigma=SIGMA):
    """Return views of a target at one place in the camera frame, and their true poses."""
    camera = Pose(rotation_from_vector(np.array(turn)), np.array(place)).inverse()
    true = Pose(*(np.tile(part, (count,) + (1,) * part.ndim) for part in camera))
    blank = views_of(np.tile(points, (count, 1, 1)))
    noise = np.random.default_rng(1).normal(0, sigma, (count, len(points), 2))
    uv = model.predict(true, blank).uv + noise
    return views_of(blank.points, uv, np.full(uv.shape[:2], 1 / sigma)), true


def outside(found, true):
    """Return the share of poses outside of their own 99.9 % ellipsoids."""
    change = found.pose.difference(true)[:, None]
    return np.mean(squared_distances(change, found.covariance) > CHI2_999)


@pytest.mark.parametrize(
    ('points', 'turn', 'place'),
    [
        (BOARD, (0, 0, 0), (0, 0, 1.5)),
        (TAG, (0, 0, 0), (0, 0, 1)),
        (TAG, (0.4, 0.3, 0), (0.5, 0, 2)),
    ],
    ids=['far board', 'frontal tag', 'far tag'],
)
def test_ellipsoids_of_small_flat_targets_hold(points, turn, place, engine):
    views, true = noisy_views(points, turn, place)
    linear = localize(MODEL, views)
    assert outside(linear, true) > 0.3
    held = solve_poses(MODEL, views).result
    assert outside(held, true) < 0.04
    np.testing.assert_array_equal(held.pose.position, linear.pose.position)


def far_pairs(count):
    """Return views of two tags farther than 3 m, in rooms of tags, and the cameras."""
    rng, points, uv, cameras = np.random.default_rng(3), [], [], []
    rooms = [TagRoom(16, seed=seed) for seed in range(40)]
    for i in range(count):
        room = rooms[i % len(rooms)]
        camera = oval(rng.uniform()).retract(np.array([0, 0, 0, 0, 0.6 * rng.normal(), 0]))
        tags = room.visible(camera)
        far = np.linalg.norm(room.tags.poses.position[tags] - camera.position, axis=-1) > 3
        if far.sum() >= 2:
            two = rng.permutation(tags[far])[:2]
            points.append(room.tags.corners[two].reshape(-1, 3))
            uv.append(room.project(camera, two) + 0.2 * rng.normal(size=(8, 2)))
            cameras.append(camera)
    seen = np.array(uv)
    return views_of(np.array(points), seen, np.full(seen.shape[:2], 5.0)), Pose.stack(cameras)


def test_cautious_ellipsoids_of_two_far_tags_hold():
    """Linearized covariances leave 3 %, those that hold 95 % leave .6 % outside of 99.9 %."""
    views, true = far_pairs(5000)
    solved = solve_poses(ForwardModel(LENS), views, examined=False)
    change = solved.pose.difference(true)[:, None]
    cautious = squared_distances(change, solved.cautious_covariance)
    assert len(change) > 3000 and outside(solved.result, true) > 0.004
    assert np.mean(cautious > CHI2_999) < 0.0025
    assert np.mean(cautious) > 3, 'and are not larger than that'
    assert solved.result.tail.max() > 1.5 and solved.result.tail.min() == 1


def test_strong_geometry_keeps_its_covariance():
    rng = np.random.default_rng(0)
    views, _ = noisy_views(rng.uniform(-2, 2, (30, 3)), (0, 0, 0), (0, 0, 3), 20)
    found = localize(MODEL, views)
    assert hold_weak_geometry(MODEL, views, found) is found
    assert not is_ambiguous(found).any() and not pose_odds(found).any()


def test_one_view_and_many_have_the_same_covariances():
    views, _ = noisy_views(TAG, (0.4, 0.3, 0), (0.5, 0, 2), 5)
    many = hold_weak_geometry(MODEL, views, localize(MODEL, views))
    for i in range(5):
        view = views.take([i])
        one = hold_weak_geometry(MODEL, view, localize(MODEL, view))
        np.testing.assert_allclose(one.covariance[0], many.covariance[i], rtol=1e-5, atol=1e-12)


def test_a_second_pose_is_reported_with_its_odds():
    views, _ = noisy_views(TAG, (0.4, 0.3, 0), (0.5, 0, 2), 40)
    solution = solve_poses(MODEL, views, examined=False).result
    assert is_ambiguous(solution).mean() > 0.9
    odds = pose_odds(solution)
    np.testing.assert_allclose(odds, np.exp(-0.5 * solution.gap))
    assert ((odds >= 0) & (odds <= 1)).all() and np.median(odds) > 0.3
    again = localize(MODEL, views, solution.other)
    np.testing.assert_allclose(again.cost, solution.cost, rtol=1e-6)  # the better one, from either
    near, _ = noisy_views(BOARD, (0.5, 0, 0), (0, 0, 0.5), 20)
    assert not is_ambiguous(solve_poses(MODEL, near, examined=False).result).any()


def test_unknown_noise_is_taken_from_the_residuals():
    views, true = noisy_views(BOARD, (0, 0, 0), (0, 0, 1.5))
    count, points = views.uv.shape[:2]
    frame = np.repeat(np.arange(count), points)
    landmark = np.tile(np.arange(points), count)
    table = make_observations(
        frame, landmark, views.uv.reshape(-1, 2), views.points.reshape(-1, 3)
    )
    measured = solve_table(table, MODEL)
    known = solve_poses(MODEL, views).result
    assert outside(measured.result, true) < 0.04
    ratio = np.trace(measured.result.covariance, axis1=1, axis2=2)
    ratio = ratio / np.trace(known.covariance, axis1=1, axis2=2)
    np.testing.assert_allclose(ratio, 1.0, atol=0.15)


def test_a_neglected_shift_is_in_the_covariance():
    lens = load_lens(lens_path('fish214'))
    true_model, svp = ForwardModel(lens), ForwardModel(lens.approximate())
    points = np.random.default_rng(2).normal(size=(30, 3))
    points = 0.3 * points / np.linalg.norm(points, axis=1, keepdims=True)
    points[:, 2] = np.abs(points[:, 2])
    views, true = noisy_views(points, (0, 0, 0), (0, 0, 0), 3, true_model, 1e-3)
    views = views._replace(weight=np.full_like(views.weight, 1.0))
    found = solve_poses(svp, views, searched=False).result
    change = found.pose.difference(true)[:, None]
    assert (squared_distances(change, found.covariance - found.added) > CHI2_999).all()
    assert (squared_distances(change, found.covariance) < 3.0).all()
    assert lens.approximate() == lens.svp() and lens.svp().neglected is None
