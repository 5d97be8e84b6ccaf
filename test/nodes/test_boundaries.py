"""What comes from outside: refused, counted, and survived."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.graph import LATCHED, RELIABLE, Graph, set_parameter

from diagnostic_msgs.msg import DiagnosticArray  # isort: skip
from geometry_msgs.msg import PoseStamped  # isort: skip
from rclpy.exceptions import ParameterException  # isort: skip
from sensor_msgs.msg import PointCloud2, PointField  # isort: skip
from std_srvs.srv import Trigger  # isort: skip

from fisheye_svp_ros.errors import FisheyeSvpError, ObservationError
from fisheye_svp_ros.io.decoding import read_key_values, stamp_of
from fisheye_svp_ros.io.landmark_files import environment
from fisheye_svp_ros.io.lens_files import load_lens, save_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.nodes import declaration, messages, subscriptions
from fisheye_svp_ros.nodes.detector import Detector
from fisheye_svp_ros.nodes.localizer import Localizer
from fisheye_svp_ros.nodes.measured_camera import MeasuredCamera
from fisheye_svp_ros.nodes.model_critic import ModelCritic
from fisheye_svp_ros.nodes.synthetic_camera import SyntheticCamera
from fisheye_svp_ros.scene.rigs import paper_pose
from fisheye_svp_ros.simulate.scenario import Scenario, simulate_scenario


class Attack:
    """A localizer, and what tells it sets."""

    def __init__(self, g: Graph, landmarks: Any = LATCHED) -> None:
        self.graph = g
        self.seen = simulate_scenario(Scenario(shift_scale=0.0)).observations
        self.results = g.hear(DiagnosticArray, 'localizer/result')
        self.diagnostics = g.hear(DiagnosticArray, '/diagnostics')
        self.node = g.start(Localizer)
        self.landmarks = g.tell(PointCloud2, 'landmarks', landmarks)
        self.points = g.tell(PointCloud2, 'image_points')
        self.truth = g.tell(PoseStamped, 'true_pose')
        self.scenario = g.tell(DiagnosticArray, 'scenario')
        g.until(lambda: self.node._result.get_subscription_count() > 0)
        self.cloud = messages.landmarks_message(environment('whole', 2.0), 0, 'world')

    def tell_points(self, stamp: int) -> None:
        seen = self.seen
        self.points.publish(messages.image_points_message(seen.landmark, seen.uv, stamp, 'camera'))

    def solves(self, stamp: int) -> None:
        """Assert that a good set is still answered well."""
        self.landmarks.publish(self.cloud)
        self.tell_points(stamp)
        self.graph.until(lambda: self.answer(stamp))
        assert float(read_key_values(self.answer(stamp))['rms_px']) < 1e-6

    def answer(self, stamp: int) -> Any:
        return next((m for m in self.results if stamp_of(m) == stamp), None)

    def counts(self) -> dict[str, str]:
        """Return what the next diagnostics of the node count."""
        self.diagnostics.clear()
        self.graph.until(lambda: self.diagnostics)
        return read_key_values(self.diagnostics[-1])


def tags(**values: object) -> Any:
    return messages.key_values_message('scenario', values, 7)


@pytest.mark.parametrize(
    ('values', 'reason'),
    [
        ({'lens': 'fish214', 'shift_scale': 'abc'}, "shift_scale is 'abc'; a number is needed"),
        (
            {'lens': 'fish214', 'shift_scale': '1e308'},
            'shift_scale is 1e+308; allowed is 0 to 100',
        ),
        ({'lens': 'a\0b'}, ''),  # rclpy ends a string there
        ({'lens': 'a' * 5000}, 'is a file, but a running node takes only names'),
        ({'lens': '/dev/zero'}, 'is a file, but a running node takes only names'),
        ({'lens': 'nothere'}, "'nothere' is neither"),
    ],
)
def test_a_scenario_that_cannot_be_used_is_a_set_that_cannot_be_solved(
    graph: Callable[..., Graph], values: dict[str, object], reason: str
) -> None:
    attack = Attack(graph('patience:=0.3'))
    attack.landmarks.publish(attack.cloud)
    attack.scenario.publish(tags(**values))
    attack.tell_points(7)
    attack.graph.until(lambda: attack.answer(7))
    status = attack.answer(7).status[0]
    assert reason in status.message and status.level == status.WARN and not status.values
    attack.scenario.publish(messages.key_values_message('scenario', {'lens': 'fish214'}, 8))
    attack.solves(8)
    assert attack.counts()['internal errors'] == '0'


def huge(values: float) -> Any:
    points = environment('whole', 2.0)
    return messages.landmarks_message(
        type(points)(points.ids, np.full_like(points.points, values)), 0, 'world'
    )


def stamped(message: Any, sec: int, nanosec: int) -> Any:
    message.header.stamp.sec, message.header.stamp.nanosec = sec, nanosec
    return message


def many_fields(count: int) -> Any:
    fields = [PointField(name=f'f{i}', offset=0, datatype=8, count=1) for i in range(count)]
    return PointCloud2(width=1, height=1, point_step=8, fields=fields, data=bytes(8))


@pytest.mark.parametrize(
    ('topic', 'message', 'reason'),
    [
        ('landmarks', lambda: huge(1e308), 'is 1e+308'),
        ('landmarks', lambda: huge(-1e200), 'is -1e+200'),
        ('points', lambda: PointCloud2(point_step=2**32 - 1), '4294967295 bytes'),
        ('points', lambda: many_fields(1000), '1000 fields'),
        ('points', lambda: stamped(PointCloud2(), 2**31 - 1, 2**32 - 1), 'is not a time'),
        ('points', lambda: stamped(PointCloud2(), -1, 0), 'is not a time'),
        (
            'truth',
            lambda: stamped(messages.pose_message(paper_pose(), 7, 'w'), 0, 10**9),
            'is not a time',
        ),
        ('scenario', lambda: DiagnosticArray(), '0 statuses'),
    ],
)
def test_a_hostile_message_is_refused_with_a_reason_and_counted(
    graph: Callable[..., Graph], topic: str, message: Callable[[], Any], reason: str
) -> None:
    attack = Attack(graph('patience:=0.3', 'lens:=fish214', 'svp:=true'))
    getattr(attack, topic).publish(message())
    name = {'points': 'image_points', 'truth': 'true_pose'}.get(topic, topic)
    attack.graph.until(lambda: attack.counts()[f'{name}: dropped'] == '1')
    assert reason in attack.diagnostics[-1].status[0].message
    attack.solves(8)
    assert attack.counts()['internal errors'] == '0'


def test_less_than_a_stamp_is_refused_and_counted(graph: Callable[..., Graph]) -> None:
    node = graph('lens:=fish214').start(Localizer)
    count, head = subscriptions.Count(), messages.header
    for data in (b'', bytes(3), bytes(11)):
        with pytest.raises(ObservationError, match='bytes are not a message'):
            _ = subscriptions.Unread('image_points', PointCloud2, data, head, count).stamp
    assert node._failures == 0 and count.read == 3


def test_a_board_file_is_named_below_the_folder_alone(
    graph: Callable[..., Graph], tmp_path: Path
) -> None:
    (tmp_path / 'target.yaml').write_text(
        'target_type: aprilgrid\ntagCols: 3\ntagRows: 2\ntagSize: 0.1\ntagSpacing: 0.3\n'
    )
    node = graph(f'folder:={tmp_path}').start(Detector)
    assert set_parameter(node, 'board', f'aprilgrid:{tmp_path}/target.yaml').successful
    result = set_parameter(node, 'board', 'aprilgrid:/etc/passwd')
    assert not result.successful and 'is not below' in result.reason


def test_what_nobody_thought_of_is_told_once_counted_and_survived(
    graph: Callable[..., Graph], monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: Any) -> None:
        raise np.linalg.LinAlgError('SVD did not converge')

    attack = Attack(graph('patience:=0.3', 'lens:=fish214', 'svp:=true'))
    with monkeypatch.context() as patch:
        patch.setattr(Localizer, 'solve', fail)
        attack.landmarks.publish(attack.cloud)
        for stamp in (1, 2, 3):
            attack.tell_points(stamp)
            attack.graph.until(lambda stamp=stamp: attack.answer(stamp))
    assert 'internal error' in attack.answer(3).status[0].message
    attack.solves(8)
    counts = attack.counts()
    status = attack.diagnostics[-1].status[0]
    assert counts['internal errors'] == '3' and status.level == status.ERROR
    assert (counts['sets: taken'], counts['sets: solved'], counts['sets: not solved']) == (
        '4',
        '1',
        '3',
    )
    said = capfd.readouterr().err
    assert said.count('Traceback') == 1 and 'SVD did not converge' in said


def test_a_timer_and_a_service_that_fail_do_not_end_the_node(
    graph: Callable[..., Graph], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> None:
        raise RuntimeError('no such luck')

    monkeypatch.setattr(ModelCritic, '_tick', fail)
    g = graph()
    node = g.start(ModelCritic)
    g.until(lambda: node._failures >= 2)
    response = Trigger.Response()
    assert node.guard_callback(fail)(Trigger.Request(), response) is response


def sums(counts: dict[str, str]) -> tuple[int, int]:
    """Return the sets that were taken, and all that became of them."""
    return int(counts['sets: taken']), sum(
        int(counts[f'sets: {name}'])
        for name in ('solved', 'not solved', 'dropped', 'incomplete', 'waiting')
    )


def test_overload_drops_whole_sets_keeps_the_newest_and_says_so(
    graph: Callable[..., Graph], monkeypatch: pytest.MonkeyPatch
) -> None:
    solve = Localizer.solve

    def slowly(*arguments: Any) -> None:
        time.sleep(0.02)
        solve(*arguments)

    attack = Attack(graph('patience:=0.3', 'lens:=fish214', 'svp:=true', 'backlog:=5'))
    attack.solves(1)
    attack.counts()
    monkeypatch.setattr(Localizer, 'solve', slowly)
    for stamp in range(2, 302):
        attack.tell_points(stamp)
    attack.graph.until(lambda: attack.answer(301))
    texts = [message.status[0].message for message in attack.diagnostics]
    for _ in range(3):
        counts = attack.counts()
        texts.append(attack.diagnostics[-1].status[0].message)
        assert len(set(sums(counts))) == 1, counts
    assert any('too slow: ' in text and ' sets per second are received' in text for text in texts)
    assert counts['sets: taken'] == '301' and counts['sets: waiting'] == '0'
    assert int(counts['sets: dropped']) > 50 and counts['sets: not solved'] == '0'
    assert len(attack.results) == int(counts['sets: solved'])
    assert all(stamp in map(stamp_of, attack.results) for stamp in range(297, 302))
    assert 'too slow' not in texts[-1]


def test_what_nobody_listens_to_yet_is_held_back_no_further_than_the_backlog(
    graph: Callable[..., Graph],
) -> None:
    parameters = ('patience:=0.3', 'lens:=fish214', 'svp:=true', 'backlog:=5')
    attack = Attack(graph(*parameters, 'wait_for_subscribers:=2'))
    attack.landmarks.publish(attack.cloud)
    for stamp in range(1, 21):
        attack.tell_points(stamp)
    attack.graph.until(lambda: attack.counts()['sets: taken'] == '20')
    attack.graph.until(lambda: attack.counts()['sets: waiting'] == '5')
    attack.graph.hear(DiagnosticArray, 'localizer/result')
    attack.graph.until(lambda: len(attack.results) == 5)
    assert [stamp_of(m) for m in attack.results] == [16, 17, 18, 19, 20]


def test_landmarks_that_are_not_latched_are_heard(
    graph: Callable[..., Graph], capfd: pytest.CaptureFixture[str]
) -> None:
    attack = Attack(graph('patience:=0.3', 'lens:=fish214', 'svp:=true'), landmarks=RELIABLE)
    attack.solves(3)
    assert attack.counts()['landmarks: received'] == '1'
    assert 'No messages will be received from it' not in capfd.readouterr().err


def test_landmarks_that_are_latched_are_heard_late_and_once(graph: Callable[..., Graph]) -> None:
    g = graph('patience:=0.3', 'lens:=fish214', 'svp:=true')
    early = g.probe.create_publisher(PointCloud2, 'landmarks', LATCHED)
    early.publish(messages.landmarks_message(environment('whole', 2.0), 0, 'world'))
    attack = Attack(g)
    attack.graph.until(lambda: attack.counts()['landmarks: received'] == '1')
    attack.solves(3)
    assert attack.counts()['landmarks: received'] == '2'


@pytest.mark.parametrize('topics', ['!!bad name//', 'localizer/result 9x', '/', 'a//b'])
def test_a_refused_lock_step_takes_no_effect(graph: Callable[..., Graph], topics: str) -> None:
    g = graph('rate:=100.0')
    points = g.hear(PointCloud2, 'image_points')
    node = g.start(SyntheticCamera)
    result = set_parameter(node, 'lock_step', topics)
    assert not result.successful and 'is not the name of a topic' in result.reason
    assert node.get_parameter('lock_step').value == '' and node.settings.lock_step == ''
    g.until(lambda: len(points) > 3)


def test_refused_observations_take_no_effect(graph: Callable[..., Graph], tmp_path: Path) -> None:
    good, bad = tmp_path / 'good.csv', tmp_path / 'bad.csv'
    rows = ''.join(f'0,{i},{10 * i},{5 * i},0,{i},1{{}}\n' for i in range(5))
    good.write_text('frame,landmark,u,v,x,y,z\n' + rows.format(*5 * ['']))
    bad.write_text('frame,landmark,u,v,x,y,z,camera\n' + rows.format(*5 * [',not a name']))
    g = graph(f'observations:={good}', f'folder:={tmp_path}', 'rate:=50.0')
    points = g.hear(PointCloud2, 'image_points')
    node = g.start(MeasuredCamera)
    result = set_parameter(node, 'observations', str(bad))
    assert not result.successful and 'cannot name a namespace' in result.reason
    assert node.settings.observations == node.get_parameter('observations').value == str(good)
    g.until(lambda: len(points) > 2)


def test_files_are_named_below_the_folder_alone(
    graph: Callable[..., Graph], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    inside, outside = tmp_path / 'mine' / 'a.yaml', tmp_path / 'b.yaml'
    inside.parent.mkdir()
    for path in (inside, outside):
        save_lens(load_lens(lens_path('fish180')), path)
    Path('plain').write_bytes(outside.read_bytes())
    Path('rig').mkdir()
    save_lens(load_lens(outside), Path('rig') / 'left.yaml')
    (inside.parent / 'link.yaml').symlink_to(outside)
    os.mkfifo(inside.parent / 'fifo.yaml')
    with (inside.parent / 'huge.yaml').open('wb') as file:
        file.truncate(declaration.MAX_FILE_BYTES + 1)
    node = graph(f'folder:={inside.parent}').start(Localizer)
    assert set_parameter(node, 'lens', str(inside)).successful
    for name, reason in (
        (outside, 'is not below'),
        (inside.parent / 'link.yaml', 'is not below'),
        (inside.parent / 'fifo.yaml', 'is not a file'),
        ('/dev/zero', 'not below'),
        (inside.parent / 'huge.yaml', 'above 64 MB'),
        ('plain', 'not below'),
        ('rig', 'is a folder, and not one of'),
    ):
        result = set_parameter(node, 'lens', str(name))
        assert not result.successful and reason in result.reason, name
    assert node.settings.lens == str(inside)


def test_what_is_fixed_at_the_start_cannot_be_changed_by_others(
    graph: Callable[..., Graph], tmp_path: Path
) -> None:
    node = graph(f'output:={tmp_path}/mine.yaml').start(ModelCritic)
    for name, value in (('output', '/tmp/yours.yaml'), ('folder', '/'), ('stereo', True)):
        result = set_parameter(node, name, value)
        assert not result.successful and 'read-only' in result.reason
        assert 'restart the node with -p NAME:=VALUE' in result.reason
    assert node.settings.output == f'{tmp_path}/mine.yaml'


def test_stamps_follow_a_clock_that_is_set_back(
    graph: Callable[..., Graph], monkeypatch: pytest.MonkeyPatch
) -> None:
    class At:
        def __init__(self, nanoseconds: int) -> None:
            self.nanoseconds = nanoseconds

        def now(self) -> At:
            return self

    node = graph().start(SyntheticCamera)
    stamps = []
    for now in (50 * 10**9, 50 * 10**9, 49_999_999_990, 10**9, 10**9 + 5):
        monkeypatch.setattr(node, 'get_clock', lambda now=now: At(now))
        node._stamp = node.stamp_of(None)
        stamps.append(node._stamp)
    assert stamps == [50 * 10**9, 50 * 10**9 + 1, 50 * 10**9 + 2, 10**9, 10**9 + 5]


def test_quality_of_service_is_overridden(
    graph: Callable[..., Graph], capfd: pytest.CaptureFixture[str]
) -> None:
    g = graph(
        'qos_overrides./image_points.publisher.reliability:=best_effort',
        'qos_overrides./image_points.publisher.depth:=7',
        'rate:=100.0',
    )
    points = g.hear(PointCloud2, 'image_points')
    node = g.start(SyntheticCamera)
    name = 'qos_overrides./image_points.publisher.reliability'
    assert node.get_parameter(name).value == 'best_effort'
    told = g.until(lambda: g.probe.get_publishers_info_by_topic('image_points'))
    assert told[0].qos_profile.reliability.name == 'BEST_EFFORT'
    g.idle(0.5)
    assert not points, 'who asks for reliable messages does not get these'
    assert not set_parameter(node, name, 'reliable').successful
    assert 'is unknown to this node' not in capfd.readouterr().err


@pytest.mark.parametrize(
    'given',
    [
        'qos_overrides./image_points.publisher.reliability:=sometimes',
        'qos_overrides./image_points.publisher.depth:=deep',
    ],
)
def test_an_override_that_makes_no_sense_is_refused(
    graph: Callable[..., Graph], given: str
) -> None:
    with pytest.raises((FisheyeSvpError, ParameterException, TypeError)):
        graph(given).start(SyntheticCamera)


def test_an_override_for_a_topic_that_is_none_is_named(
    graph: Callable[..., Graph], capfd: pytest.CaptureFixture[str]
) -> None:
    graph('qos_overrides./image_point.publisher.depth:=7').start(SyntheticCamera)
    assert "'qos_overrides./image_point.publisher.depth' is unknown" in capfd.readouterr().err
