"""Recordings between this package and rosbag2, and the time that it plays."""

from __future__ import annotations

import os
import re
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from helpers.graph import LATCHED, Graph
from helpers.nodes import NodeProcess

from diagnostic_msgs.msg import DiagnosticArray  # isort: skip
from sensor_msgs.msg import PointCloud2  # isort: skip
from rclpy.serialization import serialize_message  # isort: skip

from fisheye_svp_ros.io import bags
from fisheye_svp_ros.io.bags import Bag, BagWriter, OfferedQos
from fisheye_svp_ros.io.columns import plain_columns
from fisheye_svp_ros.io.decoding import read_key_values
from fisheye_svp_ros.io.recording import is_tabulated, tabulate
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.localizer import Localizer
from fisheye_svp_ros.nodes.recorder import Recorder
from fisheye_svp_ros.nodes.watcher import Watcher
from fisheye_svp_ros.simulate.scenario import Scenario, simulate_scenario

SETS = 3
CLOUD = 'sensor_msgs/msg/PointCloud2'
OURS = sys.executable, '-m', 'fisheye_svp_ros.cli'


@pytest.fixture
def process(start_process: Callable[..., NodeProcess]) -> Callable[..., NodeProcess]:
    """Return a function that starts a command."""
    return lambda *words: start_process(list(words), dict(os.environ))


@pytest.fixture
def rosbag2() -> Any:
    """Return the Python interface of rosbag2."""
    return pytest.importorskip('rosbag2_py', reason='rosbag2 is not installed (ros-jazzy-rosbag2)')


def test_without_a_clock_simulated_time_silences_no_diagnostics(
    graph: Callable[..., Graph],
) -> None:
    g = graph('use_sim_time:=true')
    diagnostics = g.hear(DiagnosticArray, '/diagnostics')
    g.start(Localizer)
    g.until(lambda: diagnostics)
    assert 'use_sim_time is true, but /clock' in diagnostics[0].status[0].message


def test_simulated_time_that_stands_still_stops_neither_recorder_nor_watcher(
    graph: Callable[..., Graph], tmp_path: Path
) -> None:
    g = graph('use_sim_time:=true')
    with BagWriter(tmp_path / 'bag') as bag:
        recorder = g.start(lambda: Recorder(bag, re.compile('/localizer/.*')))
        watcher = g.start(Watcher)
        g.probe.create_publisher(DiagnosticArray, '/localizer/result', 10)
        g.until(lambda: recorder.topics and watcher.results, 20)


def write_sets(bag: BagWriter, pause: Callable[[], None]) -> None:
    """Write landmarks, latched, and then sets of image points."""
    simulation = simulate_scenario(Scenario(lens='fish180'))
    seen = simulation.observations
    landmarks = messages.landmarks_message(simulation.landmarks, 0, 'world')
    bag.add('/landmarks', CLOUD, [OfferedQos(latched=True)])
    bag.write('/landmarks', CLOUD, bytes(serialize_message(landmarks)))
    for stamp in range(1, SETS + 1):
        pause()
        points = messages.image_points_message(seen.landmark, seen.uv, stamp, 'camera')
        bag.write('/image_points', CLOUD, bytes(serialize_message(points)))


def test_rosbag2_knows_a_recording_and_indexes_one_that_was_cut_short(
    rosbag2: Any, tmp_path: Path
) -> None:
    path = tmp_path / 'bag'
    with BagWriter(path) as bag:
        write_sets(bag, bag.flush)
        (whole,), unfinished = path.glob('*.mcap'), tmp_path / 'cut'
        bag.flush()
        unfinished.mkdir()
        (unfinished / 'cut_0.mcap').write_bytes(whole.read_bytes())
    rosbag2.Reindexer().reindex(rosbag2.StorageOptions(uri=str(unfinished), storage_id='mcap'))
    for one in (path, unfinished):
        known = rosbag2.Info().read_metadata(str(one), 'mcap')
        topics = {t.topic_metadata.name: t for t in known.topics_with_message_count}
        assert {name: t.message_count for name, t in topics.items()} == {
            '/landmarks': 1,
            '/image_points': SETS,
        }
        assert len(topics['/landmarks'].topic_metadata.offered_qos_profiles) == 1


@pytest.mark.parametrize('more', [(), ('--clock', '50', '--loop')])
def test_who_comes_late_to_a_recording_that_is_played_hears_its_landmarks(
    graph: Callable[..., Graph],
    process: Callable[..., NodeProcess],
    rosbag2: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    more: tuple[str, ...],
) -> None:
    now = [10**9]
    monkeypatch.setattr(bags, 'time', SimpleNamespace(time_ns=lambda: now[0]))

    def pause() -> None:
        now[0] += 4 * 10**9 if now[0] == 10**9 else 10**8

    with BagWriter(tmp_path / 'bag') as bag:
        bag.add('/image_points', CLOUD)
        bag.flush()  # as the recorder does, which knows topics before their messages
        write_sets(bag, pause)
    g = graph('lens:=fish180', f'use_sim_time:={bool(more)}'.lower(), 'patience:=0.1')
    results = g.hear(DiagnosticArray, 'localizer/result')
    played = g.hear(PointCloud2, 'landmarks', LATCHED)
    player = process('ros2', 'bag', 'play', str(tmp_path / 'bag'), *more)
    g.until(lambda: played)
    g.start(Localizer)
    g.until(lambda: len(results) >= SETS + bool(more))
    assert all(float(read_key_values(m)['rms_px']) < 1e-6 for m in results)
    assert player.finish(signal.SIGINT if more else None) == 0


@pytest.mark.parametrize(
    'form',
    [
        ('-s', 'mcap'),
        ('-s', 'sqlite3', '--compression-mode', 'file', '--compression-format', 'zstd'),
    ],
)
def test_a_table_of_what_rosbag2_recorded_is_that_of_our_own_recording(
    process: Callable[..., NodeProcess], rosbag2: Any, tmp_path: Path, form: tuple[str, ...]
) -> None:
    theirs, own = tmp_path / 'theirs', tmp_path / 'own'
    recorders = [
        process('ros2', 'bag', 'record', *form, '-a', '-o', str(theirs)),
        process(*OURS, 'record', '-o', str(own)),
    ]
    localizer = process(*OURS, 'run', 'localizer', '--ros-args', '-p', 'wait_for_subscribers:=3')
    camera = process(
        *OURS,
        'run',
        'synthetic_camera',
        '--ros-args',
        '-p',
        'wait_for_subscribers:=3',
        '-p',
        'repeat:=false',
        '-p',
        'rate:=2.0',
        '-p',
        'lock_step:=localizer/result',
        '-p',
        'sweep.radius:=[2.0, 0.5, 0.2]',
    )
    assert camera.finish() == 0
    assert [one.finish(signal.SIGINT) for one in (localizer, *recorders)] == [0, 0, 0]
    tables = [plain_columns(tabulate(Bag(path).records(is_tabulated))) for path in (theirs, own)]
    assert tables[0] == tables[1] and tables[0]['radius'] == [2.0, 0.5, 0.2]
    assert all(error < 0.1 for error in tables[0]['localizer.position_error_m'])
