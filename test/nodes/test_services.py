"""What people ask of nodes that gather views: to save what is there, to begin anew."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.graph import LATCHED, Graph
from helpers.nodes import TIMEOUT

from diagnostic_msgs.msg import DiagnosticArray  # isort: skip
from sensor_msgs.msg import PointCloud2  # isort: skip
from std_srvs.srv import Trigger  # isort: skip

from fisheye_svp_ros.errors import ObservationError, ParameterError
from fisheye_svp_ros.io.decoding import read_key_values
from fisheye_svp_ros.io.landmark_files import environment
from fisheye_svp_ros.io.rig_files import load_rig
from fisheye_svp_ros.nodes import messages, model_critic
from fisheye_svp_ros.nodes.model_critic import ModelCritic
from fisheye_svp_ros.nodes.stereo_calibrator import StereoCalibrator
from fisheye_svp_ros.nodes.transforms import TransformPublisher
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.simulate.scenario import Scenario, simulate_scenario


class Asked:
    """A node, its services, and what tells it sets of a rig or of one camera."""

    def __init__(self, g: Graph, kind: type, cameras: tuple[str, ...]) -> None:
        style = 'parallel' if len(cameras) > 1 else 'mono'
        scenario = Scenario(style=style, radius=0.5, shift_scale=0.0, poses_file='calibration')
        self.seen = simulate_scenario(scenario).observations
        self.graph, self.name = g, kind.NAME
        self.results = g.hear(DiagnosticArray, f'{kind.NAME}/result')
        self.reports = g.hear(DiagnosticArray, '/diagnostics')
        self.progress = g.hear(DiagnosticArray, f'{kind.NAME}/progress')
        self.node = g.start(kind)
        self.landmarks = g.tell(PointCloud2, 'landmarks', LATCHED)
        self.points = {name: g.tell(PointCloud2, f'{name}image_points') for name in cameras}
        g.until(lambda: self.node._result.get_subscription_count() > 0)
        message = messages.landmarks_message(environment('whole', 0.5), 0, 'world')
        self.landmarks.publish(message)

    def tell(self, frame: int) -> None:
        for number, publisher in enumerate(self.points.values()):
            rows = (self.seen.camera == number) & (self.seen.frame == frame)
            part = self.seen.take(np.flatnonzero(rows))
            publisher.publish(
                messages.image_points_message(part.landmark, part.uv, frame + 1, f'c{number}')
            )

    def ask(self, service: str) -> Any:
        client = self.graph.probe.create_client(Trigger, f'{self.name}/{service}')
        self.graph.until(client.service_is_ready)
        future = client.call_async(Trigger.Request())
        self.graph.until(future.done)
        return future.result()

    def counts(self, wanted: dict[str, str]) -> None:
        self.graph.until(
            lambda: any(wanted.items() <= read_key_values(m).items() for m in self.reports)
        )


def test_a_rig_is_saved_and_its_views_are_forgotten(
    graph: Callable[..., Graph], tmp_path: Path
) -> None:
    file = tmp_path / 'rig.yaml'
    g = graph('lens:=fish214', 'svp:=true', 'views:=3', f'output:={file}')
    asked = Asked(g, StereoCalibrator, ('left/', 'right/'))
    answer = asked.ask('save')
    assert not answer.success and 'no rig yet' in answer.message and not file.exists()
    for frame in (0, 1):
        asked.tell(frame)
        g.until(lambda count=frame + 1: len(asked.results) == count)
    asked.counts({'calibration: views': '2', 'calibration: views missing': '1'})
    told = read_key_values(asked.progress[-1])
    assert (told['views'], told['views_missing']) == ('2', '1') and float(told['rms_px']) < 1e-3
    answer = asked.ask('save')
    assert answer.success, answer.message
    assert answer.message == f'{file}: 2 views, 1 fewer than the parameter views'
    assert load_rig(str(file)).position == pytest.approx([-0.15, 0, 0], abs=1e-6)
    answer = asked.ask('reset')
    assert answer.success and answer.message == '2 views forgotten'
    g.until(lambda: asked.progress[-1].status[0].message == '3 more views are needed')
    assert 'no rig yet' in asked.ask('save').message
    asked.tell(2)
    g.until(lambda: len(asked.results) == 3)
    assert read_key_values(asked.results[2])['views'] == '1.0'


def test_a_folder_is_no_file_for_a_rig(graph: Callable[..., Graph], tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match='a folder; name a file'):
        graph(f'output:={tmp_path}').start(StereoCalibrator)


def test_a_critic_forgets_its_frames(graph: Callable[..., Graph], tmp_path: Path) -> None:
    g = graph('lens:=fish214', 'svp:=true', f'output:={tmp_path}/lens.yaml')
    asked = Asked(g, ModelCritic, ('',))
    for frame in (0, 1):
        asked.tell(frame)
    g.until(lambda: len(asked.node._frames) == 2)
    asked.tell(1)
    g.until(
        lambda: asked.progress and read_key_values(asked.progress[-1])['views_repeated'] == '1'
    )
    assert asked.progress[-1].status[0].message == '18 more views are needed'
    assert 'no diagnosis yet: 2 of 20 frames' in asked.ask('save').message
    assert asked.ask('reset').message == '2 frames forgotten'
    assert asked.ask('save').message == 'no diagnosis yet: 0 of 20 frames'


def test_a_critic_tells_that_a_diagnosis_is_under_way_and_why_there_is_none(
    graph: Callable[..., Graph], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ended = threading.Event()

    def judge(*_: Any) -> Any:
        assert ended.wait(TIMEOUT)
        raise ObservationError('not enough of them')

    monkeypatch.setattr(model_critic, 'judge', judge)
    g = graph('lens:=fish214', 'svp:=true', 'min_frames:=5', f'output:={tmp_path}/lens.yaml')
    asked = Asked(g, ModelCritic, ('',))

    def diagnosing() -> str:
        return read_key_values(asked.progress[-1])['diagnosing'] if asked.progress else ''

    for frame in range(5):
        asked.tell(frame)
    g.until(lambda: diagnosing() == 'True')
    assert asked.ask('save').message == (
        'no diagnosis yet: 5 of 5 frames; it is under way, ask again'
    )
    ended.set()
    g.until(lambda: diagnosing() == 'False')
    answer = asked.ask('save')
    assert not answer.success and answer.message == 'not diagnosed: not enough of them'
    asked.ask('reset')
    assert asked.ask('save').message == 'no diagnosis yet: 0 of 5 frames'


class TransformMessage:
    """As tf2_msgs/TFMessage, which need not be installed."""

    def __init__(self, transforms: list[Any]) -> None:
        self.transforms = transforms


@pytest.mark.parametrize(('static', 'sent'), [(True, [0.0, 0.1, 0.0]), (False, [0.0] * 2)])
def test_a_static_transform_is_sent_when_it_changes(static: bool, sent: list[float]) -> None:
    told: list[Any] = []
    transforms = TransformPublisher.__new__(TransformPublisher)
    transforms._node, transforms._static = None, static
    transforms._sent, transforms._children = [], set()  # type: ignore[assignment]
    transforms._kind = TransformMessage
    transforms._publisher = type('P', (), {'publish': lambda _, message: told.append(message)})()
    places = [0.0, 1e-9, 0.1, 0.1, 0.0] if static else [0.0, 0.0]
    for stamp, x in enumerate(places):
        transforms.publish(Pose(np.eye(3), np.array([x, 0, 0])), stamp, 'right', 'left')
    assert [one.transforms[0].transform.translation.x for one in told] == sent
