"""A rig is localized from all of its cameras at once, as `localize --rig` does."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.graph import Graph

from diagnostic_msgs.msg import DiagnosticArray  # isort: skip
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped  # isort: skip

from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.io.decoding import read_key_values, read_pose, stamp_of
from fisheye_svp_ros.io.rig_files import save_rig
from fisheye_svp_ros.nodes.rig_localizer import RigLocalizer
from fisheye_svp_ros.nodes.synthetic_camera import SyntheticCamera
from fisheye_svp_ros.scene.rigs import rig


def test_the_pose_is_that_of_the_first_camera(graph: Callable[..., Graph], tmp_path: Path) -> None:
    save_rig(rig('vergent'), tmp_path / 'rig.yaml')
    g = graph(
        f'rig_localizer:rig:={tmp_path}/rig.yaml',
        'svp:=false',
        'rate:=10.0',
        'style:=vergent',
        'radius:=0.5',
        'poses_file:=calibration',
    )
    poses = g.hear(PoseWithCovarianceStamped, 'rig_localizer/pose')
    true = g.hear(PoseStamped, 'left/true_pose')
    results = g.hear(DiagnosticArray, 'rig_localizer/result')
    node = g.start(RigLocalizer)
    assert node.cameras == ('left/', 'right/')
    g.start(SyntheticCamera)
    g.until(lambda: poses and results)
    pose = poses[0]
    known = next(one for one in true if stamp_of(one) == stamp_of(pose))
    assert read_pose(pose.pose, 'pose').position == pytest.approx(
        read_pose(known, 'pose').position, abs=1e-7
    )
    values = read_key_values(results[0], 'result')
    assert float(values['rms_px']) < 1e-6 and float(values['position_error_m']) < 1e-7
    assert pose.pose.covariance[0] > 0


@pytest.mark.parametrize('given', [(), ('rig:=nothere.yaml',)])
def test_a_rig_is_needed(graph: Callable[..., Graph], given: tuple[str, ...]) -> None:
    with pytest.raises(ParameterError, match='rig'):
        graph(*given).start(RigLocalizer)
