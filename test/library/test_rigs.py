"""The library with rigs of any number of cameras, and with robots."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.robot import TRUTH, robot
from helpers.surround import CAMERAS, LENS, RIG, photographs

import fisheye_svp_ros as fsvp
from fisheye_svp_ros.io.csv_files import FramePoses, write_poses
from fisheye_svp_ros.pose import Pose

LENSES = dict.fromkeys(CAMERAS, LENS)


def test_a_rig_is_calibrated_and_posed() -> None:
    table = photographs(1, (45.0, 135.0, 225.0, 315.0))
    rig = fsvp.calibrate_rig(table, LENSES)
    assert rig.cameras == CAMERAS
    np.testing.assert_allclose(rig.rig.position, RIG.position, atol=1e-3)
    found = fsvp.localize_rig(table, LENSES, rig)
    assert len(found.frame) == 40 and not found.contradicted


def test_cameras_that_nothing_holds_are_refused() -> None:
    with pytest.raises(fsvp.FisheyeSvpError, match='cam3 cannot be related to cam0, cam1, cam2'):
        fsvp.calibrate_rig(photographs(3, (45.0, 135.0)), LENSES)


def test_poses_of_a_robot(tmp_path: Path) -> None:
    table, _, poses = robot(1)
    flange = Pose.stack(list(poses.values()))
    write_poses(tmp_path / 'flange.csv', np.arange(len(poses)), flange)
    found = [
        fsvp.calibrate(
            table, 'kannala_brandt', (1280, 960), ['f', 'cx', 'cy', 'k1'], poses=given
        ).lens.calibration
        for given in (tmp_path / 'flange.csv', FramePoses(np.arange(len(poses)), flange))
    ]
    place = found[0]['hand_eye']['camera_in_flange']['position']
    np.testing.assert_allclose(place, TRUTH.camera.position, atol=1.5e-3)
    np.testing.assert_allclose(
        found[1]['hand_eye']['camera_in_flange']['position'], place, atol=1e-7
    )
