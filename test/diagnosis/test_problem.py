"""Poses of a robot are not held: they are told from those of the camera."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.robot import LENS, TRUTH, robot

from fisheye_svp_ros.diagnosis import DiagnosisOptions, diagnose
from fisheye_svp_ros.diagnosis.problem import Inputs, prepare_problem
from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.pose import Pose, identity, rotation_from_vector
from fisheye_svp_ros.reporting.diagnosis_document import diagnosis_document
from fisheye_svp_ros.solve.hand_eye import Transforms

QUICK = DiagnosisOptions(quick=True)
# Poses that a hand-eye calibration made those of the camera, all but.
NEAR = Transforms(
    Pose(rotation_from_vector(np.full(3, 1e-3)), np.full(3, 4e-4)), identity(), 1.0005
)


@pytest.mark.parametrize('truth', [TRUTH, NEAR], ids=['flange', 'nearly the camera'])
def test_no_cause_in_the_lens_comes_from_a_robot(truth: Transforms) -> None:
    table, _, poses = robot(1, truth=truth)
    found = diagnose(table, LENS, free_intrinsics=True, poses=poses, options=QUICK)
    assert found.verdict == 'adequate' and not found.causes
    robot_found = found.hand_eye
    assert robot_found is not None
    off = robot_found.camera.difference(truth.camera) / robot_found.stderr[:6]
    assert (np.abs(off) < 4).all()
    written = diagnosis_document(found)['hand_eye']
    assert written['camera_in_flange']['position'] == robot_found.camera.position.tolist()


def test_poses_of_the_camera_are_held() -> None:
    table, camera, _ = robot(2)
    poses = {i: camera.take(i) for i in range(len(camera.position))}
    problem, of_robot = prepare_problem(Inputs.check(table, LENS, QUICK, poses=poses))
    assert not of_robot and problem.data.poses is not None


def test_poses_of_no_robot_are_refused() -> None:
    table, _, poses = robot(3)
    shuffled = dict(zip(poses, [poses[(7 * i + 3) % 18] for i in range(18)], strict=True))
    with pytest.raises(ObservationError, match='nor those of a flange'):
        diagnose(table, LENS, poses=shuffled, options=QUICK)
