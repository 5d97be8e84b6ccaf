"""Solvers as managed nodes: nothing before configure, nothing heard before activate."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.graph import Graph, set_parameter

from diagnostic_msgs.msg import DiagnosticArray  # isort: skip
from rclpy.lifecycle import TransitionCallbackReturn  # isort: skip

from fisheye_svp_ros.nodes.localizer import Localizer
from fisheye_svp_ros.nodes.model_critic import ModelCritic
from fisheye_svp_ros.nodes.stereo_calibrator import StereoCalibrator
from fisheye_svp_ros.nodes.stereo_depth import StereoDepth
from fisheye_svp_ros.nodes.synthetic_camera import SyntheticCamera

SOLVERS = (Localizer, StereoCalibrator, StereoDepth, ModelCritic)


@pytest.fixture
def graph(ros_domain: int) -> Iterator[Graph]:
    one = Graph('-p', 'lifecycle:=true', '-p', 'rate:=20.0', '-p', 'lens:=fish180')
    yield one
    one.close()


@pytest.mark.parametrize('kind', SOLVERS)
def test_only_an_active_node_listens(graph: Graph, kind: type) -> None:
    node, success = graph.start(kind), TransitionCallbackReturn.SUCCESS
    topic = f'/{node.cameras[0]}image_points'
    assert node.trigger_configure() == success
    assert not graph.probe.count_subscribers(topic)
    for _ in range(2):
        assert node.trigger_activate() == success
        graph.until(lambda: graph.probe.count_subscribers(topic) == 1)
        assert node.trigger_deactivate() == success
        graph.until(lambda: not graph.probe.count_subscribers(topic))
    assert node.trigger_cleanup() == success and node.trigger_shutdown() == success


def test_what_an_inactive_node_asks_for_can_be_done(
    graph: Graph, capfd: pytest.CaptureFixture[str]
) -> None:
    node = graph.start(Localizer)
    assert 'set /localizer configure, then' in capfd.readouterr().err, 'at its start'
    node.trigger_configure()
    assert 'run ros2 lifecycle set /localizer activate' in node.report()[1]
    node.trigger_cleanup()
    assert 'set /localizer configure, then' in node.report()[1]


def test_results_come_while_it_is_active(graph: Graph) -> None:
    results = graph.hear(DiagnosticArray, 'localizer/result')
    node = graph.start(Localizer)
    graph.start(SyntheticCamera)
    node.trigger_configure()
    graph.idle(0.5)
    assert not results
    node.trigger_activate()
    graph.until(lambda: len(results) > 2)
    node.trigger_deactivate()
    graph.idle(0.5)
    count = len(results)
    graph.idle(0.5)
    assert len(results) == count


def test_a_lens_that_cannot_be_loaded_leaves_it_unconfigured(
    ros_domain: int, tmp_path: Path
) -> None:
    graph = Graph('-p', 'lifecycle:=true', '-p', f'lens:={tmp_path / "nosuch.yaml"}')
    node = graph.start(Localizer)
    assert node.trigger_configure() == TransitionCallbackReturn.FAILURE
    assert set_parameter(node, 'lens', 'fish214').successful
    assert node.trigger_configure() == TransitionCallbackReturn.SUCCESS
    graph.close()


def test_what_is_said_of_topics_is_understood_once_they_are_there(
    ros_domain: int, capfd: pytest.CaptureFixture[str]
) -> None:
    graph = Graph(
        '-p',
        'lifecycle:=true',
        '-p',
        'lens:=fish180',
        '-p',
        'nosuch:=1',
        '-p',
        'qos_overrides./image_points.subscription.depth:=7',
    )
    try:
        node = graph.start(Localizer)
        node.trigger_configure()
        node.trigger_activate()
        assert node.get_parameter('qos_overrides./image_points.subscription.depth').value == 7
    finally:
        graph.close()
    said = capfd.readouterr().err
    assert said.count('is unknown to this node') == 1 and "parameter 'nosuch' is unknown" in said
