"""The launch files, on an installed ROS 2 in which this package is installed."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.nodes import NodeProcess

pytest.importorskip('launch_ros')
from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from helpers.graph import Graph

from fisheye_svp_ros.io.bags import Bag
from fisheye_svp_ros.io.recording_table import is_tabulated, tabulate

from diagnostic_msgs.msg import DiagnosticArray  # isort: skip

try:
    SHARE = Path(get_package_share_directory('fisheye_svp_ros'))
except PackageNotFoundError:
    pytest.skip('this package is not installed (colcon build)', allow_module_level=True)

FILES = {
    'mono.launch.py': ['/localizer'],
    'stereo.launch.py': ['/stereo_calibrator', '/stereo_depth'],
    'whole.launch.py': ['/mono/localizer', '/stereo/stereo_calibrator', '/stereo/stereo_depth'],
}
SWEEP = """
synthetic_camera:
  ros__parameters:
    sweep.radius: [2.0, 0.5]
    sweep.environment: [whole, inner]
localizer: {ros__parameters: {svp: true}}
"""


@pytest.fixture
def graph(ros_domain: int) -> Iterator[Graph]:
    """Return a graph with nothing but a probe."""
    one = Graph()
    yield one
    one.close()


def test_every_launch_file_is_tested() -> None:
    files = {path.name for path in (SHARE / 'launch').glob('*.launch.py')}
    assert files == {*FILES, 'sweep.launch.py'}


def test_a_sweep_is_recorded_and_ends_by_itself(ros_domain: int, tmp_path: Path) -> None:
    sweep, bag = tmp_path / 'sweep.yaml', tmp_path / 'bag'
    sweep.write_text(SWEEP)
    launch = NodeProcess(
        ['ros2', 'launch', 'fisheye_svp_ros', 'sweep.launch.py', f'sweep:={sweep}', f'bag:={bag}'],
        dict(os.environ),
    )
    launch.finish()
    text = '\n'.join(launch.lines)
    assert 'Traceback' not in text and 'has died' not in text, text
    columns = tabulate(Bag(bag).records(is_tabulated))
    assert columns['scenario'] == [0, 1, 2, 3] and columns['radius'] == [2.0, 2.0, 0.5, 0.5]
    assert all(error < 0.01 for error in columns['localizer.position_error_m'])


def test_a_sweep_whose_recorder_dies_ends_with_the_reason(
    ros_domain: int, tmp_path: Path
) -> None:
    sweep, bag = tmp_path / 'sweep.yaml', tmp_path / 'bag'
    sweep.write_text(SWEEP)
    bag.mkdir()
    launch = NodeProcess(
        ['ros2', 'launch', 'fisheye_svp_ros', 'sweep.launch.py', f'sweep:={sweep}', f'bag:={bag}'],
        dict(os.environ),
    )
    assert launch.finish() != 0
    text = '\n'.join(launch.lines)
    assert 'a recording cannot be written there' in text and 'ended with status 2' in text


def test_a_choice_that_is_none_is_refused(ros_domain: int) -> None:
    launch = NodeProcess(
        ['ros2', 'launch', 'fisheye_svp_ros', 'mono.launch.py', 'svp:=maybe'], dict(os.environ))
    assert launch.finish() != 0
    assert 'maybe' in '\n'.join(launch.lines) and 'process started' not in '\n'.join(launch.lines)


def test_everything_goes_below_a_namespace(graph: Graph) -> None:
    results = graph.hear(DiagnosticArray, '/robot/mono/localizer/result')
    launch = NodeProcess(
        ['ros2', 'launch', 'fisheye_svp_ros', 'whole.launch.py', 'namespace:=robot'],
        dict(os.environ))
    try:
        graph.until(lambda: results)
        launch.finish(signal.SIGINT)
    finally:
        if launch.process.poll() is None:
            launch.process.kill()


@pytest.mark.parametrize('name', FILES)
def test_a_launch_file_starts_nodes_that_give_results_and_end_cleanly(
    name: str, graph: Graph
) -> None:
    results = {
        node: graph.hear(DiagnosticArray, f'{node}/result') for node in FILES[name]
    }
    launch = NodeProcess(
        ['ros2', 'launch', 'fisheye_svp_ros', name, 'lens:=fish180', 'svp:=false'],
        dict(os.environ),
    )
    try:
        graph.until(lambda: all(results.values()))
        for heard in results.values():
            values = {pair.key: float(pair.value) for pair in heard[0].status[0].values}
            error = values.get('position_error_m', values.get('error3_m'))
            assert error is not None and error < 1e-8
        launch.finish(signal.SIGINT)
    finally:
        if launch.process.poll() is None:
            launch.process.kill()
    text = '\n'.join(launch.lines)
    assert 'Traceback' not in text and 'has died' not in text
    assert text.count('process has finished cleanly') == text.count('process started with pid')
