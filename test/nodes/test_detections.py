"""Detections of tags with a map of tags stand for image points and landmarks."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.graph import Graph

from diagnostic_msgs.msg import DiagnosticArray  # isort: skip
from geometry_msgs.msg import PoseWithCovarianceStamped  # isort: skip

from fisheye_svp_ros.effects.forward import project_corrected
from fisheye_svp_ros.errors import ObservationError, ParameterError
from fisheye_svp_ros.io.decoding import read_pose
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.io.tag_maps import CENTER_OFFSET, map_of_size, write_tag_map
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.detections import read_apriltags, read_detections
from fisheye_svp_ros.nodes.localizer import Localizer
from fisheye_svp_ros.pose import Pose, rotation_from_vector

LENS = load_lens(lens_path('fish180'))
TAGS = map_of_size(
    np.array([4, 9, 11]),
    0.3,
    Pose(
        rotation_from_vector(np.array([[3.0, 0, 0], [2.8, 0.3, 0], [3.1, -0.4, 0.2]])),
        np.array([[-0.6, 0.1, 1.2], [0.5, -0.2, 1.5], [0.1, 0.6, 1.1]]),
    ),
)
CAMERA = Pose(rotation_from_vector(np.array([0.1, -0.2, 0.3])), np.array([0.05, -0.1, 0.0]))


def corners() -> np.ndarray:
    """Return the corners (T, 4, 2), px, that the camera sees."""
    points = CAMERA.into_body(TAGS.corners.reshape(-1, 3))
    return np.asarray(project_corrected(LENS, points).uv.reshape(-1, 4, 2))


def apriltags(kinds: Any, stamp: int = 10**9) -> Any:
    """Return a message of the tags, and of one that the map does not have."""
    found = []
    for number, uv in [*zip(TAGS.ids.tolist(), corners(), strict=True), (77, corners()[0])]:
        tag = kinds.AprilTagDetection(family='tag36h11', id=number)
        for corner, (u, v) in zip(tag.corners, uv, strict=True):
            corner.x, corner.y = float(u) + 0.5, float(v) + 0.5
        found.append(tag)
    return kinds.AprilTagDetectionArray(header=messages.header(stamp, 'camera'), detections=found)


def test_the_pose_is_that_of_the_camera(graph: Callable[..., Graph], tmp_path: Path) -> None:
    kinds = pytest.importorskip('apriltag_msgs.msg', reason='apriltag_msgs is not installed')
    write_tag_map(TAGS, tmp_path / 'tags.yaml')
    g = graph(f'tag_map:={tmp_path}/tags.yaml', 'lens:=fish180', 'svp:=false', 'patience:=0.2')
    poses = g.hear(PoseWithCovarianceStamped, 'localizer/pose')
    results = g.hear(DiagnosticArray, 'localizer/result')
    g.start(Localizer)
    g.tell(kinds.AprilTagDetectionArray, 'detections').publish(apriltags(kinds))
    g.until(lambda: poses and results)
    assert poses[0].header.frame_id == 'map'
    found = read_pose(poses[0].pose, 'pose')
    assert found.position == pytest.approx(CAMERA.position, abs=1e-6)
    assert found.rotation == pytest.approx(CAMERA.rotation, abs=1e-6)


def test_middles_of_vision_msgs_are_read() -> None:
    def one(name: str, u: float, *classes: str) -> Any:
        center = SimpleNamespace(position=SimpleNamespace(x=u, y=2 * u))
        hypotheses = [SimpleNamespace(hypothesis=SimpleNamespace(class_id=c)) for c in classes]
        return SimpleNamespace(id=name, results=hypotheses, bbox=SimpleNamespace(center=center))

    message = SimpleNamespace(
        header=SimpleNamespace(frame_id='cam'),
        detections=[
            one('tag36h11:5', 1.0),
            one('', 2.0, '12'),
            one('door', 3.0),
            one('7', np.nan),
        ],
    )
    found = read_detections(message)
    assert found.landmark.tolist() == [CENTER_OFFSET + 5, CENTER_OFFSET + 12]
    assert found.uv.tolist() == [[1.0, 2.0], [2.0, 4.0]]
    assert found.rejected == 1 and found.frame == 'cam'
    with pytest.raises(ObservationError, match='holds no tag'):
        read_apriltags(SimpleNamespace(header=message.header, detections=[]))


def test_a_missing_package_is_named(
    graph: Callable[..., Graph], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for package in ('apriltag_msgs', 'vision_msgs'):
        monkeypatch.setitem(sys.modules, f'{package}.msg', None)
    write_tag_map(TAGS, tmp_path / 'tags.yaml')
    g = graph(f'tag_map:={tmp_path}/tags.yaml', 'lens:=fish180')
    with pytest.raises(ParameterError, match='apt install ros-jazzy-apriltag-msgs'):
        g.start(Localizer)
