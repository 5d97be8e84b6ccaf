"""What a robot does with the pose: map -> odom as amcl has it, transforms that are missing."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from helpers.graph import LATCHED, FedLocalizer, Graph
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.time import Time

from geometry_msgs.msg import PoseWithCovarianceStamped  # isort: skip

from fisheye_svp_ros.io.decoding import read_pose, read_transform, stamp_of
from fisheye_svp_ros.io.landmark_files import environment
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.transforms import FrameTree
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.pose import Pose, identity, rotation_from_vector
from fisheye_svp_ros.scene.rigs import paper_pose

NS = 10**9
START = 1000 * NS
LENS = load_lens(lens_path('fish214'))
OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def turned(angle: float, x: float = 0.0) -> Pose:
    """Return a pose on the ground, (1,) removed: a turn about z, rad, and a way along x, m."""
    return Pose(rotation_from_vector(np.array([0.0, 0.0, angle])), np.array([x, 0.0, 0.0]))


def test_an_older_stamp_is_put_in_its_place_and_a_restart_is_not() -> None:
    tree = FrameTree()
    for stamp in (1, 3, 2):
        later = tree.add('odom', 'base', turned(0.0, stamp), stamp * NS // 10)
    assert later
    half = tree.find('odom', 'base', 3 * NS // 20)
    assert half is not None and half.position[0] == pytest.approx(1.5)
    tree.add('odom', 'base', turned(0.0), 100 * NS)
    assert not tree.add('odom', 'base', turned(0.0), NS)
    assert tree.latest('odom', 'base') == NS


def test_the_same_stamp_is_told_only_where_the_pose_is_another() -> None:
    tree = FrameTree()
    tree.add('odom', 'base', turned(0.1), NS)
    assert not tree.add('odom', 'base', turned(0.1), NS)
    assert tree.add('odom', 'base', turned(0.2), NS)


class Robot(FedLocalizer):
    """A localizer on a robot whose base stands still in the map, and what moves around it."""

    def __init__(self, g: Graph, mount: Pose | None = None, static: bool = True) -> None:
        self.kind = pytest.importorskip('tf2_msgs.msg', reason='no tf2_msgs').TFMessage
        self.bases = g.hear(PoseWithCovarianceStamped, 'localizer/base_pose')
        self.transforms = g.hear(self.kind, '/tf')
        super().__init__(g)
        self.camera = paper_pose()
        self.tf, self.static = g.tell(self.kind, '/tf'), g.tell(self.kind, '/tf_static', LATCHED)
        self.mount = identity() if mount is None else mount
        if static:
            self.send('base_link', 'camera', self.mount, 0, self.static)

    def send(self, parent: str, child: str, pose: Pose, stamp: int, publisher: Any = None) -> None:
        """Publish a transform."""
        one = messages.transform_message(pose, stamp, parent, child)
        (publisher or self.tf).publish(self.kind(transforms=[one]))

    def drive(self, seconds: float, first: float = 0.0, step: float = 0.02) -> None:
        """Publish odometry of a base that stands still."""
        for t in np.arange(first, first + seconds, step):
            self.send('odom', 'base_link', identity(), START + round(NS * float(t)))

    def see(self, t: float) -> Any:
        """Publish what the camera sees t seconds after the start; return the result."""
        points = environment('whole', 2.0)
        image = project(LENS, self.camera.into_body(points.points))
        stamp = START + round(NS * t)
        self.feed(stamp, points.ids[image.valid], image.uv[image.valid], 'camera')
        return self.status(stamp)

    def sent(self) -> list[Any]:
        """Return the transforms map -> odom so far."""
        return [
            one for m in self.transforms for one in m.transforms if one.child_frame_id == 'odom'
        ]

    def says(self, text: str) -> Any:
        """Return the report with a text, once it is there."""
        return self.graph.until(
            lambda: next((m for m in self.reports if text in m.status[0].message), None)
        )


@pytest.fixture
def robot(ros_domain: int) -> Iterator[Callable[..., Robot]]:
    graphs: list[Graph] = []

    def start(*parameters: str, **options: Any) -> Robot:
        given = ('lens:=fish214', 'sigma_px:=0.2', 'patience:=0.5', 'base_frame:=base_link')
        words = [word for one in (*given, *parameters) for word in ('-p', one)]
        graphs.append(Graph(*words))
        return Robot(graphs[-1], **options)

    yield start
    for one in graphs:
        one.close()


def test_map_to_odom_is_dated_ahead_and_sent_again_while_nothing_is_seen(
    robot: Callable[..., Robot],
) -> None:
    r = robot('odom_frame:=odom')
    r.drive(0.3)
    r.see(0.1)
    r.see(0.2)
    first = r.graph.until(lambda: (found := r.sent()) and len(found) > 2 and found)
    stamps = [(stamp_of(one) - START) / NS for one in first[:3]]
    assert stamps == pytest.approx([0.1, 1.1, 1.2], abs=1e-6)
    there = read_transform(first[0])
    assert there.position == pytest.approx(r.camera.position, abs=1e-3)
    for t in np.arange(0.3, 4.0, 0.25):  # odometry goes on, no tag is in view
        r.drive(0.25, float(t))
        r.graph.until(lambda t=t: stamp_of(r.sent()[-1]) > START + NS * (t + 0.3))
    ahead = np.diff([stamp_of(one) for one in r.sent()])
    assert (ahead > 0).all(), 'tf2 takes no older stamp without a word'
    assert read_transform(r.sent()[-1]).position == pytest.approx(there.position, abs=1e-9)


def test_tf2_answers_for_now_while_nothing_is_seen(robot: Callable[..., Robot]) -> None:
    """As Nav2 asks: where the base was 20 ms before the latest odometry."""
    tf2 = pytest.importorskip('tf2_py', reason='tf2 is not installed (ros-jazzy-tf2-py)')
    r, answered = robot('odom_frame:=odom'), 0
    buffer = tf2.BufferCore(Duration(seconds=30))
    r.drive(0.3)
    r.see(0.1)
    for t in np.arange(0.3, 5.0, 0.25):
        r.drive(0.25, float(t))
        now = START + round(NS * (t + 0.24))
        r.graph.until(lambda now=now: (sent := r.sent()) and stamp_of(sent[-1]) >= now)
        for stamp in (START, now):
            one = messages.transform_message(identity(), stamp, 'odom', 'base_link')
            buffer.set_transform(one, 'odometry')
        for one in r.sent():
            buffer.set_transform(one, 'localizer')
        world = r.sent()[0].header.frame_id
        buffer.lookup_transform_core(world, 'base_link', Time(nanoseconds=now - NS // 50))
        answered += 1
    assert answered == 19


def test_the_tolerance_is_a_parameter(robot: Callable[..., Robot]) -> None:
    r = robot('odom_frame:=odom', 'transform_tolerance:=0.2')
    r.drive(0.3)
    r.see(0.1)
    r.graph.until(lambda: len(r.sent()) > 1)
    assert [(stamp_of(one) - START) / NS for one in r.sent()[:2]] == pytest.approx([0.1, 0.3])


def test_a_gap_in_the_odometry_is_not_interpolated(robot: Callable[..., Robot]) -> None:
    r = robot('odom_frame:=odom', 'transform_tolerance:=0.0')
    r.drive(0.2)
    r.see(0.1)
    r.graph.until(r.sent)
    r.drive(0.2, 2.2)
    status = r.see(1.0)
    assert "'base_link' in 'odom' has a gap of 2.0" in status.message
    assert 'transform_gap (0.25 s); /tf is published by probe' in status.message
    r.see(2.3)
    r.graph.until(lambda: stamp_of(r.sent()[-1]) >= START + 2.3 * NS)
    assert not [one for one in r.sent() if 0.2 < (stamp_of(one) - START) / NS < 2.2]
    assert len(r.bases) == 3, 'the base itself needs no odometry'


def test_two_publishers_of_odometry_are_named(robot: Callable[..., Robot]) -> None:
    r = robot('odom_frame:=odom', 'transform_tolerance:=0.0')
    other = r.graph.add(Node('second_odometry'))
    second = other.create_publisher(r.kind, '/tf', 100)
    try:
        r.graph.until(lambda: second.get_subscription_count() > 0)
        for k in range(20):  # the second comes 30 ms late
            stamp = START + k * NS // 50
            r.send('odom', 'base_link', identity(), stamp)
            r.send('odom', 'base_link', identity(), stamp - 3 * NS // 100, second)
            if k % 4 == 3:
                r.see((k - 2) / 50)
        r.graph.until(lambda: len(r.sent()) >= 5)
        text = r.says("'base_link' in 'odom' comes twice").status[0].message
        assert '/tf is published by probe, second_odometry' in text
    finally:
        r.graph.executor.remove_node(other)
        other.destroy_node()


def test_of_another_map_to_odom_the_right_parameter_is_named(
    robot: Callable[..., Robot],
) -> None:
    r = robot('odom_frame:=odom')
    r.drive(0.3)
    r.see(0.1)
    r.graph.until(r.sent)
    r.send('map', 'odom', turned(0.3), START)
    text = r.says("another node also publishes 'odom'").status[0].message
    assert 'leave odom_frame out here, or set tf_broadcast:=false in amcl' in text
    assert 'camera_frame' not in text and 'published by probe' in text


def test_odometry_is_read_before_a_set_is_solved(
    robot: Callable[..., Robot], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr('fisheye_svp_ros.nodes.solver._LONGEST_INTAKE', 10.0)
    r = robot('odom_frame:=odom')
    r.drive(0.1)
    r.see(0.05)
    r.drive(4.0, 0.1)  # 200 messages at once
    r.see(4.09)
    assert r.node._base._frames.tree.latest('odom', 'base_link') >= START + 4.07 * NS


def test_late_odometry_is_told_with_its_seconds(
    robot: Callable[..., Robot], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr('fisheye_svp_ros.nodes.base_pose._LONGEST_WAIT', 0.2)
    r = robot('odom_frame:=odom')
    r.drive(0.1)
    for k in range(30):
        r.see(0.58 + k / 1000)
    text = r.says('no transform to').status[0].message
    assert "'base_link' in 'odom' on /tf ends 0.5" in text and 'before the image' in text


@pytest.mark.parametrize('parameters', [(), ('odom_frame:=odom',)])
def test_a_mount_may_move(parameters: tuple[str, ...], robot: Callable[..., Robot]) -> None:
    r = robot(*parameters, static=False)
    r.send('base_link', 'mast', turned(0.0, 0.1), 0, r.static)
    r.graph.until(lambda: len(r.node._base._frames.tree.chain('base_link', 'mast')[1]) > 1)
    r.drive(0.3)
    for k in range(6):
        r.send('mast', 'camera', turned(0.1 * k), START + k * NS // 50)
    tree = r.node._base._frames.tree
    r.graph.until(lambda: tree.latest('base_link', 'camera') == START + NS // 10)
    base = turned(0.3, 1.0)

    def see(t: float) -> None:
        r.camera = base.compose(turned(0.0, 0.1)).compose(turned(5.0 * t))
        r.see(t)

    see(0.03)  # between two transforms
    seen = r.graph.until(lambda: r.bases and r.bases[0])
    assert read_pose(seen.pose, 'pose').position == pytest.approx(base.position, abs=1e-3)
    see(0.11)  # the transform of its time is not there yet
    r.graph.idle(0.2)
    assert len(r.bases) == 1
    r.send('mast', 'camera', turned(0.6), START + 6 * NS // 50)
    r.graph.until(lambda: len(r.bases) == 2)


def test_a_camera_frame_that_is_not_optical_is_told(robot: Callable[..., Robot]) -> None:
    ahead = Pose(OPTICAL, np.array([0.2, 0.0, 0.5]))
    r = robot(mount=ahead)
    standing = Pose(rotation_from_vector(np.array([0.0, 0.0, 0.4])), np.array([0.1, 0.2, -1.0]))
    r.camera = standing.compose(ahead)
    assert 'REP 103' not in r.see(1.0).message
    r.send('base_link', 'camera', Pose(np.eye(3), ahead.position), 0, r.static)
    for k in range(2, 20):
        message = r.see(float(k)).message
        if 'REP 103' in message:
            break
    assert "'base_link' lies 90 deg on its side" in message and "frame_id 'camera'" in message
