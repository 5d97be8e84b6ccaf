"""Table: how long the commands take, each run once."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from benchmark.speed.report import Table, number
from fisheye_svp_ros.optics.engines import VARIABLE

ONE_CORE = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'NUMBA_NUM_THREADS')
_MEASURED = [Path(__file__).parents[3] / 'shared' / 'data' / name
             for name in ('ov_plane', 'ov_cube')]
_TEXT = (
    'Each once, with all cores. `calibrate` prints the lens before its errors are known; its time '
    'is that of all, with the report.'
)


def tables() -> list[Table]:
    """Return the table."""
    rows, notes = [], []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rows.append(_timed(['--help'], 0.2))
        rows.append(_timed(['demo', '-o', str(folder / 'demo')], 15))
        rows.append(_timed(['paper', '-o', str(folder / 'paper')], 20))
        for data in _MEASURED:
            if data.is_dir():
                rows += _measured(data, folder)
            else:
                notes.append(f'{data.name} is not there: nothing was diagnosed.')
    return [Table('Commands', ('command', 'time, s', 'goal, s', 'met'), rows, _TEXT, notes)]


def _measured(data: Path, folder: Path) -> list[tuple[str, str, str, str]]:
    """Return the rows of measured data: a calibration with its errors, and a diagnosis."""
    train, test, lens = str(data / 'train.csv'), str(data / 'test.csv'), folder / 'lens.yaml'
    return [
        _timed(['calibrate', train, '-o', str(lens), '--model', 'kannala_brandt',
                '--image-size', '1280x800'], 2, data.name),
        _timed(['diagnose', train, '--lens', str(lens), '--held-out', test,
                '-o', str(folder / 'diagnosis')], 10, data.name)]


def all_cores() -> dict[str, str]:
    """Return the environment without the limit to one core, an engine and a ROS 2."""
    left_out = ('PYTHONPATH', VARIABLE, *ONE_CORE)
    return {k: v for k, v in os.environ.items() if k not in left_out}


def _timed(
    arguments: Sequence[str], goal: float, data: str = ''
) -> tuple[str, str, str, str]:
    start = time.perf_counter()
    run = subprocess.run(
        [sys.executable, '-m', 'fisheye_svp_ros.cli', *arguments], check=False,
        stdout=subprocess.DEVNULL, env=all_cores(),
    )
    seconds = time.perf_counter() - start
    words = ' '.join(Path(word).name if '/' in word else word for word in arguments)
    name = f'`fisheye-svp {words}`{data and f", {data}"}'
    if run.returncode:
        return name, f'ended with {run.returncode}', '', 'no'
    return name, number(seconds), f'{goal:g}', 'yes' if seconds <= goal else 'no'
