"""What goes wrong in the first hour: nodes say what docs/reference/nodes.md says."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.graph import LATCHED, Graph, set_parameter
from helpers.nodes import ROOT
from helpers.photographs import BOARD, photograph, poses
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from diagnostic_msgs.msg import DiagnosticArray  # isort: skip
from geometry_msgs.msg import PoseStamped, TransformStamped  # isort: skip
from sensor_msgs.msg import CameraInfo, Image, PointCloud2  # isort: skip
from std_msgs.msg import String  # isort: skip

from fisheye_svp_ros.io.landmark_files import environment
from fisheye_svp_ros.io.lens_files import load_lens, save_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.detector import Detector
from fisheye_svp_ros.nodes.localizer import Localizer
from fisheye_svp_ros.nodes.measured_camera import MeasuredCamera
from fisheye_svp_ros.nodes.stereo_depth import StereoDepth
from fisheye_svp_ros.nodes.subscriptions import Input
from fisheye_svp_ros.pose import Pose, identity
from fisheye_svp_ros.simulate.scenario import Scenario, simulate_scenario

SENSOR = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
MS = 10**6
SOLVING = ('lens:=fish214', 'svp:=true', 'patience:=0.2')


def rows_of_the_table() -> dict[str, str]:
    """Return what a node says, as a pattern, by symptom."""
    text = (ROOT / 'docs' / 'reference' / 'nodes.md').read_text(encoding='utf-8')
    table = text.partition('<!-- first hour -->')[2].partition('<!-- end -->')[0]
    rows = [
        [cell.strip() for cell in line.strip('| ').split(' | ')]
        for line in table.strip().splitlines()[2:]
    ]
    assert all(len(row) == 3 for row in rows)
    return {symptom: re.escape(told.strip('`')).replace('…', '.+') for symptom, told, _ in rows}


TABLE = rows_of_the_table()
TRIED: dict[str, Callable[..., None]] = {}


def tries(symptom: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Register what brings a symptom about."""

    def register(test: Callable[..., None]) -> Callable[..., None]:
        TRIED[symptom] = test
        return test

    return register


class Hour:
    """A graph in which something is wrong, and what its nodes say of it."""

    def __init__(self, graph: Callable[..., Graph], capfd: pytest.CaptureFixture[str]) -> None:
        self.start, self._capfd = graph, capfd
        self.graph: Graph

    def begin(self, *parameters: str) -> Graph:
        self.graph = self.start(*parameters)
        self.reports = self.graph.hear(DiagnosticArray, '/diagnostics')
        return self.graph

    def says(self, pattern: str, act: Callable[[], object] = lambda: None) -> None:
        """Assert that /diagnostics warns so while something is done again and again."""

        def told() -> bool:
            act()
            return any(
                re.search(pattern, status.message) and status.level == status.WARN
                for report in self.reports
                for status in report.status
            )

        try:
            self.graph.until(told)
        except AssertionError:
            texts = {status.message for report in self.reports for status in report.status}
            pytest.fail(f'{pattern!r} is not in {texts}')

    def logs(self, pattern: str) -> None:
        """Assert that the log says so, sooner or later."""
        said = ''

        def told() -> bool:
            nonlocal said
            said += self._capfd.readouterr().err
            return re.search(pattern, said) is not None

        self.graph.until(told)


@pytest.fixture
def hour(
    graph: Callable[..., Graph], capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Hour:
    monkeypatch.setattr('fisheye_svp_ros.nodes.base.LIMIT', 0.5)
    monkeypatch.delenv('FASTRTPS_DEFAULT_PROFILES_FILE', raising=False)
    monkeypatch.setattr('fisheye_svp_ros.nodes.detector._MIN_FAILURES', 3)
    return Hour(graph, capfd)


ZOOMED = ('lens:=fish214', 'svp:=true', 'patience:=0.1', 'sigma_px:=0.1')


def image_points(stamp: int = 7, ids: Any = None, zoom: float = 1.0) -> Any:
    seen = simulate_scenario(Scenario(shift_scale=0.0)).observations
    middle = seen.uv.mean(axis=0)
    return messages.image_points_message(
        seen.landmark if ids is None else ids, middle + zoom * (seen.uv - middle), stamp, 'camera'
    )


def landmarks(stamp: int = 0, radius: float = 2.0) -> Any:
    return messages.landmarks_message(environment('whole', radius), stamp, 'world')


@tries('No messages: wrong topic name')
def another_name(hour: Hour, pattern: str) -> None:
    g = hour.begin(f'board:={BOARD}')
    g.probe.create_publisher(Image, '/camera/image_raw', SENSOR)
    g.start(Detector)
    hour.says(pattern)
    hour.logs(pattern)


@tries('No messages: no publisher')
def nobody(hour: Hour, pattern: str) -> None:
    g = hour.begin(*SOLVING)
    g.start(Localizer)
    hour.says(pattern)
    hour.logs('no message on /image_points: it has no publisher')


@tries('No messages: wrong topic type')
def another_type(hour: Hour, pattern: str) -> None:
    g = hour.begin(*SOLVING)
    context = Context()  # one process cannot have two types on one topic
    context.init(domain_id=int(os.environ['ROS_DOMAIN_ID']))
    stranger = Node('stranger', context=context)
    stranger.create_publisher(String, '/image_points', 1)
    g.start(Localizer)
    hour.says(pattern)
    stranger.destroy_node()
    context.shutdown()


@tries('No messages: a QoS override')
def another_qos(hour: Hour, pattern: str) -> None:
    g = hour.begin(*SOLVING, 'qos_overrides./image_points.subscription.reliability:=reliable')
    driver = g.probe.create_publisher(PointCloud2, '/image_points', SENSOR)
    g.start(Localizer)
    hour.says(pattern, lambda: driver.publish(image_points()))


@tries('No messages: large images are lost')
def large_images(hour: Hour, pattern: str) -> None:
    g = hour.begin(f'board:={BOARD}')
    g.probe.create_publisher(Image, '/image', SENSOR)
    g.start(Detector)
    hour.says(pattern)


@tries('Some messages are lost: large images, best effort')
def lost_images(hour: Hour, pattern: str) -> None:
    g = hour.begin(f'board:={BOARD}')
    images = g.probe.create_publisher(Image, '/image', SENSOR)
    g.start(Detector)
    blank = messages.image_message(np.zeros((16, 16), np.uint8), 7, 'camera')
    hour.says(pattern, lambda: [images.publish(blank) for _ in range(30)])


@tries('No messages: landmarks were sent before the node started')
def volatile_landmarks(hour: Hour, pattern: str) -> None:
    g = hour.begin(*SOLVING)
    g.probe.create_publisher(PointCloud2, '/landmarks', 1).publish(landmarks())
    g.start(Localizer)
    hour.says(pattern)


@tries('No results: a managed node is not active')
def inactive(hour: Hour, pattern: str) -> None:
    hour.begin(*SOLVING, 'lifecycle:=true').start(Localizer)
    hour.says(pattern)


@tries('Messages stop: the publisher has no input, or has ended')
def data_stop(hour: Hour, pattern: str) -> None:
    g = hour.begin(*SOLVING)
    g.start(Localizer)
    points = g.tell(PointCloud2, 'image_points')
    points.publish(image_points())
    hour.says(pattern)


@tries('No errors: the stamps of true poses are far from those of the sets')
def far_poses(hour: Hour, pattern: str) -> None:
    g = hour.begin(*SOLVING)
    g.start(Localizer)
    told, points = g.tell(PointCloud2, 'landmarks', LATCHED), g.tell(PointCloud2, 'image_points')
    truth = g.tell(PoseStamped, 'true_pose')
    told.publish(landmarks())
    for stamp in (800, 1200):
        truth.publish(messages.pose_message(identity(), stamp * MS, 'world'))
    hour.says(pattern, lambda: points.publish(image_points(1000 * MS)))


@tries('No results of a rig: the stamps of its cameras differ')
def stereo_stamps(hour: Hour, pattern: str) -> None:
    g = hour.begin(*SOLVING)
    g.start(StereoDepth)
    left, right = (g.tell(PointCloud2, f'{name}/image_points') for name in ('left', 'right'))
    hour.says(
        pattern,
        lambda: (left.publish(image_points(1000 * MS)), right.publish(image_points(1001 * MS))),
    )


@tries('All sets fail: landmarks and image points have other ids')
def other_ids(hour: Hour, pattern: str) -> None:
    g = hour.begin(*SOLVING)
    g.start(Localizer)
    told, points = g.tell(PointCloud2, 'landmarks', LATCHED), g.tell(PointCloud2, 'image_points')
    told.publish(landmarks())
    ids = np.arange(len(image_points().data) // 20) + 100
    hour.says(pattern, lambda: points.publish(image_points(ids=ids)))


@tries('All sets fail: no lens is named')
def no_lens(hour: Hour, pattern: str) -> None:
    g = hour.begin('patience:=0.1')
    g.start(Localizer)
    told, points = g.tell(PointCloud2, 'landmarks', LATCHED), g.tell(PointCloud2, 'image_points')
    told.publish(landmarks())
    hour.says(pattern, lambda: points.publish(image_points()))


@tries('All sets fail: the camera was never calibrated')
def not_calibrated(hour: Hour, pattern: str) -> None:
    g = hour.begin('lens:=camera_info', 'patience:=0.1')
    g.start(Localizer)
    told, points = g.tell(PointCloud2, 'landmarks', LATCHED), g.tell(PointCloud2, 'image_points')
    driver = g.tell(CameraInfo, 'camera_info', SENSOR)
    told.publish(landmarks())
    hour.says(
        pattern,
        lambda: (
            driver.publish(CameraInfo(width=640, height=480)),
            points.publish(image_points()),
        ),
    )


@tries('Some sets fail: landmarks are latched under the stamps of different sets')
def landmarks_of_one_set(hour: Hour, pattern: str) -> None:
    g = hour.begin(*SOLVING)
    g.start(Localizer)
    told, points = g.tell(PointCloud2, 'landmarks', LATCHED), g.tell(PointCloud2, 'image_points')
    for stamp in (1000, 2000):
        told.publish(landmarks(stamp * MS, stamp / 1000))
        points.publish(image_points(stamp * MS))
    hour.says(pattern, lambda: points.publish(image_points(3000 * MS)))


@tries('No board is found: depth images instead of photographs')
def depth_images(hour: Hour, pattern: str) -> None:
    g = hour.begin(f'board:={BOARD}')
    g.hear(PointCloud2, 'image_points')
    g.start(Detector)
    images = g.tell(Image, 'image', SENSOR)
    hour.says(
        pattern,
        lambda: images.publish(Image(height=1, width=1, encoding='32FC1', step=4, data=b'\0' * 4)),
    )


@tries('No board is found: `board` describes another one')
def another_board(hour: Hour, pattern: str) -> None:
    g = hour.begin('board:=chessboard:9x6:25mm')
    g.hear(PointCloud2, 'image_points')
    node = g.start(Detector)
    images = g.tell(Image, 'image', SENSOR)
    told = messages.image_message(photograph(poses(1, 4).take(0)), 7, 'camera')

    def publish() -> None:
        g.idle(0.1)  # what is not taken before the next comes would be told as lost
        images.publish(told)

    hour.says(pattern, publish)
    hour.logs(pattern)
    assert set_parameter(node, 'board', BOARD).successful
    hour.reports.clear()
    g.until(
        lambda: (
            publish(),
            any(m.status[0].message == 'all inputs usable' for m in hour.reports[1:]),
        )[1]
    )


def framed_sets(hour: Hour, *parameters: str) -> tuple[Any, Any]:
    g = hour.begin(*parameters)
    g.start(Localizer)
    told, points = g.tell(PointCloud2, 'landmarks', LATCHED), g.tell(PointCloud2, 'image_points')
    message = landmarks()
    message.header.frame_id = 'map'
    told.publish(message)
    return told, points


def framed(stamp: int, frame: str, ids: Any = None) -> Any:
    message = image_points(stamp, ids)
    message.header.frame_id = frame
    return message


@tries('No errors: true poses are in another frame')
def odometry_frame(hour: Hour, pattern: str) -> None:
    _, points = framed_sets(hour, *SOLVING)
    truth = hour.graph.tell(PoseStamped, 'true_pose')
    hour.says(
        pattern,
        lambda: (
            truth.publish(messages.pose_message(identity(), 7, 'odom')),
            points.publish(image_points()),
        ),
    )


@tries('Doubtful: points beyond what is known of the lens')
def beyond_the_calibration(hour: Hour, pattern: str) -> None:
    lens = replace(load_lens(lens_path('fish214')).svp(), calibration={'reached_deg': 20.0})
    with TemporaryDirectory() as folder:
        save_lens(lens, Path(folder) / 'lens.yaml')
        _, points = framed_sets(hour, f'lens:={folder}/lens.yaml', 'patience:=0.1')
    hour.says(pattern, lambda: points.publish(image_points()))


@tries('Slower for a minute, at the first start with Numba')
def compiling(hour: Hour, pattern: str) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr('fisheye_svp_ros.optics.engines.find_spec', lambda _: 'there')
        patch.setattr('fisheye_svp_ros.optics.engines.cache.is_compiled', lambda: False)
        patch.setattr('fisheye_svp_ros.optics.engines.cache._CODE', 'input()')
        patch.setenv('FISHEYE_SVP_ENGINE', 'auto')
        hour.begin(*SOLVING).start(Localizer)
    hour.logs(pattern)


@tries('All sets fail: camera_info is of another camera')
def info_of_another(hour: Hour, pattern: str) -> None:
    _, points = framed_sets(hour, 'lens:=camera_info', 'patience:=0.1')
    driver = hour.graph.tell(CameraInfo, 'camera_info', SENSOR)
    info = CameraInfo(width=640, height=480, distortion_model='equidistant', d=[0.0] * 4)
    info.header.frame_id = 'right_cam'
    info.k = [300.0, 0.0, 9.0, 0.0, 300.0, 9.0, 0.0, 0.0, 1.0]
    hour.says(pattern, lambda: (driver.publish(info), points.publish(framed(7, 'left_cam'))))


@tries('Some sets fail: two cameras on one topic')
def two_cameras(hour: Hour, pattern: str) -> None:
    _, points = framed_sets(hour, *SOLVING)
    points.publish(framed(1, 'front'))
    hour.says(
        pattern, lambda: [points.publish(framed(n, f)) for n, f in ((2, 'front'), (3, 'rear'))]
    )


@tries("No results: the rig's cameras are exchanged")
def exchanged_rig(hour: Hour, pattern: str) -> None:
    g = hour.begin(*SOLVING, 'rig:=topic')
    g.start(StereoDepth)
    told, rig = g.tell(PointCloud2, 'landmarks', LATCHED), g.tell(TransformStamped, 'rig', LATCHED)
    points = [g.tell(PointCloud2, f'{name}/image_points') for name in ('left', 'right')]
    told.publish(landmarks())
    rig.publish(messages.transform_message(identity(), 7, 'l', 'r'))
    hour.says(
        pattern, lambda: [p.publish(framed(7, f)) for p, f in zip(points, 'lr', strict=True)]
    )


@tries('A set has fewer points: landmarks are unknown')
def unmapped_landmark(hour: Hour, pattern: str) -> None:
    _, points = framed_sets(hour, *SOLVING)
    ids = np.arange(len(image_points().data) // 20)
    ids[3] = 4711
    hour.says(pattern, lambda: points.publish(image_points(ids=ids)))


@tries('An old map is used: the new one is refused')
def refused_map(hour: Hour, pattern: str) -> None:
    told, points = framed_sets(hour, *SOLVING)
    told.publish(PointCloud2())
    hour.says(pattern, lambda: points.publish(image_points()))


@tries('Doubtful poses: wrong lens, unit, or image size')
def another_lens(hour: Hour, pattern: str) -> None:
    _, points = framed_sets(hour, *ZOOMED)
    hour.says(pattern, lambda: points.publish(image_points(zoom=1.02)))


@tries('No poses: the residuals are above the gate')
def gated(hour: Hour, pattern: str) -> None:
    _, points = framed_sets(hour, *ZOOMED, 'gate:=3.0')
    hour.says(pattern, lambda: points.publish(image_points(zoom=1.02)))


@tries('Doubtful rig: left and right are exchanged')
def exchanged_cameras(hour: Hour, pattern: str) -> None:
    g = hour.begin(*SOLVING, 'rig:=topic')
    g.start(StereoDepth)
    told, given = (
        g.tell(PointCloud2, 'landmarks', LATCHED),
        g.tell(TransformStamped, 'rig', LATCHED),
    )
    points = [g.tell(PointCloud2, f'{name}/image_points') for name in ('left', 'right')]
    told.publish(landmarks())
    pose = Pose(np.eye(3), np.array([0.15, 0.0, 0.0]))
    given.publish(messages.transform_message(pose, 7, '', ''))
    hour.says(pattern, lambda: [one.publish(image_points()) for one in points])


@tries('Wrong poses: camera_info is for another image size')
def another_size(hour: Hour, pattern: str) -> None:
    g = hour.begin(f'board:={BOARD}')
    g.hear(PointCloud2, 'image_points')
    g.start(Detector)
    images, driver = g.tell(Image, 'image', SENSOR), g.tell(CameraInfo, 'camera_info', SENSOR)
    info = CameraInfo(
        width=848,
        height=400,
        distortion_model='equidistant',
        d=[0.0] * 4,
        k=[300.0, 0.0, 9.0, 0.0, 300.0, 9.0, 0.0, 0.0, 1.0],
    )
    image = messages.image_message(np.zeros((400, 424), np.uint8), 7, 'camera')
    hour.says(pattern, lambda: (driver.publish(info), images.publish(image)))


@tries('Doubtful poses: landmarks are in mm')
def millimeters(hour: Hour, pattern: str) -> None:
    told, points = framed_sets(hour, *SOLVING)
    told.publish(landmarks(radius=2000.0))
    hour.says(pattern, lambda: points.publish(image_points()))


@tries('Results are late or missing: the node is too slow')
def too_slow(hour: Hour, pattern: str) -> None:
    node = hour.begin(*SOLVING).start(Localizer)
    hour.says(pattern, lambda: node._pace.counts.update(dropped=1))


@tries('Results are late, none is lost: the machine is too slow')
def late(hour: Hour, pattern: str) -> None:
    node = hour.begin(*SOLVING).start(Localizer)

    def lag() -> None:
        node._pace.counts.update(solved=1)
        node._pace.answer(age=2.0, waited=0.1)

    hour.says(pattern, lag)


@tries('No base_pose: the pose is not known well enough')
def weak_pose(hour: Hour, pattern: str) -> None:
    kind = need_tf2()
    _, points = framed_sets(hour, *SOLVING, 'base_frame:=base_link', 'max_std_m:=0.0001')
    mount = messages.transform_message(identity(), 0, 'base_link', 'camera')
    hour.graph.tell(kind, '/tf_static', LATCHED).publish(kind(transforms=[mount]))
    hour.says(pattern, lambda: points.publish(image_points()))


@tries('No base_pose: no transform of the camera')
def no_mount(hour: Hour, pattern: str) -> None:
    need_tf2()
    _, points = framed_sets(hour, *SOLVING, 'base_frame:=base_link')
    hour.says(pattern, lambda: points.publish(image_points()))


@tries('No transform to the odometry: /tf lacks it')
def no_odometry(hour: Hour, pattern: str) -> None:
    kind = need_tf2()
    frames = ('base_frame:=base_link', 'odom_frame:=odom')
    _, points = framed_sets(hour, *SOLVING, *frames)
    static = hour.graph.tell(kind, '/tf_static', LATCHED)
    mount = messages.transform_message(identity(), 0, 'base_link', 'camera')
    static.publish(kind(transforms=[mount]))
    hour.says(pattern, lambda: points.publish(image_points()))


def need_tf2() -> Any:
    return pytest.importorskip('tf2_msgs.msg', reason='tf2_msgs is not installed').TFMessage


@tries('No progress: use_sim_time without a clock')
def no_clock(hour: Hour, pattern: str) -> None:
    g = hour.begin(*SOLVING, 'use_sim_time:=true')
    g.start(Localizer)
    told, points = g.tell(PointCloud2, 'landmarks', LATCHED), g.tell(PointCloud2, 'image_points')
    told.publish(landmarks())
    points.publish(image_points())
    hour.says(pattern)


@tries('A parameter has no effect: its name is misspelled')
def misspelled(hour: Hour, pattern: str) -> None:
    g = hour.begin(*SOLVING, 'patence:=3.0')
    g.start(Localizer)
    hour.logs(pattern)


@pytest.mark.parametrize('symptom', TABLE)
def test_the_node_says_what_the_table_says(symptom: str, hour: Hour) -> None:
    TRIED[symptom](hour, TABLE[symptom])


def test_every_row_is_tried() -> None:
    assert {*TABLE} == {*TRIED} and len(TABLE) >= 10


def test_it_says_nothing_where_something_comes(hour: Hour) -> None:
    g = hour.begin(*SOLVING)
    g.start(Localizer)
    told, points = g.tell(PointCloud2, 'landmarks', LATCHED), g.tell(PointCloud2, 'image_points')
    told.publish(landmarks())  # once, and for good
    g.until(lambda: (points.publish(image_points()), len(hour.reports) > 2)[1])
    last = hour.reports[-1].status[0]
    assert last.level == last.OK and last.message == 'all inputs usable'


def test_data_that_stop_are_missed_until_they_come_again(hour: Hour) -> None:
    g = hour.begin(*SOLVING)
    g.start(Localizer)
    told, points = g.tell(PointCloud2, 'landmarks', LATCHED), g.tell(PointCloud2, 'image_points')
    told.publish(landmarks())
    for stopped in (
        r'no message on /image_points for \d+ s: probe is still connected',
        r'no message on /image_points for \d+ s: its publisher is gone',
    ):
        hour.reports.clear()
        g.until(
            lambda: (
                points.publish(image_points()),
                any(m.status[0].message == 'all inputs usable' for m in hour.reports),
            )[1]
        )
        if 'gone' in stopped:
            g.probe.destroy_publisher(points)
        hour.says(stopped)
        hour.reports.clear()
        g.until(lambda: len(hour.reports) > 1)
        said = hour._capfd.readouterr().err
        assert len(re.findall(stopped, said)) == 1 and '/landmarks for' not in said


def test_a_slow_publisher_is_not_missed_between_its_messages(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = [0.0]
    monkeypatch.setattr(
        'fisheye_svp_ros.nodes.subscriptions.time', SimpleNamespace(monotonic=lambda: now[0])
    )
    node = SimpleNamespace(resolve_topic_name=str)
    one = Input(node, PointCloud2, 'image_points', lambda _: None, SENSOR, latched=False)
    monkeypatch.setattr(
        one,
        '_add_subscription',
        lambda kind, _: one._subscriptions.update({kind: SimpleNamespace()}),
    )
    one.subscribe()
    for time in (10.0, 20.0, 30.0):
        now[0] = time
        one._hear(b'')
    silent = []
    for now[0] in (36.0, 59.0, 61.0):
        silent.append(one.is_silent(5.0))
    assert silent == [False, False, True]


def test_a_lens_that_is_named_needs_no_scenario(hour: Hour) -> None:
    g = hour.begin(*SOLVING)
    node = g.start(Localizer)
    assert [*node.needed_inputs()] == [('image_points',), ('landmarks',)]


def test_a_camera_listens_to_nothing(hour: Hour, tmp_path: Any) -> None:
    table = tmp_path / 'seen.csv'
    table.write_text(
        'frame,landmark,u,v,x,y,z\n'
        + ''.join(f'0,{i},{10 * i},{5 * i},0,{i},1\n' for i in range(5))
    )
    g = hour.begin(f'observations:={table}')
    g.start(MeasuredCamera)
    g.until(lambda: hour.reports)
    hour._capfd.readouterr()
    g.idle(1.5)
    assert hour.reports[-1].status[0].message == 'all inputs usable'


def test_a_best_effort_publisher_is_heard_and_not_told_of_incompatible_qos(hour: Hour) -> None:
    g = hour.begin(*SOLVING)
    results = g.hear(DiagnosticArray, 'localizer/result')
    g.start(Localizer)
    latest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    told = g.probe.create_publisher(PointCloud2, 'landmarks', latest)
    points = g.probe.create_publisher(PointCloud2, 'image_points', latest)
    g.until(lambda: (told.publish(landmarks()), points.publish(image_points()), results)[2])
    assert not results[0].status[0].message


@pytest.mark.parametrize('reliability', list(ReliabilityPolicy)[1:3])
@pytest.mark.parametrize('durability', list(DurabilityPolicy)[1:3])
def test_every_driver_is_heard_and_told_nothing(
    hour: Hour, reliability: ReliabilityPolicy, durability: DurabilityPolicy
) -> None:
    g = hour.begin(f'board:={BOARD}')
    node = g.start(Detector)
    qos = QoSProfile(depth=1, reliability=reliability, durability=durability)
    driver = g.probe.create_publisher(CameraInfo, 'camera_info', qos)
    info = CameraInfo(
        width=848,
        height=400,
        distortion_model='equidistant',
        d=[0.0] * 4,
        k=[300.0, 0.0, 9.0, 0.0, 300.0, 9.0, 0.0, 0.0, 1.0],
    )
    count = node._inputs['camera_info'].count
    driver.publish(info)  # before anybody listens: who latches is heard nevertheless
    if durability == DurabilityPolicy.TRANSIENT_LOCAL:
        g.until(lambda: count.received == 1)
        g.idle(0.3)
        assert count.received == 1
    g.until(lambda: (driver.publish(info), count.received > 1)[1])
    hour.graph.idle(0.3)
    assert 'incompatible QoS' not in hour._capfd.readouterr().err
