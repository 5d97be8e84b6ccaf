"""Rigid transforms, against scipy's rotations and by their own laws."""

import warnings

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fisheye_svp_ros.pose import (
    PAPER_FROM_OPTICAL,
    Pose,
    axis_angle_between,
    cross_matrix,
    identity,
    nearest_rotation,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
    vector_from_rotation,
)

rng = np.random.default_rng(21)
VECTORS = np.concatenate(
    [
        rng.normal(size=(40, 3)),
        rng.normal(size=(20, 3)) * 10.0 ** rng.uniform(-12, -4, (20, 1)),
        np.zeros((1, 3)),
        np.pi * np.eye(3),
        (np.pi - 1e-7) * np.eye(3),
    ]
)


def random_poses(*shape):
    quaternion = rng.normal(size=(*shape, 4))
    return Pose(rotation_from_quaternion(quaternion), rng.normal(size=(*shape, 3)))


def test_exponential_map_equals_scipy():
    expected = Rotation.from_rotvec(VECTORS).as_matrix()
    np.testing.assert_allclose(rotation_from_vector(VECTORS), expected, rtol=0, atol=2e-15)


def test_logarithm_inverts_the_exponential_map():
    rotation = rotation_from_vector(VECTORS)
    vector = vector_from_rotation(rotation)
    np.testing.assert_allclose(rotation_from_vector(vector), rotation, rtol=0, atol=3e-15)
    short = np.linalg.norm(VECTORS, axis=-1) < 3.0
    np.testing.assert_allclose(vector[short], VECTORS[short], rtol=1e-12, atol=1e-15)
    assert np.all(np.linalg.norm(vector, axis=-1) <= np.pi + 1e-12)


def test_quaternions_equal_scipy():
    quaternion = rng.normal(size=(6, 7, 4))
    quaternion[0, :4] = np.eye(4)
    rotation = rotation_from_quaternion(quaternion)
    expected = Rotation.from_quat(quaternion.reshape(-1, 4)).as_matrix().reshape(6, 7, 3, 3)
    np.testing.assert_allclose(rotation, expected, rtol=0, atol=2e-15)
    again = quaternion_from_rotation(rotation)
    assert np.all(again[..., 3] >= 0)
    np.testing.assert_allclose(np.linalg.norm(again, axis=-1), 1.0, rtol=0, atol=1e-15)
    np.testing.assert_allclose(rotation_from_quaternion(again), rotation, rtol=0, atol=3e-15)


def test_poses_form_a_group():
    a, b = random_poses(5), random_poses(5)
    points = rng.normal(size=(5, 3))
    np.testing.assert_allclose(
        a.compose(b).transform(points), a.transform(b.transform(points)), rtol=0, atol=1e-14
    )
    one = a.compose(a.inverse())
    np.testing.assert_allclose(one.rotation, identity(5).rotation, rtol=0, atol=1e-15)
    np.testing.assert_allclose(one.position, 0.0, rtol=0, atol=1e-14)
    many = rng.normal(size=(5, 4, 3))
    back = np.stack([a.transform(a.into_body(many)[:, i]) for i in range(4)], axis=1)
    np.testing.assert_allclose(back, many, rtol=0, atol=1e-14)


@pytest.mark.parametrize('shape', [(), (3,), (0,), (2, 3)])
def test_any_leading_shape(shape):
    a, change = random_poses(*shape), np.full((*shape, 6), 0.1)
    moved = a.retract(change)
    assert moved.rotation.shape == (*shape, 3, 3)
    assert moved.position.shape == (*shape, 3)
    assert moved.difference(a).shape == (*shape, 6)
    assert a.compose(moved.inverse()).position.shape == (*shape, 3)
    assert a.into_body(np.zeros((*shape, 5, 3))).shape == (*shape, 5, 3)
    assert axis_angle_between(a, moved).shape == shape


def test_difference_undoes_retract():
    pose = random_poses(50)
    change = rng.normal(size=(50, 6)) * 10.0 ** rng.uniform(-9, 0, (50, 1))
    np.testing.assert_allclose(pose.retract(change).difference(pose), change, rtol=0, atol=1e-14)


def test_a_turn_is_in_the_reference_frame():
    pose = random_poses(1).take(0)
    turned = pose.retract(np.array([0, 0, 0, 0, 0, 0.3]))
    np.testing.assert_allclose(
        turned.rotation, Rotation.from_euler('z', 0.3).as_matrix() @ pose.rotation, atol=1e-15
    )


def test_nearest_rotation_is_the_closest_of_all():
    matrix = rng.normal(size=(20, 3, 3))
    best = nearest_rotation(matrix)
    np.testing.assert_allclose(np.linalg.det(best), 1.0, rtol=0, atol=1e-14)
    off = np.linalg.norm(best - matrix, axis=(1, 2))
    for _ in range(50):
        other = rotation_from_vector(rng.normal(size=(20, 3)) * 0.3) @ best
        assert np.all(np.linalg.norm(other - matrix, axis=(1, 2)) >= off - 1e-12)


def test_axis_angle_is_exact_for_tiny_and_large_angles():
    for angle in (1e-12, 1e-3, 1.0, 3.0):
        turned = identity().retract(np.array([0, 0, 0, angle, 0, 0]))
        assert axis_angle_between(identity(), turned) == pytest.approx(angle, rel=1e-12)
    roll = identity().retract(np.array([0, 0, 0, 0, 0, 0.5]))
    assert axis_angle_between(identity(), roll) == 0.0


def test_cross_matrix_and_paper_frame():
    a, b = rng.normal(size=(2, 4, 3))
    np.testing.assert_allclose((cross_matrix(a) @ b[..., None])[..., 0], np.cross(a, b))
    # Gazing along -z with y up: the optical z, x and y axes are -z, x and -y of the world.
    np.testing.assert_array_equal(PAPER_FROM_OPTICAL.T, [[1, 0, 0], [0, -1, 0], [0, 0, -1]])
    assert np.linalg.det(PAPER_FROM_OPTICAL) == 1.0


def test_an_unknown_pose_is_no_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        assert np.isnan(Pose(np.full((2, 3, 3), np.nan), np.zeros((2, 3))).rotation).all()
