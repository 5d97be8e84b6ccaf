"""What commands write: all of it or none, whatever happens to disk and process."""

from __future__ import annotations

import errno
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.commands import refused
from helpers.targets import plane, poses_around
from matplotlib.figure import Figure

from benchmark.hardening import kills
from fisheye_svp_ros.cli import COMMANDS as COMMAND_NAMES
from fisheye_svp_ros.cli import main
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import OutputError
from fisheye_svp_ros.io.files import keep_existing, write_text, write_together, written
from fisheye_svp_ros.io.image_files import write_png
from fisheye_svp_ros.io.lens_files import load_lens, save_lens
from fisheye_svp_ros.io.readers import write_observations
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.nodes import NODES
from fisheye_svp_ros.simulate.simulation import simulate

SWEEP = 'synthetic_camera: {ros__parameters: {sweep.seed: [1, 2, 3], noise_px: 0.2}}\n'
COMMANDS = {
    'localize': ('localize', '{obs}', '--lens', '{lens}', '-o', '{out}'),
    'calibrate': (
        'calibrate',
        '{obs}',
        '--image-size',
        '1536x1536',
        '--model',
        'equidistant',
        '-o',
        '{out}/new.yaml',
    ),
    'sweep': ('sweep', '{sweep}', '-o', '{out}'),
    'plot': ('plot', '{table}', '-o', '{out}'),
    'plan': (
        'plan',
        '--lens',
        'fish180',
        '--board',
        'chessboard:4x3:25mm',
        '--room',
        '0.1',
        '0.5',
        '--count',
        '1',
        '-o',
        '{out}',
    ),
    'render': (
        'render',
        '--lens',
        'fish180',
        '--board',
        'chessboard:4x3:25mm',
        '--count',
        '1',
        '-o',
        '{out}',
    ),
}

NUMBERS = {  # what commands write before they draw
    'calibrate': ['new.calibrate.json', 'new.yaml'],
    'plan': ['plan.json', 'poses.csv'],
}
DRAWING = {
    'budget --lens fish180 -o {out}': ['budget.json'],
    'calibrate {obs} --image-size 1536x1536 --model equidistant -o {out}/new.yaml': [
        'new.calibrate.html',
        'new.calibrate.json',
        'new.yaml',
    ],
    'diagnose {obs} --lens {lens} --quick -o {out}': [
        'diagnosis.json',
        'extended_lens.yaml',
        'report.html',
        'residuals.csv',
    ],
    'plan --lens fish180 --board chessboard:4x3:25mm --room 0.1 0.5 --count 1 -o {out}': [
        'plan.json',
        'poses.csv',
    ],
    'undistort fish214 --size 64x64 -o {out}': [
        'camera_info.yaml',
        'maps.npz',
        'maps.yml',
        'mask.png',
        'undistort.json',
    ],
}


@pytest.fixture(scope='module')
def given(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return input files by name."""
    folder, rng = tmp_path_factory.mktemp('given'), np.random.default_rng(4)
    paths = {
        name: folder / f'{name}{suffix}'
        for name, suffix in (
            ('obs', '.csv'),
            ('lens', '.yaml'),
            ('sweep', '.yaml'),
            ('table', '.csv'),
        )
    }
    lens = load_lens(lens_path('fish214')).svp()
    write_observations(
        paths['obs'],
        simulate(ForwardModel(lens), plane(), poses_around(plane(), 5, rng, widest=0.5), 0.1, rng),
    )
    save_lens(lens, paths['lens'])
    paths['sweep'].write_text(SWEEP)
    paths['table'].write_text(
        'radius,noise_px,localizer.rms_px\n'
        + ''.join(
            f'{radius},{noise},{radius * noise}\n' for radius in (0.2, 2) for noise in (0.1, 0.3)
        )
    )
    return paths


def words(name: str, given: dict[str, Path], out: Path) -> list[str]:
    return [word.format(out=out, **given) for word in COMMANDS[name]]


@contextmanager
def full_at(size: int) -> Iterator[None]:
    """Have no file grow beyond a size, in bytes."""
    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, old[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)


def results(folder: Path) -> list[str]:
    """Return the names of all files but the parts of a sweep, which are kept for --resume."""
    return sorted(
        path.name for path in folder.rglob('*') if path.is_file() and path.parent.name != 'parts'
    )


@pytest.mark.parametrize('name', COMMANDS)
@pytest.mark.parametrize('size', [0, 700, 4000])
def test_on_a_full_disk_there_is_one_line_and_no_file(
    name: str,
    size: int,
    given: dict[str, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / 'out'
    with full_at(size):
        code = main(words(name, given, out))
    err = [line for line in capsys.readouterr().err.splitlines() if ': note: ' not in line]
    if code:
        assert code == 2 and len(err) == 1
        assert 'cannot be written (' in err[0] and 'File too large' in err[0]
        assert results(out) in ([], NUMBERS.get(name))
    else:
        assert not err and results(out)


@pytest.mark.parametrize('line', DRAWING)
def test_a_picture_that_cannot_be_drawn_costs_a_note(
    line: str,
    given: dict[str, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise RuntimeError('no font')

    monkeypatch.setattr(Figure, 'savefig', fail)
    out = tmp_path / 'out'
    assert main([word.format(out=out, **given) for word in line.split()]) == 0
    assert results(out) == DRAWING[line]
    assert "cannot be drawn (RuntimeError: 'no font'); all other" in capsys.readouterr().err
    for page in out.glob('*.html'):
        assert 'src=""' not in page.read_text() and '<img' not in page.read_text()


def test_a_calibration_of_a_table_loads_no_recordings(
    given: dict[str, Path], tmp_path: Path
) -> None:
    arguments = ['calibrate', str(given['obs']), '--image-size', '1536x1536', '-o', 'new.yaml']
    code = (
        f'import sys; from fisheye_svp_ros.cli import main; main({arguments}); '
        'print({"mcap", "rosbags"} & {*sys.modules})'
    )
    ran = subprocess.run(
        [sys.executable, '-c', code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert ran.stdout.splitlines()[-1] == 'set()'


@pytest.mark.parametrize('backend', ['module://matplotlib_inline.backend_inline', 'foo'])
def test_pictures_do_not_depend_on_the_backend_of_the_environment(
    backend: str, given: dict[str, Path], tmp_path: Path
) -> None:
    out = tmp_path / 'out'
    # A style of the user's that needs LaTeX is not that of these pictures either.
    (tmp_path / 'matplotlibrc').write_text('text.usetex: True')
    subprocess.run(
        [sys.executable, '-m', 'fisheye_svp_ros.cli', *words('plot', given, out)],
        env={**os.environ, 'MPLBACKEND': backend, 'MATPLOTLIBRC': str(tmp_path), 'PATH': ''},
        check=True,
    )
    assert 'error_against_radius.png' in results(out)


@pytest.mark.filterwarnings('error')
def test_rectified_images_may_have_one_pixel(tmp_path: Path) -> None:
    assert main(['undistort', 'fish214', '--size', '1x1', '-o', str(tmp_path)]) == 0


def png(path: Path, side: int = 1536) -> bytes:
    """Write a photograph of a user; return its bytes."""
    write_png(path, np.eye(side, dtype=np.uint8))
    return path.read_bytes()


def test_photographs_are_not_replaced(
    given: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / 'out'
    render = words('render', given, folder)
    assert main(render) == 0 and main(render) == 0  # the same ones are no loss
    whole = {path: path.read_bytes() for path in folder.iterdir()}
    assert 'another file is there' in refused(capsys, *render, '--seed', '3')
    assert {path: path.read_bytes() for path in folder.iterdir()} == whole
    mine = png(tmp_path / 'camera' / '000.png')
    given_png = tmp_path / 'given' / '000.png'
    png(given_png)
    for command in (
        words('render', given, tmp_path / 'camera'),
        ['undistort', str(given['lens']), str(given_png), '-o', str(tmp_path / 'camera')],
        ['example', '-o', str(tmp_path / 'shown')],
    ):
        if command[0] == 'example':
            mine = png(tmp_path / 'shown' / 'photographs' / '013.png')
        assert 'another file is there' in refused(capsys, *command)
    assert results(tmp_path / 'camera') == ['000.png']
    assert results(tmp_path / 'shown') == ['013.png']
    assert (tmp_path / 'camera' / '000.png').read_bytes() == mine


def test_overlays_do_not_replace_photographs_of_others(tmp_path: Path) -> None:
    mine = png(tmp_path / '000.png')
    with pytest.raises(OutputError, match='another file is there'), keep_existing():
        write_png(tmp_path / '000.png', np.zeros((3, 4), np.uint8))
    with keep_existing(False):
        write_png(tmp_path / 'new.png', np.zeros((3, 4), np.uint8))
    assert (tmp_path / '000.png').read_bytes() == mine


@pytest.mark.parametrize('name', ['localize', 'calibrate', 'plot', 'render', 'sweep'])
def test_a_symbolic_link_is_written_through(
    name: str, given: dict[str, Path], tmp_path: Path
) -> None:
    linked, out = tmp_path / 'linked', tmp_path / 'out'
    assert main(words(name, given, tmp_path / 'plain')) == 0
    out.mkdir()
    for file in results(tmp_path / 'plain'):  # links to files that are to be made
        (out / file).symlink_to(linked / file)
    assert main(words(name, given, out)) == 0
    assert results(linked) == results(tmp_path / 'plain')
    assert all(path.is_symlink() for path in out.iterdir() if path.is_file())
    # A link to a folder that is not there
    (tmp_path / 'folder').symlink_to(tmp_path / 'made')
    assert main(words(name, given, tmp_path / 'folder')) == 0
    assert results(tmp_path / 'made') == results(linked)


def test_links_in_a_circle_and_links_to_the_input(
    given: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / 'a.yaml').symlink_to(tmp_path / 'b.yaml')
    (tmp_path / 'b.yaml').symlink_to(tmp_path / 'a.yaml')
    (tmp_path / 'c.yaml').symlink_to(given['lens'])
    lens = ['lens', str(given['lens']), '-o']
    assert 'links' in refused(capsys, *lens, tmp_path / 'a.yaml')
    assert 'overwrite the input' in refused(capsys, *lens, tmp_path / 'c.yaml')
    old = tmp_path / 'old.yaml'
    old.write_text('old')
    (tmp_path / 'd.yaml').symlink_to('old.yaml')
    assert main([*lens, str(tmp_path / 'd.yaml')]) == 0
    assert (tmp_path / 'd.yaml').is_symlink() and old.read_bytes() == given['lens'].read_bytes()


@pytest.mark.parametrize('number', [errno.EACCES, errno.EROFS, errno.ENOSPC, errno.EDQUOT])
def test_where_nothing_can_be_written_there_is_one_line(
    number: int,
    given: dict[str, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr('tempfile.mkstemp', fail)
    assert main(words('localize', given, tmp_path / 'out')) == 2
    assert f'cannot be written ({os.strerror(number)})' in capsys.readouterr().err.splitlines()[-1]


def test_a_set_of_files_appears_together(tmp_path: Path) -> None:
    one, two = tmp_path / 'a' / 'one', tmp_path / 'two'
    write_text(two, 'old')
    with pytest.raises(ZeroDivisionError), write_together():
        write_text(one, 'new')
        write_text(two, 'new')
        assert not one.exists() and written(one).read_text() == 'new'
        raise ZeroDivisionError
    assert results(tmp_path) == ['two'] and two.read_text() == 'old'
    with pytest.raises(OutputError, match='cannot be written'), write_together():
        write_text(one, 'new')
        with full_at(2):
            write_text(two, 'new')
    assert results(tmp_path) == ['two'] and two.read_text() == 'old'
    with write_together():
        write_text(one, 'new')
        write_text(one, 'newer')
        write_text(two, 'new')
    assert (one.read_text(), two.read_text()) == ('newer', 'new')
    assert results(tmp_path) == ['one', 'two'] and written(one) == one


def test_a_signal_among_the_renames_waits_for_the_last(tmp_path: Path) -> None:
    one, two = tmp_path / 'one', tmp_path / 'two'
    # Whoever runs the tests in the background has it ignored.
    replace, before = Path.replace, signal.signal(signal.SIGINT, signal.default_int_handler)

    def interrupted(self: Path, target: Path) -> Path:
        signal.raise_signal(signal.SIGINT)
        return replace(self, target)

    with pytest.raises(KeyboardInterrupt), pytest.MonkeyPatch.context() as patched:
        patched.setattr(Path, 'replace', interrupted)
        with write_together():
            write_text(one, 'new')
            write_text(two, 'new')
    assert results(tmp_path) == ['one', 'two']
    assert signal.signal(signal.SIGINT, before) is signal.default_int_handler


@pytest.mark.parametrize('name', ['localize', 'plot', 'plan', 'render'])
def test_a_command_that_is_told_to_end_leaves_nothing(
    name: str, given: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced, before = [], signal.getsignal(signal.SIGTERM)

    def end(stream: Any) -> None:
        synced.append(stream)
        if len(synced) == 2:  # one file is whole, the second nearly so
            signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(os, 'fsync', end)
    with pytest.raises(SystemExit) as ended:
        main(words(name, given, tmp_path / 'out'))
    assert ended.value.code == 128 + signal.SIGTERM
    assert not results(tmp_path)
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_command_that_is_killed_leaves_all_or_nothing(
    given: dict[str, Path], tmp_path: Path
) -> None:
    begun = time.monotonic()
    assert kills.done(words('localize', given, tmp_path / 'whole')) == (0, '')
    length, outcome = time.monotonic() - begun, kills.Outcome()
    whole, rest = kills.files(tmp_path / 'whole')
    assert 'localize.json' in whole and not rest
    for number, (how, part) in enumerate(
        (
            (signal.SIGTERM, 0.5),
            (signal.SIGTERM, 0.95),
            (signal.SIGKILL, 0.9),
            (signal.SIGKILL, 0.97),
        )
    ):
        out = tmp_path / str(number)
        kills.kill(words('localize', given, out), out, how, part * length, whole, outcome)
    assert not outcome.told


def test_what_a_kill_can_leave_is_seen(tmp_path: Path) -> None:
    (tmp_path / '.a.csv.x1.csv').write_text('half')
    (tmp_path / 'parts').mkdir()
    (tmp_path / 'parts' / '0.json').write_text('kept for --resume')
    outcome = kills.Outcome()
    script = """
import os, subprocess
os.setsid()
subprocess.Popen(['sleep', '60'], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
print(os.getpid())
"""
    lost = subprocess.run(
        [sys.executable, '-c', script], stdout=subprocess.PIPE, text=True, check=True
    )
    orphans = kills.left_running(int(lost.stdout))
    assert len(orphans) == 1
    os.kill(orphans[0], signal.SIGKILL)
    assert kills.files(tmp_path) == ({}, ['.a.csv.x1.csv'])
    outcome.fault('part', 'SIGKILL after 1 s')
    assert '| plan | 0 | 0 | 0 | 0 | 1 |' in kills.section({'plan': outcome}, {}, {}, 'so')


def test_every_command_and_node_is_killed() -> None:
    started = [words[:2] for words in kills.NODES.values()]
    assert {*kills.COMMANDS, *(words[0] for words in started)} == {*COMMAND_NAMES}
    assert {words[1] for words in started if words[0] == 'run'} == {*NODES}
