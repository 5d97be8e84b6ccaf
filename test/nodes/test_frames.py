"""Frames of the inputs of a set: what cannot belong together is refused with both names."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from helpers.graph import LATCHED, FedLocalizer, Graph

from diagnostic_msgs.msg import DiagnosticArray  # isort: skip
from geometry_msgs.msg import PoseStamped  # isort: skip
from geometry_msgs.msg import TransformStamped  # isort: skip
from sensor_msgs.msg import CameraInfo, PointCloud2  # isort: skip

from fisheye_svp_ros.io.decoding import read_key_values
from fisheye_svp_ros.io.landmark_files import environment
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.stereo_depth import StereoDepth
from fisheye_svp_ros.optics.curves import kannala_brandt_equivalent
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.scene.rigs import paper_pose
from fisheye_svp_ros.simulate.scenario import Scenario, simulate_scenario

SEEN = simulate_scenario(Scenario(shift_scale=0.0)).observations
SOLVING = ('lens:=fish214', 'svp:=true')


class Framed(FedLocalizer):
    """A localizer, and inputs of different frames."""

    def tell(self, stamp: int, frame: str) -> None:
        self.feed(stamp, SEEN.landmark, SEEN.uv, frame)


@pytest.mark.parametrize('frame', ['odom', 'map', '/map', ''])
def test_a_true_pose_of_another_frame_gives_no_error(
    graph: Callable[..., Graph], frame: str
) -> None:
    told = Framed(graph(*SOLVING))
    truth = told.graph.tell(PoseStamped, 'true_pose')
    truth.publish(messages.pose_message(paper_pose(), 1, frame))
    told.tell(1, 'camera')
    status = told.status(1)
    errors = [pair.key for pair in status.values if pair.key == 'position_error_m']
    if frame != 'odom':
        assert errors and status.level == status.OK
        return
    assert not errors and status.level == status.WARN
    assert "true_pose: left out: in frame 'odom', but landmarks in 'map'" in status.message
    counts = read_key_values(
        told.graph.until(
            lambda: next((m for m in told.reports if "'odom'" in m.status[0].message), None)
        )
    )
    assert counts['true_pose: in another frame'] == '1' and counts['true_pose: dropped'] == '0'


def test_a_true_pose_is_transformed_where_tf_knows_how(graph: Callable[..., Graph]) -> None:
    told = Framed(graph(*SOLVING))
    there = Pose(rotation_from_vector(np.array([0.1, 0.2, 0.7])), np.array([4.0, -2.0, 0.5]))
    told.node._listener.tree.add('map', 'odom', there, None)
    truth = told.graph.tell(PoseStamped, 'true_pose')
    truth.publish(messages.pose_message(there.inverse().compose(paper_pose()), 1, 'odom'))
    told.tell(1, 'camera')
    status = told.status(1)
    errors = {pair.key: pair.value for pair in status.values}
    assert status.level == status.OK and float(errors['position_error_m']) < 1e-6


def test_what_tf_tells_is_heard_once_frames_differ(graph: Callable[..., Graph]) -> None:
    kind = pytest.importorskip('tf2_msgs.msg', reason='tf2_msgs is not installed').TFMessage
    told = Framed(graph(*SOLVING))
    truth = told.graph.tell(PoseStamped, 'true_pose')
    stamps = iter(range(1, 1000))

    def errors() -> dict[str, str]:
        stamp = next(stamps)
        truth.publish(messages.pose_message(paper_pose(), stamp, 'odom'))
        told.tell(stamp, 'camera')
        return {pair.key: pair.value for pair in told.status(stamp).values}

    assert 'position_error_m' not in errors()
    one = messages.transform_message(Pose(np.eye(3), np.zeros(3)), 0, 'map', 'odom')
    told.graph.tell(kind, '/tf_static', LATCHED).publish(kind(transforms=[one]))
    told.graph.until(lambda: 'position_error_m' in errors())


def test_true_poses_of_different_frames_are_not_interpolated(graph: Callable[..., Graph]) -> None:
    told = Framed(graph(*SOLVING))
    truth = told.graph.tell(PoseStamped, 'true_pose')
    for stamp, frame in ((10, 'map'), (30, 'odom')):
        truth.publish(messages.pose_message(paper_pose(), stamp, frame))
    told.tell(20, 'camera')
    assert 'position_error_m' not in [pair.key for pair in told.status(20).values]
    told.graph.until(
        lambda: any(
            "in frame 'map', but true_pose in 'odom'" in m.status[0].message for m in told.reports
        )
    )


def test_camera_info_of_another_camera_is_refused(graph: Callable[..., Graph]) -> None:
    told = Framed(graph('lens:=camera_info', 'patience:=0.2'))
    info = told.graph.tell(CameraInfo, 'camera_info', LATCHED)
    lens = kannala_brandt_equivalent(load_lens(lens_path('fish214')).svp())
    info.publish(messages.camera_info_message(lens, 1, 'right_cam'))
    told.tell(1, 'left_cam')
    status = told.status(1)
    assert not status.values and not told.poses
    assert "of 'right_cam', but the image points are of 'left_cam'" in status.message
    info.publish(messages.camera_info_message(lens, 2, 'left_cam'))
    told.tell(2, 'left_cam')
    assert told.status(2).values


def test_two_cameras_on_one_topic_are_told_and_one_is_solved(
    graph: Callable[..., Graph], monkeypatch: pytest.MonkeyPatch
) -> None:
    told = Framed(graph(*SOLVING))
    for stamp in range(1, 9):
        told.tell(stamp, 'front' if stamp % 2 else 'rear')
        status = told.status(stamp)
        assert bool(status.values) == bool(stamp % 2)
        if not stamp % 2:
            assert "image_points: from 'rear', but 'front' before" in status.message
    monkeypatch.setattr('fisheye_svp_ros.nodes.validation._FRAME_HOLDS', 0.0)
    told.tell(10, 'rear')  # the other one has ended
    assert told.status(10).values


def test_a_rig_of_exchanged_cameras_is_refused(graph: Callable[..., Graph]) -> None:
    g = graph('rig:=topic', *SOLVING, 'patience:=0.2')
    results = g.hear(DiagnosticArray, 'stereo_depth/result')
    g.start(StereoDepth)
    rig = g.tell(TransformStamped, 'rig', LATCHED)
    landmarks = g.tell(PointCloud2, 'landmarks', LATCHED)
    points = [g.tell(PointCloud2, f'{name}/image_points') for name in ('left', 'right')]
    landmarks.publish(messages.landmarks_message(environment('whole', 2.0), 0, 'map'))
    pose = Pose(np.eye(3), np.array([-0.15, 0.0, 0.0]))
    for stamp, (left, right) in enumerate((('l', 'r'), ('r', 'l')), start=1):
        rig.publish(messages.transform_message(pose, stamp, right, left))
        g.idle(0.2)
        for publisher, frame in zip(points, ('l', 'r'), strict=True):
            publisher.publish(messages.image_points_message(SEEN.landmark, SEEN.uv, stamp, frame))
        g.until(lambda n=stamp: len(results) == n)
    first, second = (message.status[0] for message in results)
    assert first.values and not second.values
    assert "rig: of 'r' in 'l', but left and right image points are of 'l' and 'r'" in (
        second.message
    )
