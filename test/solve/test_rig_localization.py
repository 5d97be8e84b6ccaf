"""One pose per frame from all cameras of a rig."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.moving_rig import moving_rig
from helpers.surround import BOARD, CAMERAS, LENS, NOISE, RIG, board_pose, photographs

from fisheye_svp_ros.errors import GeometryError, ObservationError
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.solve.table_poses import solve_rig_table

SEAMS = (45.0, 135.0, 225.0, 315.0)
LENSES = dict.fromkeys(CAMERAS, LENS)


def true_poses(seed: int, frames: int = 40) -> Pose:
    """Return the first camera in the board, of what `photographs` draws."""
    rng = np.random.default_rng(seed)
    boards = []
    for frame in range(frames):
        azimuth = np.radians(SEAMS[frame % len(SEAMS)]) + rng.normal(0, 0.1)
        boards.append(board_pose(azimuth, rng))
    return Pose.stack(boards).inverse()


def test_all_cameras_pose_the_rig_within_stated_errors() -> None:
    found = solve_rig_table(photographs(1, SEAMS), LENSES, CAMERAS, RIG)
    assert found.frame.tolist() == list(range(40)) and not found.contradicted
    assert len(BOARD) == 54 and found.sigma == pytest.approx(NOISE, rel=0.05)
    off = found.pose.difference(true_poses(1))
    chi2 = np.einsum('fi,fij,fj->f', off, np.linalg.inv(found.covariance), off)
    assert 4.5 < chi2.mean() < 7.5  # 6, of 40 frames


def test_several_cameras_are_better_than_one() -> None:
    table = photographs(1, SEAMS)
    both = solve_rig_table(table, LENSES, CAMERAS, RIG)
    first = np.unique(table.frame[table.camera == 1])
    alone = solve_rig_table(table.take(table.camera == 1), LENSES, CAMERAS, RIG)
    assert alone.frame.tolist() == first.tolist()
    ratio = np.trace(
        both.covariance[np.isin(both.frame, first)][:, :3, :3], axis1=1, axis2=2
    ) / np.trace(alone.covariance[:, :3, :3], axis1=1, axis2=2)
    assert np.median(ratio) < 0.7


def test_a_rig_that_stands_otherwise_is_reported() -> None:
    moved = Pose(RIG.rotation, RIG.position.copy())
    moved.position[1, 0] += 0.01
    assert solve_rig_table(photographs(1, SEAMS), LENSES, CAMERAS, moved).contradicted


def test_a_camera_that_is_not_in_the_rig_is_refused() -> None:
    table = replace(photographs(1, SEAMS), cameras=('cam0', 'cam1', 'cam2', 'up'))
    with pytest.raises(ObservationError, match='camera up is not in the rig, which has cam0'):
        solve_rig_table(table, LENSES | {'up': LENS}, CAMERAS, RIG)


def test_boards_of_the_cameras_own_are_refused() -> None:
    table, _ = moving_rig(1, frames=6, cameras=2)
    with pytest.raises(GeometryError, match='They see different boards'):
        solve_rig_table(table, LENSES, CAMERAS, RIG)
