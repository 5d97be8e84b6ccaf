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
_OV_PLANE = Path(__file__).parents[3] / 'shared' / 'data' / 'ov_plane'
_TEXT = (
    'Each once, with all cores; the observations are those of ov_plane.'
)


def tables() -> list[Table]:
    """Return the table."""
    rows, notes = [], []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rows.append(_timed(['--help'], 0.2))
        rows.append(_timed(['demo', '-o', str(folder / 'demo')], 60))
        rows.append(_timed(['paper', '-o', str(folder / 'paper')], 20))
        if _OV_PLANE.is_dir():
            train, test = (str(_OV_PLANE / f'{part}.csv') for part in ('train', 'test'))
            lens = str(folder / 'lens.yaml')
            rows.append(_timed(['calibrate', train, '-o', lens, '--model', 'kannala_brandt',
                                '--image-size', '1280x800'], None))
            rows.append(_timed(['diagnose', train, '--lens', lens, '--held-out', test,
                                '-o', str(folder / 'diagnosis')], 60))
        else:
            notes.append('ov_plane is not there: nothing was diagnosed.')
    return [Table('Commands', ('command', 'time, s', 'goal, s', 'met'), rows, _TEXT, notes)]


def all_cores() -> dict[str, str]:
    """Return the environment without the limit to one core, an engine and a ROS 2."""
    left_out = ('PYTHONPATH', VARIABLE, *ONE_CORE)
    return {k: v for k, v in os.environ.items() if k not in left_out}


def _timed(arguments: Sequence[str], goal: float | None) -> tuple[str, str, str, str]:
    start = time.perf_counter()
    run = subprocess.run(
        [sys.executable, '-m', 'fisheye_svp_ros.cli', *arguments], check=False,
        stdout=subprocess.DEVNULL, env=all_cores(),
    )
    seconds = time.perf_counter() - start
    words = ' '.join(Path(word).name if '/' in word else word for word in arguments)
    name = f'`fisheye-svp {words}`'
    if run.returncode:
        return name, f'ended with {run.returncode}', '', 'no'
    if goal is None:
        return name, number(seconds), '', ''
    return name, number(seconds), f'{goal:g}', 'yes' if seconds <= goal else 'no'
