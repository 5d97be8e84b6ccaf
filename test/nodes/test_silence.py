"""What is not there is told with its remedy, and waited for no longer than it makes sense."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from helpers.graph import LATCHED, RELIABLE, Graph

from diagnostic_msgs.msg import DiagnosticArray  # isort: skip
from geometry_msgs.msg import PoseStamped  # isort: skip
from rclpy.qos import QoSProfile, ReliabilityPolicy  # isort: skip
from sensor_msgs.msg import CameraInfo, Image, PointCloud2  # isort: skip

from fisheye_svp_ros.io.decoding import stamp_of
from fisheye_svp_ros.io.landmark_files import environment
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.detector import Detector
from fisheye_svp_ros.nodes.localizer import Localizer
from fisheye_svp_ros.nodes.stereo_calibrator import StereoCalibrator
from fisheye_svp_ros.simulate.scenario import Scenario, simulate_scenario

MS = 10**6
SEEN = simulate_scenario(Scenario(shift_scale=0.0)).observations
SOLVING = ('lens:=fish214', 'svp:=true')
PATIENCE = 'patience:=3600.0'  # s: whoever waits in vain is found out


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr('fisheye_svp_ros.nodes.base.LIMIT', 0.3)


def points_message(stamp: int, frame: str = 'camera') -> Any:
    return messages.image_points_message(SEEN.landmark, SEEN.uv, stamp, frame)


def landmarks_message(stamp: int, radius: float = 2.0) -> Any:
    return messages.landmarks_message(environment('whole', radius), stamp, 'world')


def test_a_map_with_stamps_of_its_own_turns_no_set_away(graph: Callable[..., Graph]) -> None:
    """It changes, as that of SLAM does, and its stamps are now and then those of a set."""
    g = graph(*SOLVING, 'patience:=0.1')
    results = g.hear(DiagnosticArray, 'localizer/result')
    g.start(Localizer)
    told, points = g.tell(PointCloud2, 'landmarks', LATCHED), g.tell(PointCloud2, 'image_points')
    sent = 0
    for stamp in range(100, 3100, 100):
        if stamp % 1000 == 500:  # a coincidence each time
            told.publish(landmarks_message(stamp * MS, 2.0 + 1e-9 * stamp))
            g.idle(0.05)
        if stamp < 500:
            continue
        points.publish(points_message(stamp * MS))
        sent += 1
        g.until(lambda count=sent: len(results) == count)
    solved = sum(bool(message.status[0].values) for message in results)
    assert sent == solved == 26, [m.status[0].message for m in results]


def test_the_same_landmarks_under_several_stamps_hold_for_all_sets(
    graph: Callable[..., Graph],
) -> None:
    g = graph(*SOLVING, 'patience:=0.1')
    results = g.hear(DiagnosticArray, 'localizer/result')
    g.start(Localizer)
    told, points = g.tell(PointCloud2, 'landmarks', LATCHED), g.tell(PointCloud2, 'image_points')
    for stamp in (1000, 2000):
        told.publish(landmarks_message(stamp * MS))
        points.publish(points_message(stamp * MS))
    g.until(lambda: len(results) == 2)
    points.publish(points_message(2500 * MS))
    g.until(lambda: len(results) == 3)
    assert all(message.status[0].values for message in results)


def test_a_scenario_that_nobody_publishes_is_not_waited_for(graph: Callable[..., Graph]) -> None:
    g = graph(*SOLVING, PATIENCE)
    results = g.hear(DiagnosticArray, 'stereo_calibrator/result')
    g.start(StereoCalibrator)
    told = g.tell(PointCloud2, 'landmarks', LATCHED)
    points = [g.tell(PointCloud2, f'{name}/image_points') for name in ('left', 'right')]
    told.publish(landmarks_message(0))
    for publisher, frame in zip(points, ('l', 'r'), strict=True):
        publisher.publish(points_message(1, frame))
    g.until(lambda: results)


def test_a_true_pose_publisher_that_never_sends_costs_few_sets(
    graph: Callable[..., Graph],
) -> None:
    g = graph(*SOLVING, PATIENCE)
    results = g.hear(DiagnosticArray, 'localizer/result')
    g.start(Localizer)
    told, points = g.tell(PointCloud2, 'landmarks', LATCHED), g.tell(PointCloud2, 'image_points')
    truth = g.tell(PoseStamped, 'true_pose')
    told.publish(landmarks_message(0))
    for stamp in range(1, 6):
        points.publish(points_message(stamp))
    g.idle(0.5)
    assert not results, 'it may be late'
    for stamp in range(6, 13):
        points.publish(points_message(stamp))
    g.until(lambda: len(results) == 12)
    truth.publish(messages.pose_message(simulate_scenario(Scenario()).poses[0].take(0), 20, ''))
    points.publish(points_message(20))
    g.until(lambda: stamp_of(results[-1]) == 20)
    assert 'position_error_m' in [pair.key for pair in results[-1].status[0].values]


def test_a_node_that_is_not_active_is_not_ok(graph: Callable[..., Graph]) -> None:
    g = graph(*SOLVING, 'lifecycle:=true')
    reports = g.hear(DiagnosticArray, '/diagnostics')
    g.start(Localizer)
    status = g.until(lambda: reports)[0].status[0]
    assert status.level == status.WARN
    assert 'not active, so no set is solved; run ros2 lifecycle set /localizer' in status.message


def test_overload_is_in_the_log(
    graph: Callable[..., Graph], capfd: pytest.CaptureFixture[str]
) -> None:
    g = graph(*SOLVING, 'backlog:=1', 'patience:=0.1')
    reports = g.hear(DiagnosticArray, '/diagnostics')
    node = g.start(Localizer)
    node._pace.counts['dropped'] += 5
    g.until(lambda: any('too slow' in m.status[0].message for m in reports))
    assert 'too slow' in capfd.readouterr().err


def test_images_that_are_lost_are_told(graph: Callable[..., Graph]) -> None:
    g = graph('board:=chessboard:9x6:25mm')
    reports = g.hear(DiagnosticArray, '/diagnostics')
    lossy = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    node = g.start(Detector)
    images = g.probe.create_publisher(Image, 'image', lossy)
    one = node._inputs['image']
    blank = messages.image_message(np.zeros((16, 16), np.uint8), 1, 'camera')
    g.until(lambda: (images.publish(blank), one.count.received > 3 and one._has_one_publisher)[1])
    before = one.count.lost
    for _ in range(60):  # nobody takes them, and five are kept
        images.publish(blank)
    g.until(lambda: 'messages were lost; start both nodes with FASTRTPS' in said(reports))
    assert one.count.lost >= before + 50


def test_images_that_are_seldom_lost_are_told_too(graph: Callable[..., Graph]) -> None:
    one = graph('board:=chessboard:9x6:25mm').start(Detector)._inputs['image']

    def report(received: int, lost: int) -> str:
        one.count.received += received
        one.count.lost += lost
        return one.losses()

    assert report(98, 2) == ''
    assert 'image: 4 of 200 messages were lost; start both' in report(98, 2)
    assert 'image: 4 of 200' in report(99, 1), 'until there are as many more'
    assert report(0, 0) == '', 'nothing comes, which is told apart'
    assert 'image: 20 of 100' in report(80, 20)
    assert 'image: 21 of 200' in report(100, 0)
    assert [report(100, 1) for _ in range(2)][1] == '', 'less than one in a hundred'


def said(reports: list[Any]) -> str:
    return ' '.join(status.message for report in reports for status in report.status)


@pytest.mark.parametrize('asked', ['', 'best_effort'])
@pytest.mark.parametrize('offered', ['reliable', 'best_effort'])
def test_the_remedy_for_silent_images_is_that_of_their_publisher(
    graph: Callable[..., Graph], offered: str, asked: str
) -> None:
    override = 'qos_overrides./image.subscription.reliability:='
    g = graph('board:=chessboard:9x6:25mm', *([override + asked] if asked else []))
    reports = g.hear(DiagnosticArray, '/diagnostics')
    policy = ReliabilityPolicy[offered.upper()]
    g.probe.create_publisher(Image, 'image', QoSProfile(depth=5, reliability=policy))
    g.start(Detector)
    g.until(lambda: 'no message has arrived' in said(reports))
    assert ('rmem_max' in said(reports)) == (offered == 'best_effort')
    wanted = f'{override}reliable' in said(reports)
    assert wanted == (offered == 'reliable' and bool(asked))


def test_images_are_heard_as_their_publishers_send_them(graph: Callable[..., Graph]) -> None:
    g = graph('board:=chessboard:9x6:25mm')
    node = g.start(Detector)
    one = node._inputs['image']

    def asked() -> list[str]:
        return [profile.reliability.name for profile in one.profiles]

    assert asked() == ['BEST_EFFORT']
    sender = g.tell(Image, 'image', QoSProfile(depth=30))
    g.until(lambda: asked() == ['RELIABLE'])
    g.until(lambda: sender.get_subscription_count() == 1)
    blank = messages.image_message(np.zeros((16, 16), np.uint8), 1, 'camera')
    for _ in range(4):
        sender.publish(blank)
    g.until(lambda: one.count.received == 4)
    lossy = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    g.probe.create_publisher(Image, 'image', lossy)
    g.until(lambda: asked() == ['BEST_EFFORT'])


def test_of_lost_images_that_are_sent_reliably_the_override_is_named(
    graph: Callable[..., Graph],
) -> None:
    g = graph(
        'board:=chessboard:9x6:25mm', 'qos_overrides./image.subscription.reliability:=best_effort'
    )
    one = g.start(Detector)._inputs['image']
    g.tell(Image, 'image', QoSProfile(depth=5))
    g.until(lambda: g.probe.count_publishers('image'))
    one.count.received, one.count.lost = 10, 20
    g.until(lambda: one._can_be_reliable())
    text = one.losses()
    assert text.endswith('set qos_overrides./image.subscription.reliability:=reliable')


def test_the_remedy_for_small_messages_is_no_buffer(graph: Callable[..., Graph]) -> None:
    g = graph('lens:=camera_info')
    reports = g.hear(DiagnosticArray, '/diagnostics')
    lossy = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    g.probe.create_publisher(CameraInfo, 'camera_info', lossy)
    volatile = g.probe.create_publisher(PointCloud2, 'landmarks', RELIABLE)
    volatile.publish(landmarks_message(0))  # before anybody listens
    g.start(Localizer)
    g.until(lambda: 'what was sent before this node started is lost' in said(reports))
    assert 'rmem_max' not in said(reports)


def test_the_parameter_that_is_set_is_not_asked_for(graph: Callable[..., Graph]) -> None:
    g = graph('lens:=camera_info', 'patience:=0.1')
    results = g.hear(DiagnosticArray, 'localizer/result')
    g.start(Localizer)
    told, points = g.tell(PointCloud2, 'landmarks', LATCHED), g.tell(PointCloud2, 'image_points')
    told.publish(landmarks_message(0))
    points.publish(points_message(1))
    g.until(lambda: results)
    assert 'check its publisher, or set lens:=FILE' in results[0].status[0].message
    assert np.size(results[0].status[0].values) == 0
