"""The pose of a robot's base: composed with the mount, covariance carried along, map -> odom."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from helpers.graph import LATCHED, Graph

from diagnostic_msgs.msg import DiagnosticArray  # isort: skip
from geometry_msgs.msg import PoseWithCovarianceStamped  # isort: skip

from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.io.decoding import read_pose, read_transform, stamp_of
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.localizer import Localizer
from fisheye_svp_ros.nodes.synthetic_camera import SyntheticCamera
from fisheye_svp_ros.nodes.transforms import FrameTree
from fisheye_svp_ros.pose import Pose, carried_pose, identity, rotation_from_vector

MOUNT = Pose(rotation_from_vector(np.array([0.3, -0.5, 0.2])), np.array([0.2, -0.1, 0.6]))
TILT = Pose(rotation_from_vector(np.array([0.1, 0.4, -1.0])), np.array([1.0, 2.0, 0.5]))
NS = 10**9


@pytest.fixture
def tf_message() -> Any:
    """Return the class of what is on /tf."""
    return pytest.importorskip('tf2_msgs.msg', reason='tf2_msgs is not installed').TFMessage


def test_the_covariance_is_that_of_sampled_bases() -> None:
    rng = np.random.default_rng(0)
    root = 1e-3 * rng.normal(size=(6, 6))
    carried, covariance = carried_pose(TILT, root @ root.T, MOUNT)
    drawn = rng.normal(size=(20_000, 6)) @ root.T
    bases = TILT.broadcast_to(len(drawn)).retract(drawn).compose(MOUNT.broadcast_to(len(drawn)))
    sampled = np.cov(bases.difference(carried.broadcast_to(len(drawn))).T)
    scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    assert np.abs(sampled - covariance).max() < 0.03 * scale.max()
    assert np.abs((sampled - covariance) / scale).max() < 0.05


def test_frames_are_found_through_the_tree_and_between_stamps() -> None:
    tree = FrameTree()
    tree.add('base', 'mast', MOUNT, None)
    tree.add('mast', 'camera', TILT, None)
    found = tree.find('camera', 'base', 0)
    assert found is not None
    expected = MOUNT.compose(TILT).inverse()
    assert np.allclose(found.position, expected.position)
    assert tree.find('base', 'nowhere', 0) is None
    tree.add('odom', 'base', identity(), 1 * NS)
    moved = Pose(rotation_from_vector(np.array([0, 0, 0.4])), np.array([1.0, 0, 0]))
    tree.add('odom', 'base', moved, 2 * NS)
    half = tree.find('odom', 'base', 3 * NS // 2)
    assert half is not None and np.allclose(half.position, [0.5, 0, 0])
    assert np.allclose(half.rotation, rotation_from_vector(np.array([0, 0, 0.2])))
    assert tree.find('odom', 'camera', 5 * NS // 2) is None  # not yet there


@pytest.mark.parametrize(
    ('parameters', 'reason'),
    [
        (('odom_frame:=odom',), 'odom_frame is .odom. without base_frame'),
        (('base_frame:=base_link', 'publish_tf:=true'), 'two parents'),
    ],
)
def test_frames_that_cannot_belong_together_are_refused(
    graph: Callable[..., Graph], parameters: tuple[str, ...], reason: str, tf_message: Any
) -> None:
    with pytest.raises(ParameterError, match=reason):
        graph(*parameters).start(Localizer)


def test_without_tf2_it_is_refused_at_the_start(
    graph: Callable[..., Graph], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, 'tf2_msgs', None)
    monkeypatch.setitem(sys.modules, 'tf2_msgs.msg', None)
    with pytest.raises(ParameterError, match='base_frame: tf2_msgs is not installed'):
        graph('base_frame:=base_link').start(Localizer)


def test_base_pose_and_odometry_are_published(
    graph: Callable[..., Graph], tf_message: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    g = graph(
        'svp:=false',
        'rate:=20.0',
        'world_frame:=map',
        'base_frame:=base_link',
        'odom_frame:=odom',
    )
    poses = g.hear(PoseWithCovarianceStamped, 'localizer/pose')
    bases = g.hear(PoseWithCovarianceStamped, 'localizer/base_pose')
    heard = g.hear(tf_message, '/tf')
    g.start(Localizer)
    g.start(SyntheticCamera)
    g.until(lambda: len(poses) > 2)
    assert not bases
    assert (
        "has a chain from 'base_link' (base_frame) to 'camera_optical_frame'"
        in capfd.readouterr().err
    )
    mount = messages.transform_message(MOUNT, 0, 'base_link', 'camera_optical_frame')
    g.tell(tf_message, '/tf_static', LATCHED).publish(tf_message(transforms=[mount]))
    g.until(lambda: bases)
    base = bases[0]
    pose = next(one for one in poses if stamp_of(one) == stamp_of(base))
    expected, covariance = carried_pose(
        read_pose(pose.pose, 'pose'), np.reshape(pose.pose.covariance, (6, 6)), MOUNT.inverse()
    )
    assert base.header.frame_id == 'map'
    assert read_pose(base.pose, 'pose').position == pytest.approx(expected.position)
    assert np.reshape(base.pose.covariance, (6, 6)) == pytest.approx(covariance)
    odometry = g.tell(tf_message, '/tf')
    for stamp in range(stamp_of(base) - NS, stamp_of(base) + 60 * NS, NS // 5):
        one = messages.transform_message(TILT, stamp, 'odom', 'base_link')
        odometry.publish(tf_message(transforms=[one]))

    def odom() -> Any:
        return next(
            (one for m in heard for one in m.transforms if one.child_frame_id == 'odom'), None
        )

    one = g.until(odom)
    assert one.header.frame_id == 'map'
    base = next(b for b in bases if stamp_of(b) == stamp_of(one))
    there = read_transform(one).compose(TILT)
    assert there.position == pytest.approx(read_pose(base.pose, 'pose').position)


def test_odometry_that_does_not_come_is_told_soon(
    graph: Callable[..., Graph], tf_message: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr('fisheye_svp_ros.nodes.base_pose._LONGEST_WAIT', 0.3)
    frames = ('world_frame:=map', 'base_frame:=base_link', 'odom_frame:=odom')
    g = graph('svp:=false', 'rate:=5.0', *frames)
    bases = g.hear(PoseWithCovarianceStamped, 'localizer/base_pose')
    reports = g.hear(DiagnosticArray, '/diagnostics')
    g.start(Localizer)
    mount = messages.transform_message(MOUNT, 0, 'base_link', 'camera_optical_frame')
    g.tell(tf_message, '/tf_static', LATCHED).publish(tf_message(transforms=[mount]))
    g.start(SyntheticCamera)
    g.until(lambda: any("no transform to 'odom'" in one.status[0].message for one in reports))
    assert len(bases) < 30, 'not only when thirty poses wait'
