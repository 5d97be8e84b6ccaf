"""Metrics: their values by hand, their names, and NaN where nothing was measured."""

import numpy as np
import pytest

from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.io.landmark_files import environment
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import stereo_views, views_of
from fisheye_svp_ros.scene.rigs import calibration_poses, paper_pose, rig
from fisheye_svp_ros.simulate.simulation import simulate_stereo
from fisheye_svp_ros.solve.localization import Localization
from fisheye_svp_ros.solve.solved_poses import SolvedPoses
from fisheye_svp_ros.solve.stereo_calibration import calibrate_stereo
from fisheye_svp_ros.study.solutions import (
    FIT_METRICS,
    LOCALIZATION_METRICS,
    STEREO_CALIBRATION_METRICS,
    STEREO_DEPTH_METRICS,
    localization_metrics,
    stereo_calibration_metrics,
    stereo_depth_metrics,
)

RESIDUAL = np.array([[[3.0, 4.0], [0.0, 0.0], [np.nan, np.nan]], np.full((3, 2), np.nan)])


def solved(pose):
    """Return what is solved with such poses (2,) and RESIDUAL, one point of which is rejected."""
    views = views_of(np.ones((2, 3, 3)), np.zeros((2, 3, 2)))
    residual, rejected = RESIDUAL.copy(), np.array([[False, False, True], [False] * 3])
    residual[rejected] = 70.0
    covariance = np.tile(np.eye(6), (2, 1, 1))
    result = Localization.of_one_minimum(
        pose, covariance, residual, np.ones(2), np.ones(2, dtype=bool), np.zeros(2, dtype=int)
    )
    model = ForwardModel(load_lens(lens_path('fish180')))
    return SolvedPoses(model, views, result, rejected, ('', ''), None, np.ones(2))


def test_localization_metrics_by_hand():
    true = paper_pose(2)
    change = np.array([[1e-3, -2e-3, 2e-3, 0, 0, 0], [0, 0, 0, 3e-3, 0, 4e-3]])
    metrics = localization_metrics(solved(true.retract(change)), true)
    assert tuple(metrics) == LOCALIZATION_METRICS
    expected = {
        'odds': [0, 0],
        'ambiguous': [0, 0],
        'points': [2, 0],
        'rms_px': [np.sqrt(12.5), np.nan],
        'mean_residual_px': [2.5, np.nan],
        'position_error_m': [3e-3, 0],
        'position_error_x_m': [1e-3, 0],
        'position_error_y_m': [-2e-3, 0],
        'position_error_z_m': [2e-3, 0],
        # A turn about the viewing axis, the world's z, leaves that axis where it is.
        'rotation_error_rad': [0, 5e-3],
        'axis_error_rad': [0, 3e-3],
    }
    for name, values in expected.items():
        np.testing.assert_allclose(metrics[name], values, rtol=2e-6, atol=1e-12, err_msg=name)


def test_without_the_truth_there_are_no_errors():
    metrics = localization_metrics(solved(paper_pose(2)))
    assert tuple(metrics) == (*FIT_METRICS, 'odds', 'ambiguous')
    one = np.array([[0.5, 0.25]])
    metrics = stereo_depth_metrics(one, -one, np.ones((1, 2, 3)))
    assert tuple(metrics) == ('points', 'error2_px', 'error2_vertical_px', 'error2_max_px')


def test_stereo_calibration_metrics_pool_both_cameras():
    true = Pose(*(array[None] for array in rig('vergent')))
    off = true.retract(np.array([[0, 3e-4, 4e-4, 0, 1e-3, 0]]))
    left = np.full((1, 2, 3, 2), np.nan)
    right = left.copy()
    left[0, 0, 0] = [0.3, 0.4]
    right[0, 1, 2] = [0.0, 1.5]
    metrics = stereo_calibration_metrics(off, left, right, true)
    assert tuple(metrics) == STEREO_CALIBRATION_METRICS
    expected = {
        'views': 2,
        'points': 2,
        'mean_residual_px': 1.0,
        'rms_px': np.sqrt(1.25),
        'position_error_m': 5e-4,
        'position_error_x_m': 0,
        'position_error_y_m': 3e-4,
        'position_error_z_m': 4e-4,
        'rotation_error_rad': 1e-3,
        'axis_error_rad': 1e-3,
    }
    for name, value in expected.items():
        assert metrics[name] == pytest.approx(value, abs=1e-12), name


def test_stereo_depth_metrics_by_hand():
    nan = np.nan
    distance = np.array([[1.0, 3.0, nan], [nan] * 3])
    vertical = np.array([[-2.0, 4.0, nan], [nan] * 3])
    points = np.array([[[0, 0, 1.0], [nan] * 3, [0, 3e-3, 1.004]], [[nan] * 3] * 3])
    true = np.broadcast_to([0, 0, 1.0], points.shape)
    metrics = stereo_depth_metrics(distance, vertical, points, true)
    assert tuple(metrics) == STEREO_DEPTH_METRICS
    expected = {
        'points': [2, 0],
        'error2_px': [2, nan],
        'error2_vertical_px': [3, nan],
        'error2_max_px': [3, nan],
        'error3_m': [2.5e-3, nan],
        'error3_max_m': [5e-3, nan],
    }
    for name, values in expected.items():
        np.testing.assert_allclose(metrics[name], values, rtol=1e-12, err_msg=name)


def test_metrics_of_a_whole_calibration_vanish_with_the_true_lens():
    model = ForwardModel(load_lens(lens_path('fish214')))
    table = simulate_stereo(
        model,
        model,
        environment('whole', 0.5),
        rig('divergent'),
        calibration_poses(),
        0.0,
        np.random.default_rng(0),
    )
    solved = calibrate_stereo(model, model, *stereo_views(table))
    true = Pose(*(array[None] for array in rig('divergent')))
    metrics = stereo_calibration_metrics(
        solved.rig, solved.left_residual, solved.right_residual, true
    )
    assert metrics['views'] == 10
    assert metrics['points'] == len(table)
    assert all(metrics[name] < 1e-9 for name in metrics if name not in ('views', 'points'))
