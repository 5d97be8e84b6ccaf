"""What the nodes tell tf2: cameras, as estimated and as true, and the rig."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from helpers.graph import LATCHED, Graph

from diagnostic_msgs.msg import DiagnosticArray  # isort: skip
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped  # isort: skip
from sensor_msgs.msg import PointCloud2  # isort: skip
from visualization_msgs.msg import MarkerArray  # isort: skip

from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.io.decoding import (
    LANDMARKS,
    columns,
    read_pose,
    read_transform,
    stamp_of,
    unpack,
)
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.localizer import Localizer
from fisheye_svp_ros.nodes.stereo_calibrator import StereoCalibrator
from fisheye_svp_ros.nodes.stereo_depth import StereoDepth
from fisheye_svp_ros.nodes.synthetic_camera import SyntheticCamera
from fisheye_svp_ros.pose import Pose, identity


def edges(heard: list[Any]) -> dict[tuple[str, str], list[Any]]:
    """Return the transforms by parent and child."""
    found: dict[tuple[str, str], list[Any]] = {}
    for message in heard:
        for one in message.transforms:
            found.setdefault((one.header.frame_id, one.child_frame_id), []).append(one)
    return found


@pytest.fixture
def tf_message() -> Any:
    """Return the class of what is on /tf."""
    return pytest.importorskip('tf2_msgs.msg', reason='tf2_msgs is not installed').TFMessage


@pytest.mark.parametrize('kind', [Localizer, StereoCalibrator, SyntheticCamera])
def test_without_tf2_it_is_refused_at_the_start(
    kind: type, graph: Callable[..., Graph], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, 'tf2_msgs', None)
    monkeypatch.setitem(sys.modules, 'tf2_msgs.msg', None)
    g = graph('publish_tf:=true')
    with pytest.raises(ParameterError, match=r'tf2_msgs is not installed; .* publish_tf:=false'):
        g.start(kind)


def test_the_camera_as_estimated_and_as_true(graph: Callable[..., Graph], tf_message: Any) -> None:
    g = graph('publish_tf:=true', 'svp:=false', 'rate:=50.0', 'world_frame:=map')
    heard = g.hear(tf_message, '/tf')
    estimated = g.hear(PoseWithCovarianceStamped, 'localizer/pose')
    residuals = g.hear(PointCloud2, 'localizer/residuals')
    true = g.hear(PoseStamped, 'true_pose')
    markers = g.hear(MarkerArray, 'localizer/markers', LATCHED)
    g.start(Localizer)
    g.start(SyntheticCamera)
    both = {('map', 'camera_optical_frame'), ('map', 'camera_optical_frame_true')}
    g.until(lambda: set(edges(heard)) == both and residuals and markers)
    for edge, poses in zip(sorted(both), (estimated, true), strict=True):
        one = edges(heard)[edge][0]
        g.until(
            lambda one=one, poses=poses: any(p.header.stamp == one.header.stamp for p in poses)
        )
        pose = next(p for p in poses if p.header.stamp == one.header.stamp)
        told = read_pose(pose if edge[1].endswith('_true') else pose.pose, 'pose')
        assert np.array_equal(read_transform(one).position, told.position)
        assert pose.header.frame_id == 'map'
    assert residuals[0].header.frame_id == 'camera_optical_frame'
    assert markers[0].markers[0].header.frame_id == 'map'


def test_the_rig_and_its_points_resolve(graph: Callable[..., Graph], tf_message: Any) -> None:
    g = graph(
        'publish_tf:=true',
        'svp:=false',
        'rate:=20.0',
        'style:=vergent',
        'radius:=0.5',
        'poses_file:=calibration',
    )
    heard, static = g.hear(tf_message, '/tf'), g.hear(tf_message, '/tf_static', LATCHED)
    points = g.hear(PointCloud2, 'stereo_depth/points')
    landmarks = g.hear(PointCloud2, 'landmarks', LATCHED)
    for kind in (StereoCalibrator, StereoDepth, SyntheticCamera):
        g.start(kind)
    g.until(lambda: points and static and landmarks)
    right, left = 'right_camera_optical_frame', 'left_camera_optical_frame'
    assert set(edges(static)) == {(right, left)}
    assert set(edges(heard)) == {('world', f'{right}_true'), ('world', f'{left}_true')}
    cloud, stamp = points[0], stamp_of(points[0])
    assert cloud.header.frame_id == right

    def at(edge: tuple[str, str], message: list[Any]) -> Pose:
        return next(read_transform(one) for one in edges(message)[edge] if stamp_of(one) == stamp)

    true = 'world', f'{right}_true'
    g.until(lambda: any(stamp_of(one) == stamp for one in edges(heard)[true]))
    camera = at(true, heard)
    measured = unpack(cloud, LANDMARKS, 'points')
    known = unpack(landmarks[0], LANDMARKS, 'landmarks')
    world = columns(measured, 'xyz') @ camera.rotation.T + camera.position
    there = np.searchsorted(known['landmark'], measured['landmark'])
    assert world == pytest.approx(columns(known, 'xyz')[there], abs=1e-7)


def test_nobody_tells_tf2_unasked(graph: Callable[..., Graph]) -> None:
    g = graph('svp:=false', 'rate:=50.0', 'localizer:camera_frame:=shifted')
    residuals = g.hear(PointCloud2, 'localizer/residuals')
    g.start(Localizer)
    g.start(SyntheticCamera)
    g.until(lambda: residuals)
    assert residuals[0].header.frame_id == 'shifted'
    assert not g.probe.count_publishers('/tf')


def test_a_frame_without_a_name_is_no_transform(
    graph: Callable[..., Graph], tf_message: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    g = graph('publish_tf:=true', 'svp:=false', 'rate:=50.0', "world_frame:=''")
    heard, poses = g.hear(tf_message, '/tf'), g.hear(PoseWithCovarianceStamped, 'localizer/pose')
    g.start(Localizer)
    g.start(SyntheticCamera)
    g.until(lambda: len(poses) > 2)
    assert not heard and "frame_id '' cannot be the parent" in capfd.readouterr().err


@pytest.mark.parametrize(
    ('words', 'given', 'frames'),
    [
        ((), (), ('left_camera_optical_frame', 'right_camera_optical_frame')),
        (
            ('__ns:=/front/low',),
            (),
            ('front_low_left_camera_optical_frame', 'front_low_right_camera_optical_frame'),
        ),
        (('__ns:=/front',), ('camera_frame:=cam',), ('left_cam', 'right_cam')),
    ],
)
def test_frames_follow_the_namespace_unless_they_are_named(
    ros_domain: int, words: tuple[str, ...], given: tuple[str, ...], frames: tuple[str, str]
) -> None:
    g = Graph(
        *(w for one in words for w in ('-r', one)),
        *(w for one in ('style:=parallel', *given) for w in ('-p', one)),
    )
    try:
        node = g.start(SyntheticCamera)
        assert tuple(node.camera(name).frame for name in ('left', 'right')) == frames
    finally:
        g.close()


def test_a_frame_that_another_node_tells_of_is_said(
    graph: Callable[..., Graph], tf_message: Any
) -> None:
    g = graph('publish_tf:=true', 'svp:=false', 'rate:=50.0')
    reports = g.hear(DiagnosticArray, '/diagnostics')
    g.start(SyntheticCamera)
    g.start(Localizer)
    other = g.tell(tf_message, '/tf')
    g.idle(0.5)
    assert not any('another node' in m.status[0].message for m in reports)
    transform = messages.transform_message(identity(), 5, 'base_link', 'camera_optical_frame')

    def said() -> Any:
        other.publish(tf_message(transforms=[transform]))
        return next(
            (
                m
                for m in reports
                if "/tf: another node also publishes 'camera_optical_"
                "frame', with parent 'base_link'" in m.status[0].message
            ),
            None,
        )

    assert g.until(said).status[0].name == '/localizer: inputs'
