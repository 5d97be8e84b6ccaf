"""Table: how long people wait for the commands, each run once."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from benchmark.speed.report import Table, number
from benchmark.speed.scenes import on_board, shift_lens
from fisheye_svp_ros.io.csv_files import write_observations
from fisheye_svp_ros.io.lens_files import save_lens
from fisheye_svp_ros.optics.engines import VARIABLE

ONE_CORE = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'NUMBA_NUM_THREADS')
_SHARED = Path(__file__).parents[3] / 'shared' / 'data'
_CORNERS = {'ov_plane': 13.0, 'ov_cube': 10.0}  # and goals of their diagnosis, s
_PHOTOGRAPHS = _SHARED / 'photos' / 'chessboard'
_BOARD, _OTHER_BOARD = 'chessboard:6x4:30mm', 'chessboard:11x8:30mm'
_COMMAND = (sys.executable, '-m', 'fisheye_svp_ros.cli')
_THERE = b'fx '  # of the progress line, once the lens is fitted
_PROVISIONAL = b'Provisional: '
_IN_A_SCRIPT = """
import sys
import numpy as np
import fisheye_svp_ros as fsvp
np.ones((500, 500)) @ np.ones((500, 500))  # BLAS starts its threads
fsvp.calibrate(sys.argv[1], 'kannala_brandt', (1280, 800))
"""
_TEXT = """Each once, with all cores, on the clock. A goal with × is a multiple of the row before.
"Until the lens is printed": `calibrate` computes its errors and the report after that. "Until a
provisional headline": of a part of the points, on a terminal."""


class _Work(NamedTuple):
    """A line of the table: a name, what is run, and a goal, s, or times the line before."""

    name: str
    run: Callable[[], float]
    goal: float | None = None
    times: float | None = None


def tables() -> list[Table]:
    """Return the table."""
    rows: list[tuple[str, str, str, str]] = []
    before = np.nan
    with tempfile.TemporaryDirectory() as name:
        for work in _works(Path(name)):
            try:
                seconds = work.run()
            except subprocess.CalledProcessError as error:
                rows.append((work.name, f'ended with {error.returncode}', '', 'no'))
                continue
            limit = work.goal or (work.times or np.inf) * before
            text = f'{work.goal:g}' if work.goal else f'{work.times:g} ×' if work.times else ''
            met = ('yes' if seconds <= limit else 'no') if text else ''
            rows.append((work.name, number(seconds), text, met))
            before = seconds
    absent = [
        path.name
        for path in (*(_SHARED / one for one in _CORNERS), _PHOTOGRAPHS)
        if not path.is_dir()
    ]
    notes = [f'{", ".join(absent)}: not there, and not measured.'] if absent else []
    return [Table('Commands', ('command', 'time, s', 'goal, s', 'met'), rows, _TEXT, notes)]


def _works(folder: Path) -> Iterator[_Work]:
    """Yield what people wait for; files go into a folder."""
    yield _command(folder, '--help', goal=0.2)
    yield _command(folder, 'demo -o demo', goal=15)
    yield _command(folder, 'paper -o paper', goal=20)
    search = 'photographs --board chessboard:9x6:25mm'
    yield _command(folder, 'example -o .', goal=19)
    yield _command(folder, f'calibrate {search} -o lens.yaml', goal=6.5)
    yield _command(folder, f'diagnose {search} --lens lens.yaml -o diagnosis', goal=11.5)
    for name in _CORNERS:
        if (_SHARED / name).is_dir():
            yield from _measured_corners(folder, name)
    yield from _simulated_corners(folder)
    if _PHOTOGRAPHS.is_dir():
        yield from _photographs(folder)
    checked = '`make check`, with the installation where none is there'
    yield _Work(checked, lambda: _seconds(['make', 'check'], Path.cwd()), 120)
    yield _Work('`make test`', lambda: _seconds(['make', 'test'], Path.cwd()), 360)


def _measured_corners(folder: Path, name: str) -> Iterator[_Work]:
    """Yield the calibration of a set of corners, until its lens is printed and whole, and more."""
    train, test = (_SHARED / name / f'{part}.csv' for part in ('train', 'test'))
    options = '--model kannala_brandt --image-size 1280x800'
    line = f'calibrate {train} -o {name}.yaml {options}'
    yield _Work(
        f'{_shown(line)}, {name}, until the lens is printed',
        lambda: _seconds_until(line, folder, _THERE),
        1,
    )
    yield _command(folder, line, f', {name}', 3)
    yield _Work(
        f'`fsvp.calibrate` with threads of BLAS, {name}',
        lambda: _seconds([sys.executable, '-c', _IN_A_SCRIPT, str(train)], folder),
        times=1.2,
    )
    answer = f'diagnose {train} --lens {name}.yaml --held-out {test} -o diagnosis'
    yield _command(folder, answer, f', {name}', _CORNERS[name])
    yield _command(folder, f'{answer} --quick', f', {name}', 4)
    yield _Work(
        f'{_shown(answer)}, {name}, until a provisional headline',
        lambda: _seconds_until(answer, folder, _PROVISIONAL),
        4,
    )


def _simulated_corners(folder: Path) -> Iterator[_Work]:
    """Yield the calibration of few points, and diagnoses of many and of a rig."""
    table, _ = on_board(17, 64, 1)
    write_observations(folder / 'few.csv', table)
    line = 'calibrate few.csv -o few.yaml --model kannala_brandt --image-size 1536x1536'
    yield _command(folder, line, ', 1 088 points', 1.5)
    for what, frames, landmarks, cameras, goal in (
        ('20 000 points', 20, 1024, 1, 30.0),
        ('2 cameras of 29 views', 29, 64, 2, 10.0),
    ):
        table, names = on_board(frames, landmarks, cameras)
        path = folder / f'simulated{cameras}.csv'
        write_observations(path, table)
        save_lens(shift_lens().svp(), folder / 'svp.yaml')
        lenses = ' '.join(f'--lens {one}=svp.yaml' for one in names)
        yield _command(folder, f'diagnose {path} {lenses} -o diagnosis', f', {what}', goal)


def _photographs(folder: Path) -> Iterator[_Work]:
    """Yield searches for a board that is there, one that is not, and one in negatives."""
    negatives = folder / 'negatives'
    negatives.mkdir()
    for path in _PHOTOGRAPHS.glob('*.jpg'):
        cv2.imwrite(str(negatives / path.name), 255 - cv2.imread(str(path)))
    for where, board, what, times, code in (
        (_PHOTOGRAPHS, _BOARD, '', None, 0),
        (negatives, _BOARD, ', in negatives', 1.5, 0),
        (_PHOTOGRAPHS, _BOARD, '', None, 0),
        (_PHOTOGRAPHS, _OTHER_BOARD, ', which is not there', 2, 2),
    ):
        yield _command(
            folder, f'detect {where} --board {board} -o corners.csv', what, None, times, code
        )


def _command(
    folder: Path,
    line: str,
    what: str = '',
    goal: float | None = None,
    times: float | None = None,
    code: int = 0,
) -> _Work:
    return _Work(
        f'{_shown(line)}{what}',
        lambda: _seconds([*_COMMAND, *line.split()], folder, code),
        goal,
        times,
    )


def _shown(line: str) -> str:
    words = ' '.join(Path(word).name if '/' in word else word for word in line.split())
    return f'`fisheye-svp {words}`'


def all_cores() -> dict[str, str]:
    """Return the environment without the limit to one core, an engine and a ROS 2."""
    left_out = ('PYTHONPATH', VARIABLE, *ONE_CORE)
    return {k: v for k, v in os.environ.items() if k not in left_out}


def _seconds(command: Sequence[str], folder: Path, code: int = 0) -> float:
    """Return how long a command takes; raise CalledProcessError for another exit code."""
    start = time.perf_counter()
    run = subprocess.run(
        command, check=False, cwd=folder, env=all_cores(), stdout=subprocess.DEVNULL
    )
    if run.returncode != code:
        raise subprocess.CalledProcessError(run.returncode, command)
    return time.perf_counter() - start


def _seconds_until(line: str, folder: Path, text: bytes) -> float:
    """Return how long a command takes until it prints a text to a terminal."""
    terminal, end = pty.openpty()
    start, seen = time.perf_counter(), b''
    with subprocess.Popen(
        [*_COMMAND, *line.split()],
        cwd=folder,
        env=all_cores(),
        stderr=end,
        stdout=subprocess.DEVNULL,
    ) as process:
        os.close(end)
        while text not in seen:
            seen += os.read(terminal, 4096)
        seconds = time.perf_counter() - start
        process.terminate()
    os.close(terminal)
    return seconds
