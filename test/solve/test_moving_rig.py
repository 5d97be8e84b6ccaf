"""Cameras that see boards of their own: related by the motion of the rig, or refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.differences import jacobian
from helpers.moving_rig import moving_rig
from helpers.surround import CAMERAS, LENS, NOISE, RIG
from scipy.stats import chi2

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.pose import Pose, identity
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.rig_calibration import RigCalibration, calibrate_rig
from fisheye_svp_ros.solve.rig_state import Linearization, group_by_frame


def calibrated(table: Observations) -> RigCalibration:
    return calibrate_rig(table, dict.fromkeys(CAMERAS, LENS), table.cameras)


def in_one_frame(table: Observations, boards: list[Pose], cameras: int) -> Observations:
    """Return rows whose landmarks the first cameras' boards have in one frame, as if measured."""
    xyz = table.xyz.copy()
    for camera, board in enumerate(boards[:cameras]):
        mine = table.camera == camera
        xyz[mine] = boards[0].inverse().compose(board).transform(xyz[mine])
    return replace(table, xyz=xyz)


def test_transforms_lie_within_their_stated_errors() -> None:
    errors = []
    for seed in range(3):
        found = calibrated(moving_rig(seed)[0])
        assert found.boards == (0, 1, 2, 3)
        assert found.sigma_px == pytest.approx(NOISE, rel=0.05)
        off = found.rig.difference(RIG)[1:]
        errors += [
            one @ np.linalg.solve(covariance, one)
            for one, covariance in zip(off, found.covariance, strict=True)
        ]
    low, high = chi2.ppf([0.001, 0.999], 6 * len(errors)) / len(errors)
    assert low < np.mean(errors) < high
    assert found.rig.position == pytest.approx(RIG.position, abs=1.5e-3)


def test_derivatives_by_boards_and_rig() -> None:
    table, _ = moving_rig(1, frames=3, cameras=2)
    data = group_by_frame(table)
    state = replace(initial_state(data, LENS, [LENS]), boards=(0, 1))
    state = replace(
        state,
        rig=Pose.concatenate([state.rig, identity(1)]).retract(
            np.random.default_rng(0).normal(0, 0.02, (3, 6)) * [[0], [1], [1]]
        ),
    )

    def residual(change: Array) -> Array:
        moved = state.retract((), np.tile(change[:6], (data.frames, 1)), change[6:])
        return Linearization(data, moved, ()).residual

    linear = Linearization(data, state, ())
    columns = np.concatenate([linear.frame_columns, linear.shared_columns], axis=-1)
    np.testing.assert_allclose(-columns, jacobian(residual)(np.zeros(18)), rtol=1e-5, atol=1e-3)


def test_boards_known_to_each_other_hold_cameras_without_a_motion() -> None:
    table, boards = moving_rig(2, turn=(0.0, 0.0, 0.0))
    found = calibrated(in_one_frame(table, boards, 4))
    assert found.boards == ()
    assert found.rig.position == pytest.approx(RIG.position, abs=1e-3)


def test_some_boards_are_known_to_each_other() -> None:
    table, boards = moving_rig(3, cameras=3)
    found = calibrated(in_one_frame(table, boards, 2))
    assert found.boards == (0, 0, 1)
    assert found.rig.position == pytest.approx(RIG.position[:3], abs=1.5e-3)


def test_photographs_of_other_moments_are_left_out() -> None:
    table, _ = moving_rig(4, cameras=2)
    mine = table.camera == 1
    frame = table.frame.copy()
    frame[mine & (table.frame == 3)], frame[mine & (table.frame == 9)] = 9, 3
    found = calibrated(replace(table, frame=frame))
    assert found.left_out == (3, 9)
    assert found.sigma_px == pytest.approx(NOISE, rel=0.05)


@pytest.mark.parametrize(
    ('motion', 'said'),
    [
        ({'turn': (0.0, 0.0, 0.0), 'move': 0.2}, 'the rig does not turn'),
        ({'turn': (0.0, 0.35, 0.0)}, 'the rig turns about one axis only; turn it about two axes'),
        ({'frames': 3}, '3 frames show two of them; take 4 or more'),
    ],
)
def test_what_a_motion_lacks_is_said(motion: dict, said: str) -> None:
    with pytest.raises(ObservationError, match=f'of their own, {said}'):
        calibrated(moving_rig(5, cameras=2, **motion)[0])


def test_frames_of_other_moments_are_no_motion() -> None:
    table, _ = moving_rig(6, cameras=2)
    frame = np.where(table.camera == 1, (7 * table.frame + 5) % 16, table.frame)
    with pytest.raises(ObservationError, match='no motion of a rig explains these frames'):
        calibrated(replace(table, frame=frame))
