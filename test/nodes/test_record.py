"""Recordings: written, cut short, read, tabulated; observations out of them."""

from __future__ import annotations

import csv
import errno
import json
import os
import signal
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from helpers import graph  # noqa: F401 - skips where there is no rclpy
from helpers.data import DATA, NO_DATA
from helpers.nodes import ROOT, NodeProcess, until
from mcap.reader import make_reader
from mcap.records import Channel
from mcap.stream_reader import StreamReader

from rclpy.serialization import serialize_message  # isort: skip

from fisheye_svp_ros.cli import main
from fisheye_svp_ros.errors import BagError, ObservationError
from fisheye_svp_ros.io import decoding
from fisheye_svp_ros.io.bags import Bag, BagWriter, OfferedQos
from fisheye_svp_ros.io.columns import arrow, plain_columns, read_table
from fisheye_svp_ros.io.decoding import stamp_of
from fisheye_svp_ros.io.lens_files import save_lens
from fisheye_svp_ros.io.readers import read_observations
from fisheye_svp_ros.io.recording import is_tabulated, tabulate
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.recorder import Recorder
from fisheye_svp_ros.simulate.scenario import Scenario, simulate_scenario
from fisheye_svp_ros.solve.lens_calibration import calibrate

DIAGNOSTICS = 'diagnostic_msgs/msg/DiagnosticArray'
CLOUD = 'sensor_msgs/msg/PointCloud2'


def write_results(path: Path, count: int, flush_each: bool = False) -> None:
    """Write scenarios and results of a localizer, results in reverse order of stamps."""
    with BagWriter(path) as bag:
        for n in range(count):
            tag = messages.key_values_message('scenario', {'scenario': n, 'radius': 0.5 * n}, n)
            bag.write('/a/scenario', DIAGNOSTICS, serialize_message(tag))
        for n in reversed(range(count)):
            result = messages.key_values_message('n', {'rms_px': n / 3, 'points': 33.0}, n)
            bag.write('/a/localizer/result', DIAGNOSTICS, serialize_message(result))
            if flush_each:
                bag.flush()


def test_a_table_is_a_join_on_stamps(tmp_path: Path) -> None:
    write_results(tmp_path / 'bag', 7)
    bag = Bag(tmp_path / 'bag')
    columns = plain_columns(tabulate(bag.records(is_tabulated)))
    assert columns == {
        'namespace': ['/a'] * 7,
        'stamp_ns': list(range(7)),
        'scenario': list(range(7)),
        'radius': [0.5 * n for n in range(7)],
        'localizer.rms_px': [n / 3 for n in range(7)],
        'localizer.points': [33.0] * 7,
    }
    assert bag.damage == ''


def test_results_without_scenarios_and_of_two_nodes_are_rows_as_well(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'bag') as bag:
        for node, value in (('/x/left/localizer', 1.0), ('/x/stereo_depth', 2.0)):
            message = messages.key_values_message('n', {'rms_px': value}, 5)
            bag.write(f'{node}/result', DIAGNOSTICS, serialize_message(message))
        failed = messages.key_values_message('n', {}, 6, 'too few points', b'\x01')
        bag.write('/x/stereo_depth/result', DIAGNOSTICS, serialize_message(failed))
    columns = plain_columns(tabulate(Bag(tmp_path / 'bag').records(is_tabulated)))
    assert columns['namespace'] == ['/x', '/x', '/x/left'] and columns['stamp_ns'] == [5, 6, 5]
    assert columns['stereo_depth.rms_px'] == [2.0, None, None]
    assert columns['stereo_depth.note'] == [None, 'too few points', None]
    assert columns['localizer.rms_px'] == [None, None, 1.0]


def test_why_a_set_has_no_solution_and_what_is_doubtful_are_columns_apart(tmp_path: Path) -> None:
    texts = {
        1: 'frame 1 has 3 usable points in it; 4 are needed',
        2: 'frame 2 has 3 usable points in it; 4 are needed',
        3: 'the residuals are 5.25 times what sigma allows (60 degrees of freedom)',
        4: 'the residuals are 7 times what sigma allows (58 degrees of freedom)',
        5: 'outliers rejected: landmarks 3 (5.2 px), 5 (2 px)',
    }
    with BagWriter(tmp_path / 'bag') as bag:
        for stamp, text in texts.items():
            values = {'rms_px': 1.0} if stamp > 2 else {}
            message = messages.key_values_message('n', values, stamp, text, b'\x01')
            bag.write('/localizer/result', DIAGNOSTICS, serialize_message(message))
    columns = plain_columns(tabulate(Bag(tmp_path / 'bag').records(is_tabulated)))
    assert columns['localizer.note'] == [
        *['the set has 3 usable points in it; 4 are needed'] * 2,
        *[None] * 3,
    ]
    assert columns['localizer.warning'] == [
        *[None] * 2,
        *['the residuals are # times what sigma allows (# degrees of freedom)'] * 2,
        'outliers rejected: landmarks #',
    ]
    assert columns['localizer.warning_number'] == [None, None, 5.25, 7.0, 3.0]


def test_a_full_disk_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    message = serialize_message(messages.key_values_message('n', {'rms_px': 1.0}, 5))
    with BagWriter(tmp_path / 'bag') as bag:
        bag.write('/x/result', DIAGNOSTICS, message)
        monkeypatch.setattr(bag._writer, 'write', full)
        with pytest.raises(BagError, match=r'bag: cannot be written \(No space left'):
            bag.write('/x/result', DIAGNOSTICS, message)


def test_a_node_belongs_to_the_nearest_scenario_above_it(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'bag') as bag:
        for base, radius in (('/x', 1.0), ('/x/left', 2.0)):
            tag = messages.key_values_message('scenario', {'radius': radius}, 5)
            bag.write(f'{base}/scenario', DIAGNOSTICS, serialize_message(tag))
        for node in ('/x/left/localizer', '/x/right/localizer'):
            message = messages.key_values_message('n', {'rms_px': 3.0}, 5)
            bag.write(f'{node}/result', DIAGNOSTICS, serialize_message(message))
    assert plain_columns(tabulate(Bag(tmp_path / 'bag').records(is_tabulated))) == {
        'namespace': ['/x', '/x/left'],
        'stamp_ns': [5, 5],
        'radius': [1.0, 2.0],
        'right/localizer.rms_px': [3.0, None],
        'localizer.rms_px': [None, 3.0],
    }


def test_the_command_writes_csv_parquet_and_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_results(tmp_path / 'bag', 5)
    assert main(['table', str(tmp_path / 'bag'), '-o', str(tmp_path / 'out')]) == 0
    out, err = capsys.readouterr()
    assert '5 rows' in out and 'localizer.rms_px' in out and (err == '' or arrow()[1] in err)
    with (tmp_path / 'out' / 'table.csv').open() as stream:
        rows = list(csv.DictReader(stream))
    assert [float(row['localizer.rms_px']) for row in rows] == [n / 3 for n in range(5)]
    if arrow()[0] is not None:
        table = plain_columns(read_table(tmp_path / 'out' / 'table.parquet'))
        assert table['localizer.rms_px'] == [n / 3 for n in range(5)]
        assert table['stamp_ns'] == list(range(5))
    document = json.loads((tmp_path / 'out' / 'table.json').read_text())
    assert document['rows'] == 5 and document['damage'] == ''


def test_the_command_prints_all_columns_in_the_width_of_the_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    metrics = [f'a_metric_with_a_long_name_{i}_m' for i in range(30)]
    with BagWriter(tmp_path / 'bag') as bag:
        for n in range(3):
            tag = messages.key_values_message('scenario', {'radius': 0.5 * n}, n)
            bag.write('/scenario', DIAGNOSTICS, serialize_message(tag))
            result = messages.key_values_message('n', dict.fromkeys(metrics, n / 3), n)
            bag.write('/localizer/result', DIAGNOSTICS, serialize_message(result))
    monkeypatch.setenv('COLUMNS', '100')
    monkeypatch.setenv('NO_COLOR', '1')
    monkeypatch.setenv('TERM', 'dumb')
    monkeypatch.setattr('sys.stdout.isatty', lambda: True, raising=False)
    monkeypatch.chdir(tmp_path)
    assert main(['table', 'bag']) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 100
    headers = [line.split() for line in lines if 'localizer.' in line]
    assert [name for _, *names in headers for name in names] == [
        f'localizer.{name}' for name in metrics
    ]
    assert {first for first, *_ in headers} == {'radius'}


@pytest.mark.parametrize('part', [0.35, 0.6, 0.9, 0.999])
def test_a_recording_that_was_cut_short_yields_what_is_whole(
    tmp_path: Path, part: float, capsys: pytest.CaptureFixture[str]
) -> None:
    write_results(tmp_path / 'bag', 40, flush_each=True)
    whole = len(tabulate(Bag(tmp_path / 'bag').records(is_tabulated)))
    (file,) = (tmp_path / 'bag').glob('*.mcap')
    data = file.read_bytes()
    file.write_bytes(data[: int(part * len(data))])
    (tmp_path / 'bag' / 'metadata.yaml').unlink()
    bag = Bag(tmp_path / 'bag')
    columns = plain_columns(tabulate(bag.records(is_tabulated)))
    assert 'only its intact parts are read' in bag.damage
    known = [v for v in columns.get('localizer.rms_px', []) if v is not None]
    assert len(columns['stamp_ns']) == whole
    # Results were written from the last stamp to the first: the first are what is lost.
    assert known == [n / 3 for n in range(40)][40 - len(known) :]
    if part > 0.5:
        assert known
    assert main(['table', str(tmp_path / 'bag')]) == 0
    assert 'note: ' in capsys.readouterr().err


def test_where_a_recording_ends_early_the_place_and_the_remedy_are_named(tmp_path: Path) -> None:
    """Also where the chunk that is cut short has no checksum: half a message is none."""
    write_results(tmp_path / 'bag', 40, flush_each=True)
    (file,) = (tmp_path / 'bag').glob('*.mcap')
    with file.open('rb') as stream:
        index = make_reader(stream).get_summary().chunk_indexes[30]
    data = bytearray(file.read_bytes()[: index.chunk_start_offset + index.chunk_length - 3])
    checksum = index.chunk_start_offset + 9 + 24
    data[checksum : checksum + 4] = bytes(4)
    file.write_bytes(data)
    bag = Bag(file)
    assert len(list(bag.records(lambda *_: True))) == 40 + 30  # the first holds all scenarios
    assert bag.damage.endswith(
        f'{file.name} cannot be read from byte {index.chunk_start_offset} on (it ends early); '
        f'`mcap recover {file.name} -o FILE` may save more'
    )


def test_who_waits_is_told_how_far_the_reading_is(tmp_path: Path) -> None:
    write_results(tmp_path / 'bag', 40, flush_each=True)
    bag, passed = Bag(tmp_path / 'bag'), []
    assert list(bag.records(is_tabulated, passed.append)) and len(passed) > 40
    assert 0.5 * bag.size < sum(passed) <= bag.size and min(passed) >= 0


def test_no_flipped_bit_changes_a_table_in_silence(tmp_path: Path) -> None:
    write_results(tmp_path / 'bag', 12, flush_each=True)
    (file,) = (tmp_path / 'bag').glob('*.mcap')
    good, rng = file.read_bytes(), np.random.default_rng(5)
    table = plain_columns(tabulate(Bag(tmp_path / 'bag').records(is_tabulated)))
    told = 0
    for place in rng.choice(8 * len(good), 400, replace=False).tolist():
        bad = bytearray(good)
        bad[place // 8] ^= 1 << place % 8
        file.write_bytes(bad)
        bag = Bag(tmp_path / 'bag')
        try:
            same = plain_columns(tabulate(bag.records(is_tabulated))) == table
        except (BagError, ObservationError):
            same = False
            bag.damage = bag.damage or 'refused'
        assert same or bag.damage, place
        told += bool(bag.damage)
    assert told > 200, 'most of the file is messages'


def test_a_chunk_that_became_a_footer_is_no_end(tmp_path: Path) -> None:
    write_results(tmp_path / 'bag', 3)
    (file,) = (tmp_path / 'bag').glob('*.mcap')
    data = bytearray(file.read_bytes())
    chunk = 8 + 9 + int.from_bytes(data[9:17], 'little')
    assert data[chunk] == 6
    data[chunk] = 2
    file.write_bytes(data)
    with pytest.raises(BagError, match=r'not a recording, or no part of it is intact'):
        list(Bag(tmp_path / 'bag').records(is_tabulated))


def test_what_is_whole_after_the_damage_is_read_once_and_the_place_is_named(
    tmp_path: Path,
) -> None:
    write_results(tmp_path / 'bag', 40, flush_each=True)
    (file,) = (tmp_path / 'bag').glob('*.mcap')
    data = bytearray(file.read_bytes())
    place = data.index(b'rms_px', len(data) // 2)
    data[place] ^= 1
    file.write_bytes(data)
    bag = Bag(tmp_path / 'bag')
    records = list(bag.records(is_tabulated))
    # One chunk holds one result; the scenarios are in the first.
    assert len(records) == 79 and len({(r.topic, stamp_of(r.message)) for r in records}) == 79
    assert 'is damaged (crc validation failed' in bag.damage and 'at byte' in bag.damage


def test_reading_takes_little_memory_however_long_the_recording(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'bag') as bag:
        long = messages.key_values_message('scenario', {'text': 1_000_000 * 'x'}, 1)
        big = serialize_message(long)
        for _ in range(40):
            bag.write('/scenario', DIAGNOSTICS, big)
    tracemalloc.start()
    count = sum(1 for _ in Bag(tmp_path / 'bag').records(is_tabulated))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert count == 40 and peak < 15e6


def test_no_chunk_is_without_messages(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'bag') as bag:
        bag.add('/landmarks', CLOUD)
        bag.flush()
        bag.write('/scenario', DIAGNOSTICS, b'')
        bag.flush()
        bag.add('/image_points', CLOUD)
    with (tmp_path / 'bag' / 'bag_0.mcap').open('rb') as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None and len(summary.channels) == 3
    assert [len(chunk.message_index_offsets) for chunk in summary.chunk_indexes] == [1]


def metadata(bag: Path) -> dict[str, Any]:
    """Return what metadata.yaml says of each topic."""
    text = yaml.safe_load((bag / 'metadata.yaml').read_text())
    topics = text['rosbag2_bagfile_information']['topics_with_message_count']
    return {one['topic_metadata']['name']: one['topic_metadata'] for one in topics}


def test_a_recording_says_what_its_types_are_where_rosbag2_looks_for_it(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'bag') as bag:
        bag.write('/landmarks', CLOUD, b'')
        bag.flush()
        (unfinished,) = (tmp_path / 'bag').glob('*.mcap')
        with unfinished.open('rb') as stream:
            early = next(one for one in StreamReader(stream).records if isinstance(one, Channel))
    with unfinished.open('rb') as stream:
        (late,) = make_reader(stream).get_summary().channels.values()
    wanted = 'RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5'
    assert metadata(tmp_path / 'bag')['/landmarks']['type_description_hash'] == wanted
    assert early.metadata == late.metadata and late.metadata['topic_type_hash'] == wanted


def test_a_recording_says_what_its_publishers_offered(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'bag') as bag:
        bag.add('/landmarks', CLOUD, [OfferedQos(latched=True)])
        bag.add('/camera_info', 'sensor_msgs/msg/CameraInfo', [OfferedQos(reliable=False)])
    topics = {
        topic: one['offered_qos_profiles'] for topic, one in metadata(tmp_path / 'bag').items()
    }
    (latched,), (plain,) = topics['/landmarks'], topics['/camera_info']
    assert latched['durability'] == 'transient_local' and latched['reliability'] == 'reliable'
    assert plain['durability'] == 'volatile' and plain['reliability'] == 'best_effort'


@pytest.mark.parametrize(
    ('make', 'reason'),
    [
        (lambda path: None, 'no such recording; check the path'),
        (lambda path: path.mkdir(), 'no .mcap or .db3 file in this folder'),
        (
            lambda path: (path.mkdir(), (path / 'x.mcap').write_bytes(b'')),
            'not a recording, or no part of it is intact',
        ),
        (
            lambda path: (path.mkdir(), (path / 'x.mcap').write_bytes(os.urandom(5000))),
            'not a recording, or no part of it is intact',
        ),
        (
            lambda path: (
                path.mkdir(),
                (path / 'x.mcap').write_bytes(b'\x89MCAP0\r\n' + b'\5' * 999),
            ),
            'not a recording, or no part of it is intact',
        ),
    ],
)
def test_what_is_no_recording_is_refused(
    tmp_path: Path,
    make: Callable[[Path], None],
    reason: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    make(tmp_path / 'bag')
    assert main(['table', str(tmp_path / 'bag')]) == 2
    error = capsys.readouterr().err
    assert reason in error and error.count('\n') == 1


def test_a_recording_without_results_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with BagWriter(tmp_path / 'bag') as bag:
        message = messages.number_message(1.0)
        bag.write('/x', 'std_msgs/msg/Float64', serialize_message(message))
    assert main(['table', str(tmp_path / 'bag')]) == 2
    assert 'it holds neither scenarios nor results' in capsys.readouterr().err


def test_a_recording_is_never_overwritten(tmp_path: Path) -> None:
    write_results(tmp_path / 'bag', 1)
    with pytest.raises(BagError, match='a recording cannot be written there'):
        BagWriter(tmp_path / 'bag')


def write_observations(path: Path, scenario: Scenario, namespace: str = '/x') -> Any:
    simulation = simulate_scenario(scenario)
    table = simulation.observations
    with BagWriter(path) as bag:
        for stamp, frame in enumerate(table.frames, 1):
            landmarks = messages.landmarks_message(simulation.landmarks, 0, 'world')
            bag.write(f'{namespace}/landmarks', CLOUD, serialize_message(landmarks))
            for number, name in enumerate(table.cameras):
                mine = table.take((table.frame == frame) & (table.camera == number))
                message = messages.image_points_message(mine.landmark, mine.uv, stamp, '')
                topic = '/'.join(filter(None, (namespace, name, 'image_points')))
                bag.write(topic, CLOUD, serialize_message(message))
    return table


@pytest.mark.parametrize('style', ['mono', 'parallel'])
def test_observations_come_back_from_a_recording(tmp_path: Path, style: str) -> None:
    wanted = write_observations(
        tmp_path / 'bag', Scenario(poses_file='calibration', style=style, noise_px=0.3)
    )
    table = read_observations(tmp_path / 'bag')
    assert table.cameras == wanted.cameras
    for name in ('frame', 'landmark', 'uv', 'xyz', 'camera'):
        assert np.array_equal(getattr(table, name), getattr(wanted, name)), name
    assert np.array_equal(np.unique(table.t), np.arange(1, 11) / 1e9)


def test_observations_of_two_worlds_are_refused(tmp_path: Path) -> None:
    write_results(tmp_path / 'bag', 1)
    with pytest.raises(ObservationError, match='landmarks are in: none'):
        read_observations(tmp_path / 'bag')


@pytest.fixture
def command(start_process: Callable[..., NodeProcess]) -> Callable[..., NodeProcess]:
    """Return a function that starts `fisheye-svp ARGUMENTS`."""

    def run(*arguments: str) -> NodeProcess:
        env = os.environ | {'PYTHONUNBUFFERED': '1'}
        env['PYTHONPATH'] = os.pathsep.join([str(ROOT), env.get('PYTHONPATH', '')])
        words = [sys.executable, '-m', 'fisheye_svp_ros.cli', *arguments]
        return start_process(words, env)

    return run


def test_the_recorder_writes_every_message_until_it_is_interrupted(
    command: Callable[..., NodeProcess], tmp_path: Path
) -> None:
    recorder = command('record', '-o', str(tmp_path / 'bag'))
    camera = command(
        'run',
        'synthetic_camera',
        '--ros-args',
        '-p',
        'wait_for_subscribers:=1',
        '-p',
        'repeat:=false',
        '-p',
        'rate:=20.0',
        '-p',
        'sweep.seed:=[1, 2, 3, 4, 5]',
        '-p',
        'noise_px:=0.1',
    )
    assert camera.finish() == 0
    assert recorder.finish(signal.SIGINT) == 0
    assert not [line for line in recorder.lines if 'Traceback' in line]
    assert '25 messages on 5 topics' in recorder.lines[-1]
    columns = plain_columns(tabulate(Bag(tmp_path / 'bag').records(is_tabulated)))
    assert columns['seed'] == [1, 2, 3, 4, 5]


def test_a_camera_ends_when_what_it_sent_has_come(
    command: Callable[..., NodeProcess], tmp_path: Path
) -> None:
    """A recorder that is held up gets the last sets, too: they are lost with their publisher."""
    recorder = command('record', '-o', str(tmp_path / 'bag'))
    seeds = [*range(1, 21)]
    camera = command(
        'run',
        'synthetic_camera',
        '--ros-args',
        '-p',
        'wait_for_subscribers:=1',
        '-p',
        'repeat:=false',
        '-p',
        'rate:=20.0',
        '-p',
        f'sweep.seed:={seeds}',
    )
    camera.wait_for('scenario 1 of 20')
    recorder.process.send_signal(signal.SIGSTOP)
    time.sleep(2.0)  # twice as long as all sets take
    recorder.process.send_signal(signal.SIGCONT)
    assert camera.finish() == 0 and recorder.finish(signal.SIGINT) == 0
    columns = plain_columns(tabulate(Bag(tmp_path / 'bag').records(is_tabulated)))
    assert columns['seed'] == seeds


def test_no_empty_recording_is_left_behind(
    ros_domain: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(Recorder, 'spin', lambda *_: None)  # interrupted before anything came
    assert main(['record', '-o', str(tmp_path / 'bag')]) == 2
    assert 'no message arrived on a recorded topic, so nothing is kept' in (
        capsys.readouterr().err
    )
    assert not (tmp_path / 'bag').exists()


def test_a_recorder_that_is_killed_leaves_what_it_has_flushed(
    command: Callable[..., NodeProcess], tmp_path: Path
) -> None:
    recorder = command('record', '-o', str(tmp_path / 'bag'))
    camera = command(
        'run',
        'synthetic_camera',
        '--ros-args',
        '-p',
        'wait_for_subscribers:=1',
        '-p',
        'rate:=300.0',
    )
    file = tmp_path / 'bag' / 'bag_0.mcap'
    until(lambda: file.exists() and file.stat().st_size > 20_000)
    recorder.process.send_signal(signal.SIGKILL)
    recorder.process.wait()
    assert camera.finish(signal.SIGTERM) == 0
    bag = Bag(tmp_path / 'bag')
    assert len(tabulate(bag.records(is_tabulated))) >= 5
    assert 'only its intact parts are read' in bag.damage


def test_a_recorder_has_flushed_what_came_and_ends_while_others_go_on(
    command: Callable[..., NodeProcess], tmp_path: Path
) -> None:
    recorder = command('record', '-o', str(tmp_path / 'bag'))
    arguments = 'run', 'synthetic_camera', '--ros-args', '-p', 'wait_for_subscribers:=1'
    assert command(*arguments, '-p', 'repeat:=false').finish() == 0

    def flushed() -> int:
        with suppress(BagError):
            return len(tabulate(Bag(tmp_path / 'bag').records(is_tabulated)))
        return 0

    until(lambda: flushed() == 1)
    endless = command(*arguments, '-p', 'rate:=20.0')
    until(lambda: flushed() > 1)
    assert recorder.finish(signal.SIGINT) == 0
    assert 'on 5 topics' in recorder.lines[-1] and Bag(tmp_path / 'bag').damage == ''
    assert endless.finish(signal.SIGTERM) == 0


def test_bad_arguments_of_record(command: Callable[..., NodeProcess], tmp_path: Path) -> None:
    (tmp_path / 'bag').mkdir()
    there = command('record', '-o', str(tmp_path / 'bag'))
    assert there.finish() == 2
    assert 'a recording cannot be written there' in there.lines[-1]
    broken = command('record', '-o', str(tmp_path / 'new'), '--topics', '(')
    assert broken.finish() == 2 and 'is not a regular expression' in broken.lines[-1]
    assert not (tmp_path / 'new').exists()


OV_PLANE = DATA / 'ov_plane'


@pytest.mark.skipif(not OV_PLANE.exists(), reason=NO_DATA)
def test_measured_camera_and_localizer_agree_with_the_command(
    command: Callable[..., NodeProcess], tmp_path: Path
) -> None:
    lens = tmp_path / 'lens.yaml'
    table = read_observations(OV_PLANE / 'train.csv')
    few = table.take(table.frame % 4 == 0)  # any lens will do
    save_lens(calibrate(few, 'kannala_brandt', (1280, 800)).adjusted.lens, lens)
    test = str(OV_PLANE / 'test.csv')
    assert main(['localize', test, '--lens', str(lens), '-o', str(tmp_path)]) == 0
    recorder = command('record', '-o', str(tmp_path / 'bag'))
    localizer = command(
        'run', 'localizer', '--ros-args', '-p', f'lens:={lens}', '-p', 'wait_for_subscribers:=2'
    )
    camera = command(
        'run',
        'measured_camera',
        '--ros-args',
        '-p',
        f'observations:={OV_PLANE / "test.csv"}',
        '-p',
        'wait_for_subscribers:=2',
        '-p',
        'repeat:=false',
        '-p',
        'lock_step:=localizer/result',
    )
    assert camera.finish() == 0
    assert recorder.finish(signal.SIGINT) == 0 and localizer.finish(signal.SIGINT) == 0
    with (tmp_path / 'poses.csv').open() as stream:
        wanted = {int(row['frame']): row for row in csv.DictReader(stream)}
    frames, poses = {}, {}
    for record in Bag(tmp_path / 'bag').records(
        lambda topic, _: topic in ('/scenario', '/localizer/pose')
    ):
        stamp = stamp_of(record.message)
        if record.topic == '/scenario':
            frames[stamp] = int(decoding.read_key_values(record.message)['frame'])
        else:
            poses[stamp] = record.message.pose.pose
    assert sorted(frames.values()) == sorted(wanted) and set(poses) == set(frames)
    for stamp, pose in poses.items():
        row = wanted[frames[stamp]]
        position, turn = pose.position, pose.orientation
        ours = [position.x, position.y, position.z, turn.x, turn.y, turn.z, turn.w]
        theirs = [float(row[name]) for name in ('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw')]
        assert np.abs(np.array(ours) - theirs).max() < 1e-9
    assert min(poses) == 26 * 10**9, 'frames carry their own time'


def test_reading_a_recording_needs_no_ros(tmp_path: Path) -> None:
    write_results(tmp_path / 'bag', 3)
    code = (
        'import sys\n'
        'sys.modules["rclpy"] = None\n'
        'from fisheye_svp_ros.cli import main\n'
        f'sys.exit(main(["table", {str(tmp_path / "bag")!r}]))'
    )
    path = os.pathsep.join([str(ROOT), os.environ.get('PYTHONPATH', '')])
    env = os.environ | {'PYTHONPATH': path}
    done = subprocess.run([sys.executable, '-c', code], env=env, capture_output=True, text=True)
    assert done.returncode == 0 and '3 rows' in done.stdout, done.stderr
