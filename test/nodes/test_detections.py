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
from fisheye_svp_ros.io.decoding import ImagePoints, LandmarkSet, read_landmarks, read_pose
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.io.tag_maps import CENTER_OFFSET, map_of_size, read_tag_map, write_tag_map
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.detections import TagLimits, read_apriltags, read_detections
from fisheye_svp_ros.nodes.localizer import Localizer
from fisheye_svp_ros.nodes.validation import SetValidation
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.scene.observations import Landmarks
from fisheye_svp_ros.study.settings import LocalizerSettings

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


def found_tags(*tags: tuple[int, int, float], family: str = 'tag36h11') -> Any:
    """Return a message of tags, each by id, hamming and decision margin."""
    corners = [SimpleNamespace(x=float(i), y=float(2 * i)) for i in range(4)]
    detections = [
        SimpleNamespace(
            id=number, hamming=bits, decision_margin=margin, corners=corners, family=family
        )
        for number, bits, margin in tags
    ]
    return SimpleNamespace(header=SimpleNamespace(frame_id='cam'), detections=detections)


def test_tags_that_the_detector_is_not_sure_of_are_left_out() -> None:
    limits = TagLimits(max_hamming=1, min_decision_margin=20.0)
    message = found_tags((3, 0, 50.0), (4, 2, 50.0), (5, 1, 19.0), (6, 1, 0.0), (7, 0, 50.0))
    found = read_apriltags(message, limits=limits)
    assert np.unique(found.tag).tolist() == [3, 6, 7], 'a margin of 0 is one that is not stated'
    assert found.doubtful_tags == 2
    with pytest.raises(ObservationError, match='1 of 1 tags left out'):
        read_apriltags(found_tags((4, 2, 50.0)), limits=limits)
    twice = read_apriltags(found_tags((3, 0, 50.0), (3, 0, 50.0), (8, 0, 50.0)))
    assert np.unique(twice.tag).tolist() == [8]


def test_tags_of_another_family_than_the_map_are_refused(tmp_path: Path) -> None:
    write_tag_map(TAGS._replace(family='36h11'), tmp_path / 'tags.yaml')
    limits = TagLimits(family=read_tag_map(tmp_path / 'tags.yaml').family)
    for name in ('tag36h11', '36h11', 'DICT_APRILTAG_36H11', ''):
        read_apriltags(found_tags((3, 0, 50.0), family=name), limits=limits)
    other = found_tags((3, 0, 50.0), family='tagStandard41h12')
    with pytest.raises(ObservationError, match="'tagStandard41h12', those of the map of '36h11'"):
        read_apriltags(other, limits=limits)
    assert read_apriltags(other).tag is not None, 'the map states none'


def validate(points: ImagePoints, strict: bool = False) -> tuple[ImagePoints, list[str]]:
    """Return what is used of image points, and what is told of the others."""
    check = SetValidation(['detections'], [], lambda *_: None, lambda *_: None)
    landmarks = LandmarkSet(TAGS.landmarks(), 'map')
    settings = LocalizerSettings(strict=strict)
    items, texts = check.check({'detections': points}, landmarks, settings, 1)
    return items['detections'], texts


def test_tags_are_called_by_their_ids() -> None:
    found = read_apriltags(found_tags((4, 0, 50.0), (77, 0, 50.0), (9, 3, 50.0)))
    used, texts = validate(found)
    assert used.tag is not None and used.tag.tolist() == [4] * 4
    assert texts[0].startswith('detections: 1 of 3 tags left out: seen twice, hamming above')
    assert texts[1] == 'detections: 1 of 2 tags left out: not in the map 77'
    with pytest.raises(ObservationError, match='tag 77 is not in the tag map'):
        validate(found, strict=True)


@pytest.mark.parametrize('of_tags', [True, False])
def test_landmarks_that_are_those_of_tags_are_called_so(of_tags: bool) -> None:
    """Of the detector of this package, whose landmarks are a map of tags, corners and middles."""
    landmarks = TAGS.landmarks()
    if not of_tags:  # a board has no middles of tags
        landmarks = Landmarks(landmarks.ids[:12], landmarks.points[:12])
    message = messages.landmarks_message(landmarks, 0, 'map')
    known = read_landmarks(message)
    assert known.of_tags == of_tags
    check = SetValidation(['image_points'], [], lambda *_: None, lambda *_: None)
    seen = ImagePoints(np.array([17, 18, 27]), np.zeros((3, 2)), 'cam')
    items, texts = check.check({'image_points': seen}, known, LocalizerSettings(), 1)
    used = items['image_points']
    assert used.landmark.tolist() == [17, 18]
    if of_tags:
        assert used.tag is not None and used.tag.tolist() == [4, 4]
        assert texts == ['image_points: 1 of 2 tags left out: not in the map 6']
    else:
        assert used.tag is None and 'unknown landmarks 27' in texts[0]


def test_of_a_rig_one_camera_may_see_no_tag_of_the_map() -> None:
    empty = SimpleNamespace(header=SimpleNamespace(frame_id='cam'), detections=[])
    topics = ['a/image_points', 'b/image_points']
    check = SetValidation(topics, [], lambda *_: None, lambda *_: None)
    none = read_apriltags(empty, may_be_empty=True)
    other, own = (read_apriltags(found_tags((tag, 0, 50.0))) for tag in (77, 4))
    landmarks = LandmarkSet(TAGS.landmarks(), 'map')
    for first in (none, other):
        items = dict(zip(topics, (first, own), strict=True))
        checked, _ = check.check(items, landmarks, LocalizerSettings(), 1)
        assert not len(checked['a/image_points'].landmark)
        assert checked['b/image_points'].xyz.shape == (4, 3)


def test_a_missing_package_is_named(
    graph: Callable[..., Graph], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for package in ('apriltag_msgs', 'vision_msgs'):
        monkeypatch.setitem(sys.modules, f'{package}.msg', None)
    write_tag_map(TAGS, tmp_path / 'tags.yaml')
    g = graph(f'tag_map:={tmp_path}/tags.yaml', 'lens:=fish180')
    with pytest.raises(ParameterError, match='apt install ros-jazzy-apriltag-msgs'):
        g.start(Localizer)
