"""Commands whose output nobody reads: all files are written, and there is no traceback."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import unread
from helpers.nodes import hears_sigint, need_ros
from helpers.targets import plane, poses_around
from rosbags.typesys import Stores, get_typestore

from fisheye_svp_ros.cli import COMMANDS, main
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.io.bags import BagWriter
from fisheye_svp_ros.io.lens_files import load_lens, save_lens
from fisheye_svp_ros.io.readers import write_observations
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.optics.curves import Equidistant, Gennery
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.simulate.simulation import simulate

DIAGNOSTICS = 'diagnostic_msgs/msg/DiagnosticArray'
BOARD = ('--board', 'chessboard:9x6:25mm')
ROOM = ('--room', '0.1', '0.5', '--count', '1')
SIZE = ('--image-size', '1536x1536', '--model', 'equidistant')
CALIBRATE = ('calibrate', '{obs}', *SIZE, '-o', '{out}/lens.yaml')
RUNS = {  # of each command: its words, a file that it writes
    'budget': (('budget', '--lens', '{small}', '-o', '{out}'), 'budget.json'),
    'calibrate': (CALIBRATE, 'lens.calibrate.html'),
    'demo': (('demo', '--lenses', 'fish180', '--radii', '0.2', '-o', '{out}'), 'demo.json'),
    'detect': (('detect', '{photographs}', *BOARD, '-o', '{out}/seen.csv'), 'seen.detect.json'),
    'diagnose': (
        ('diagnose', '{obs}', '--lens', '{lens}', '--quick', '-o', '{out}'),
        'diagnosis.json',
    ),
    'example': (('example', '-o', '{out}'), 'README.md'),
    'lens': (('lens', '{lens}', '-o', '{out}/cv.yaml', '--format', 'opencv'), 'cv.yaml'),
    'localize': (('localize', '{obs}', '--lens', '{lens}', '-o', '{out}'), 'localize.json'),
    'plan': (
        ('plan', '--lens', '{small}', *BOARD, *ROOM, '-o', '{out}'),
        'plan.pdf',
    ),
    'plot': (('plot', '{table}', '-o', '{out}'), 'error_against_radius.png'),
    'render': (
        ('render', '--lens', '{small}', *BOARD, '--count', '1', '-o', '{out}'),
        'observations.csv',
    ),
    'sweep': (('sweep', '{sweep}', '-o', '{out}'), 'sweep.csv'),
    'table': (('table', '{bag}', '-o', '{out}'), 'table.json'),
    'undistort': (('undistort', '{small}', '{photographs}', '-o', '{out}'), 'undistort.json'),
}
# Take long: test/paper runs the one, without a reader, a tutorial's test the other.
LONG = {'paper', 'map'}
NODES = {
    'record': ('record', '-o', '{out}/bag'),
    'run': ('run', 'localizer'),
    'watch': ('watch',),
}
SWEEP = 'synthetic_camera: {ros__parameters: {sweep.seed: [1, 2], noise_px: 0.2}}\n'


@pytest.fixture(scope='module')
def given(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return input files by name."""
    folder, rng = tmp_path_factory.mktemp('given'), np.random.default_rng(4)
    names = ('obs.csv', 'lens.yaml', 'small.yaml', 'sweep.yaml', 'table.csv', 'photographs', 'bag')
    paths = {name.partition('.')[0]: folder / name for name in names}
    lens = load_lens(lens_path('fish214'))
    table = simulate(
        ForwardModel(lens), plane(), poses_around(plane(), 5, rng, widest=0.5), 0.1, rng
    )
    write_observations(paths['obs'], table)
    save_lens(lens, paths['lens'])
    small = Lens(
        'small', 480, 450, 160.0, 160.0, 240.0, 223.0, Equidistant(), 1.6, Gennery(e0=0.004)
    )
    save_lens(small, paths['small'])
    paths['sweep'].write_text(SWEEP)
    paths['table'].write_text('radius,localizer.position_error_m\n0.2,1.0\n0.5,2.0\n')
    words = (
        '--lens',
        str(paths['small']),
        *BOARD,
        '--count',
        '2',
        '-o',
        str(paths['photographs']),
    )
    assert main(['render', *words]) == 0
    store = get_typestore(Stores.ROS2_JAZZY)
    kinds = {name.rpartition('/')[2]: kind for name, kind in store.types.items()}
    header = kinds['Header'](kinds['Time'](0, 5), '')
    status = kinds['DiagnosticStatus'](0, 'n', '', '', [kinds['KeyValue']('rms_px', '1.0')])
    message = kinds['DiagnosticArray'](header, [status])
    with BagWriter(paths['bag']) as bag:
        data = bytes(store.serialize_cdr(message, DIAGNOSTICS))
        bag.write('/localizer/result', DIAGNOSTICS, data)
    return paths


def test_every_command_is_here() -> None:
    assert {*RUNS, *NODES, *LONG} == {*COMMANDS}


@pytest.mark.parametrize('name', RUNS)
def test_without_a_reader_every_file_is_written(
    name: str,
    given: dict[str, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr('fisheye_svp_ros.commands.demo.missing_rclpy', lambda: 'not asked for')
    words, file = RUNS[name]
    with unread():
        assert main([word.format(out=tmp_path / 'out', **given) for word in words]) == 141
    assert (tmp_path / 'out' / file).exists()
    assert all(': note: ' in line for line in capsys.readouterr().err.splitlines())


@pytest.mark.parametrize('name', ['calibrate', 'diagnose', 'localize'])
def test_without_a_reader_of_errors_every_file_is_written(
    name: str, given: dict[str, Path], tmp_path: Path
) -> None:
    words, file = RUNS[name]
    with unread('stderr'):
        assert main([word.format(out=tmp_path, **given) for word in words]) == 0
        assert main(['lens', str(tmp_path / 'missing')]) == 2
    assert (tmp_path / file).exists()


@pytest.mark.parametrize('name', NODES)
def test_nodes_end_without_a_reader(name: str, tmp_path: Path) -> None:
    need_ros()
    reading, writing = os.pipe()
    os.close(reading)
    words = [word.format(out=tmp_path) for word in NODES[name]]
    process = subprocess.Popen(
        [sys.executable, '-m', 'fisheye_svp_ros', *words],
        stdout=writing,
        stderr=writing,
        preexec_fn=hears_sigint,
    )
    os.close(writing)
    time.sleep(4)
    process.send_signal(signal.SIGINT)
    assert process.wait(60) in (0, 2, 130, 141)  # 1: a traceback


@pytest.mark.parametrize(
    ('closing', 'status'),
    [('>&-', 0), ('2>&-', 0), ('>&- 2>&- <&-', 0), ('| true', 141), ('>/dev/full', 2)],
)
def test_closed_streams(closing: str, status: int, given: dict[str, Path], tmp_path: Path) -> None:
    command = f'"$0" -m fisheye_svp_ros localize "$1" --lens "$2" -o "$3" {closing}'
    ended = subprocess.run(
        ['bash', '-o', 'pipefail', '-c', command, sys.executable]
        + [str(path) for path in (given['obs'], given['lens'], tmp_path / 'out')],
        stderr=subprocess.PIPE,
        text=True,
    )
    assert ended.returncode == status
    assert len(ended.stderr.splitlines()) == (status == 2)
    assert {path.name for path in (tmp_path / 'out').iterdir()} == {
        'covariance.csv',
        'localize.json',
        'poses.csv',
        'residuals.csv',
    }


def test_letters_that_a_terminal_does_not_have_end_no_command(
    given: dict[str, Path], tmp_path: Path
) -> None:
    folder = tmp_path / 'é\udcff'
    ended = subprocess.run(
        [
            sys.executable,
            '-m',
            'fisheye_svp_ros',
            'lens',
            given['lens'],
            '-o',
            folder / 'lens.yaml',
        ],
        env={**os.environ, 'PYTHONIOENCODING': 'ascii'},
        capture_output=True,
        text=True,
        check=True,
    )
    assert '\\xe9\\udcff' in ended.stdout and (folder / 'lens.yaml').exists()
