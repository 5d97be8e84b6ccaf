"""The launch files, on an installed ROS 2 in which this package is installed."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from helpers.nodes import ROOT, TIMEOUT, NodeProcess, hears_sigint

pytest.importorskip('launch_ros')
from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from helpers.graph import Graph
from helpers.photographs import BOARD, LENS, poses

from fisheye_svp_ros.io.bags import Bag
from fisheye_svp_ros.io.columns import plain_columns
from fisheye_svp_ros.io.csv_files import write_observations
from fisheye_svp_ros.io.decoding import read_key_values
from fisheye_svp_ros.io.lens_files import save_lens
from fisheye_svp_ros.io.recording import is_tabulated, tabulate
from fisheye_svp_ros.pose import quaternion_from_rotation
from fisheye_svp_ros.simulate.scenario import Scenario, simulate_scenario

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
    noise_px: 0
    sweep.radius: [2, 1]
    sweep.environment: [whole, inner]
localizer: {ros__parameters: {svp: true}}
"""


@pytest.fixture
def launch(ros_domain: int) -> Iterator[Callable[..., NodeProcess]]:
    """Return a function that launches a file of this package."""
    started: list[NodeProcess] = []

    def start(*words: str) -> NodeProcess:
        started.append(
            NodeProcess(['ros2', 'launch', 'fisheye_svp_ros', *words], dict(os.environ))
        )
        return started[-1]

    yield start
    for one in started:
        if one.process.poll() is None:
            one.process.send_signal(signal.SIGINT)
            one.process.wait(60)


@pytest.fixture
def graph(ros_domain: int) -> Iterator[Graph]:
    """Return a graph with nothing but a probe."""
    one = Graph()
    yield one
    one.close()


def test_every_launch_file_is_tested() -> None:
    files = {path.name for path in (SHARE / 'launch').glob('*.launch.py')}
    assert files == {*FILES, 'sweep.launch.py', 'camera.launch.py'}


def test_fisheye_svp_is_on_the_path_of_a_workspace() -> None:
    # Behind `ros2 run` a job of a shell would outlive its `kill`.
    program = SHARE.parents[1] / 'bin' / 'fisheye-svp'
    told = subprocess.run([program, '--help'], capture_output=True, text=True, check=True)
    assert told.stdout.startswith('usage: fisheye-svp')
    assert shutil.which('fisheye-svp')


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
    columns = plain_columns(tabulate(Bag(bag).records(is_tabulated)))
    assert columns['scenario'] == [0, 1, 2, 3] and columns['radius'] == [2.0, 2.0, 1.0, 1.0]
    assert all(error < 0.01 for error in columns['localizer.position_error_m'])


def test_a_sweep_whose_recorder_dies_ends_with_the_reason(ros_domain: int, tmp_path: Path) -> None:
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


@pytest.mark.parametrize(
    ('word', 'reason'),
    [
        ('svp:=maybe', 'maybe'),
        ('params:=nothere.yaml', "params: no file 'nothere.yaml'"),
        ('localizer_params:=/', "localizer_params: no file '/'"),
    ],
)
def test_an_argument_that_cannot_be_used_is_refused(
    launch: Callable[..., NodeProcess], word: str, reason: str
) -> None:
    mono = launch('mono.launch.py', word)
    assert mono.finish() != 0
    text = '\n'.join(mono.lines)
    assert reason in text and 'process started' not in text


def test_observations_without_a_measured_camera_are_refused(
    launch: Callable[..., NodeProcess],
) -> None:
    mono = launch('mono.launch.py', 'observations:=seen.csv')
    assert mono.finish() != 0
    assert 'add camera:=measured_camera' in '\n'.join(mono.lines)


def test_observations_are_replayed(
    launch: Callable[..., NodeProcess], graph: Graph, tmp_path: Path
) -> None:
    seen = simulate_scenario(Scenario(shift_scale=0.0)).observations
    write_observations(tmp_path / 'seen.csv', seen)
    results = graph.hear(DiagnosticArray, '/localizer/result')
    launch(
        'mono.launch.py',
        'camera:=measured_camera',
        f'observations:={tmp_path}/seen.csv',
        'lens:=fish214',
        'svp:=true',
    )
    graph.until(lambda: any(read_key_values(m).get('rms_px') for m in results))


def test_an_argument_wins_over_what_files_say_of_the_node(
    launch: Callable[..., NodeProcess], tmp_path: Path
) -> None:
    params = tmp_path / 'mine.yaml'
    params.write_text(
        '/**: {ros__parameters: {lens: fish214}}\n'
        'localizer: {ros__parameters: {lens: fish214, svp: true}}\n'
        '/robot/localizer: {ros__parameters: {lens: fish214}}\n'
    )
    mono = launch(
        'mono.launch.py',
        'namespace:=robot',
        'lens:=fish180',
        'svp:=false',
        f'localizer_params:={params}',
    )
    mono.wait_for(r'solving with the lens fish180 with its viewpoint shift \(svp: false\)')


@pytest.mark.parametrize('composed', ['true', 'false'])
def test_a_camera_may_be_composed_in_one_process(
    launch: Callable[..., NodeProcess], graph: Graph, tmp_path: Path, composed: str
) -> None:
    params = tmp_path / 'mine.yaml'
    params.write_text('/**: {ros__parameters: {patience: 7}}')
    camera = launch(
        'camera.launch.py',
        'namespace:=robot',
        'image:=/camera/image_raw',
        'board:=chessboard:5x4:30mm',
        f'localizer_params:={params}',
        f'composed:={composed}',
        'world_frame:=map',
    )
    graph.until(
        lambda: (
            {('detector', '/robot'), ('localizer', '/robot'), ('model_critic', '/robot')}
            <= {*graph.probe.get_node_names_and_namespaces()}
        )
    )
    graph.until(
        lambda: len(graph.probe.get_subscriptions_info_by_topic('/camera/image_raw/compressed'))
    )
    said = '\n'.join(camera.lines)
    for _ in range(3):
        camera.wait_for('listening to ')
    said = '\n'.join(camera.lines)
    assert said.count('process started with pid') == (1 if composed == 'true' else 3)
    assert '/camera/camera_info' in said and 'is unknown to this node' not in said


def test_the_commands_of_the_documentation_show_metrics(
    launch: Callable[..., NodeProcess], graph: Graph
) -> None:
    results = graph.hear(DiagnosticArray, '/localizer/result')
    text = (ROOT / 'docs' / 'reference' / 'nodes.md').read_text(encoding='utf-8')
    block = text.partition('<!-- a test with an installed ROS 2 runs this -->')[2].split('```')[1]
    commands = block.splitlines()[1:]
    assert len(commands) == 5
    launch('mono.launch.py')
    graph.until(lambda: results)
    for command in commands:
        for _ in range(5):  # the daemon of ros2cli may not know of the topics yet
            done = subprocess.run(command.split(), capture_output=True, text=True, timeout=TIMEOUT)
            if done.returncode == 0:
                break
        assert done.returncode == 0 and done.stdout.strip(), (command, done.stderr)
    subprocess.run(['ros2', 'daemon', 'stop'], capture_output=True, timeout=TIMEOUT)


def test_everything_goes_below_a_namespace(graph: Graph) -> None:
    results = graph.hear(DiagnosticArray, '/robot/mono/localizer/result')
    launch = NodeProcess(
        ['ros2', 'launch', 'fisheye_svp_ros', 'whole.launch.py', 'namespace:=robot'],
        dict(os.environ),
    )
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
    results = {node: graph.hear(DiagnosticArray, f'{node}/result') for node in FILES[name]}
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


def test_arguments_reach_the_nodes_and_frames_resolve(
    graph: Graph, launch: Callable[..., NodeProcess], tmp_path: Path
) -> None:
    """Namespace, parameter file, tf2, log level and respawn, as a user composes them."""
    tf2 = pytest.importorskip('tf2_ros')
    from rclpy.time import Time

    params = tmp_path / 'mine.yaml'
    params.write_text(
        '/**: {ros__parameters: {radius: 0.5, world_frame: map, svp: false, publish_tf: true}}'
    )
    buffer = tf2.Buffer()
    tf2.TransformListener(buffer, graph.probe)
    scenarios = graph.hear(DiagnosticArray, '/robot/scenario')
    mono = launch(
        'mono.launch.py',
        'namespace:=robot',
        f'params:={params}',
        'log_level:=debug',
        'respawn:=True',
    )
    pid = int(mono.wait_for(r'\[localizer-\d\]: process started with pid \[(\d+)\]')[1])
    for child in ('robot_camera_optical_frame', 'robot_camera_optical_frame_true'):
        graph.until(lambda child=child: buffer.can_transform('map', child, Time()))
    between = buffer.lookup_transform(
        'robot_camera_optical_frame_true', 'robot_camera_optical_frame', Time()
    ).transform.translation
    assert max(abs(between.x), abs(between.y), abs(between.z)) < 1e-6
    assert read_key_values(scenarios[0])['radius'] == '0.5'
    os.kill(pid, signal.SIGKILL)
    again = int(mono.wait_for(r'\[localizer-\d\]: process started with pid \[(\d+)\]')[1])
    assert again != pid
    # Interrupted while it starts a process, launch loses the task that waits for its end (its
    # KeyboardInterrupt is raised there), and never ends.
    mono.wait_for(r'\[localizer-\d\] .*solving with the lens')


def test_frames_are_launch_arguments(graph: Graph, launch: Callable[..., NodeProcess]) -> None:
    kind = pytest.importorskip('tf2_msgs.msg').TFMessage
    heard = graph.hear(kind, '/tf')
    launch(
        'mono.launch.py',
        'namespace:=front',
        'publish_tf:=true',
        'world_frame:=map',
        'camera_frame:=eye',
    )
    graph.until(
        lambda: (
            {
                (one.header.frame_id, one.child_frame_id)
                for message in heard
                for one in message.transforms
            }
            == {('map', 'eye'), ('map', 'eye_true')}
        )
    )


def test_a_sweep_that_cannot_be_used_starts_nothing(
    launch: Callable[..., NodeProcess], tmp_path: Path
) -> None:
    sweep = tmp_path / 'sweep.yaml'
    sweep.write_text('synthetic_camera: {ros__parameters: {sweep.radios: [1]}}')
    started = launch('sweep.launch.py', f'sweep:={sweep}', f'bag:={tmp_path / "bag"}')
    assert started.finish() != 0
    text = '\n'.join(started.lines)
    assert 'sweep.radios: no such parameter to sweep' in text and 'process started' not in text
    assert not (tmp_path / 'bag').exists()


def test_a_rig_and_its_points_resolve(graph: Graph, launch: Callable[..., NodeProcess]) -> None:
    tf2 = pytest.importorskip('tf2_ros')
    from rclpy.time import Time

    buffer = tf2.Buffer()
    tf2.TransformListener(buffer, graph.probe)
    launch('stereo.launch.py', 'publish_tf:=true', 'svp:=false')
    for child in ('right_camera_optical_frame', 'left_camera_optical_frame'):
        graph.until(lambda child=child: buffer.can_transform('world', child, Time()))
    rig = buffer.lookup_transform(
        'right_camera_optical_frame', 'left_camera_optical_frame', Time()
    )
    assert rig.transform.translation.x == pytest.approx(-0.15, abs=1e-6)


def test_a_camera_is_localized_with_its_camera_info(
    graph: Graph, launch: Callable[..., NodeProcess], tmp_path: Path
) -> None:
    """Rendered photographs in place of a live camera; its camera_info beside them."""
    lens = tmp_path / 'small.yaml'
    save_lens(LENS, lens)
    pose = poses(1, 4).take(0)
    listed = [float(v) for v in (*pose.position, *quaternion_from_rotation(pose.rotation))]
    results = graph.hear(DiagnosticArray, '/localizer/result')
    program = SHARE.parents[1] / 'lib' / 'fisheye_svp_ros' / 'synthetic_camera'
    camera = NodeProcess(
        [
            str(program),
            '--ros-args',
            '-p',
            'rate:=2.0',
            '-p',
            f'photograph:={BOARD}',
            '-p',
            f'lens:={lens}',
            '-p',
            f'poses:={listed}',
            '-r',
            '__ns:=/camera',
        ],
        dict(os.environ),
    )
    patient = tmp_path / 'patient.yaml'  # a busy machine takes its time
    patient.write_text('detector: {ros__parameters: {longest_search: 60.0}}')
    launch('camera.launch.py', 'image:=/camera/image', f'board:={BOARD}', f'params:={patient}')
    try:
        graph.until(lambda: any(read_key_values(m).get('rms_px') for m in results), 120)
        metrics = next(read_key_values(m) for m in results if read_key_values(m).get('rms_px'))
        # What is left is the viewpoint shift, of which camera_info knows nothing.
        assert 0.0 < float(metrics['rms_px']) < 3.0 and float(metrics['points']) == 30
    finally:
        camera.finish(signal.SIGINT)


def test_the_example_of_a_launch_test_passes(ros_domain: int) -> None:
    pytest.importorskip('launch_testing')
    example = ROOT / 'examples' / 'localizer_launch_test.py'
    done = subprocess.run(
        [sys.executable, '-m', 'launch_testing.launch_test', str(example)],
        capture_output=True,
        text=True,
        preexec_fn=hears_sigint,
    )
    assert done.returncode == 0, done.stdout + done.stderr
