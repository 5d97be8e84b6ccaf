"""Rigs and the poses they are calibrated from."""

import numpy as np
import pytest

from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.io.landmark_files import environment
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.optics.camera import project, unique_range
from fisheye_svp_ros.pose import PAPER_FROM_OPTICAL
from fisheye_svp_ros.scene.observations import RADII, rig_cameras
from fisheye_svp_ros.scene.rigs import BASELINE, STYLES, calibration_poses, paper_pose, rig


@pytest.mark.parametrize(
    ('style', 'inward'), [('parallel', 0), ('vergent', 10), ('divergent', -10)]
)
def test_styles(style, inward):
    left = rig(style)
    np.testing.assert_array_equal(left.position, [-BASELINE, 0, 0])
    # Inward is towards the right camera, +x.
    axis = left.rotation[:, 2]
    assert np.degrees(np.arctan2(axis[0], axis[2])) == pytest.approx(inward)
    assert axis[1] == 0


@pytest.mark.parametrize(
    ('style', 'baseline', 'reason'),
    [
        ('crossed', 0.15, "style 'crossed' is unknown; choose from parallel, vergent, divergent"),
        ('parallel', 0.0, 'baseline is 0.0 m; it must be above 0'),
        ('parallel', float('nan'), 'baseline is nan m; it must be above 0'),
    ],
)
def test_impossible_rig(style, baseline, reason):
    with pytest.raises(ParameterError, match=reason):
        rig(style, baseline)


def test_paper_pose_gazes_along_minus_z():
    np.testing.assert_array_equal(paper_pose().rotation[:, 2], [0, 0, -1])
    assert paper_pose(2, 3).position.shape == (2, 3, 3)


@pytest.mark.parametrize('name', ['fish180', 'fish214'])
@pytest.mark.parametrize('style', STYLES)
@pytest.mark.parametrize('radius', RADII)
def test_ten_calibration_poses_keep_clear_of_the_landmarks_and_see_most(name, style, radius):
    lens = load_lens(lens_path(name))
    right = calibration_poses()
    assert right.position.shape == (10, 3)
    points = environment('whole', radius).points
    for camera in (right, right.compose(rig(style))):
        local = camera.into_body(np.broadcast_to(points, (10, *points.shape)))
        assert np.linalg.norm(local, axis=-1).min() > max(0.09, 1.8 * unique_range(lens))
        seen = project(lens, local).valid.sum(axis=1)
        assert seen.min() >= 24
        assert seen.mean() >= 26


def test_calibration_poses_differ_in_place_and_turn():
    pose = calibration_poses()
    turns = pose.rotation @ PAPER_FROM_OPTICAL.T
    cosines = (np.einsum('aij,bij->ab', turns, turns) - 1) / 2
    others = ~np.eye(10, dtype=bool)
    assert np.degrees(np.arccos(cosines[others].max())) > 5
    assert np.linalg.matrix_rank(pose.position - pose.position.mean(axis=0), 1e-3) == 3


@pytest.mark.parametrize(
    ('cameras', 'pair'),
    [
        (('left', 'right'), ('left', 'right')),
        (('right', 'left', 'top'), ('left', 'right')),
        (('cam1', 'cam0'), ('cam0', 'cam1')),
        (('',), None),
        (('a', 'b', 'c'), None),
    ],
)
def test_which_cameras_are_a_rig(cameras, pair):
    assert rig_cameras(cameras) == pair
