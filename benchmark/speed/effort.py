"""Table: processor time of calibrations and diagnoses of real corners, beside other tools."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from scipy import linalg

from benchmark.peers.calibrations import PEERS, NotHereError
from benchmark.peers.compare import timed
from benchmark.peers.sets import grid_of, table_set
from benchmark.speed.commands import ONE_CORE, all_cores
from benchmark.speed.report import Table, number
from fisheye_svp_ros.io.lens_files import load_lens

SETS, SIZE = ('ov_plane', 'ov_cube'), (1280, 800)
TOOLS = ('OpenCV, fisheye', 'mrcal, CAHVORE', 'mrcal, splined 16 x 11')
COLUMNS, FACTORIZATIONS = 1500, 60
_TIMED = 6  # of these
_BESIDE = Path(__file__).resolve().parents[3] / 'shared' / 'data'
_DATA = Path(os.environ.get('FISHEYE_SVP_DATA', _BESIDE))
_TEXT = f"""Processor seconds on one thread of BLAS, each once: a command with start and report,
another tool's fit alone. "Unit": {FACTORIZATIONS} Cholesky factorizations of {COLUMNS} columns,
from {_TIMED} before and {_TIMED} after each line; machines compare by the ratio."""


def tables() -> list[Table]:
    """Return the table of the sets that are there."""
    rows, notes = [], []
    for name in SETS:
        if not (_DATA / name).is_dir():
            notes.append(f'{name}: not there, and not measured.')
            continue
        with tempfile.TemporaryDirectory() as folder:
            for work, run in _works(_DATA / name, Path(folder)):
                try:
                    rows.append((work, name, *_effort(run)))
                except NotHereError as reason:
                    notes.append(f'{work} did not take part on {name}: {reason}.')
    header = ('work', 'on', 'processor, s', 'unit, s', 'units')
    return [Table('Effort', header, rows, _TEXT, notes)]


def unit() -> float:
    """Return the processor seconds of the factorizations that others are measured by."""
    rng = np.random.default_rng(0)
    columns = rng.normal(size=(COLUMNS, COLUMNS))
    matrix = columns @ columns.T + COLUMNS * np.eye(COLUMNS)
    start = time.process_time()  # finer than what counts child processes, too
    for _ in range(_TIMED):
        linalg.cholesky(matrix, lower=True, check_finite=False)
    return (time.process_time() - start) * FACTORIZATIONS / _TIMED


def _effort(run: Callable[[], object]) -> tuple[str, str, str]:
    """Return seconds of a run, of a unit beside it, and their ratio."""
    before = unit()
    with timed() as clock:
        run()
    mean = (before + unit()) / 2
    return number(clock.seconds), number(mean), number(clock.seconds / mean)


def _works(data: Path, folder: Path) -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield what is measured on a set; files go into a folder."""
    lens, train = folder / 'lens.yaml', data / 'train.csv'
    size = 'x'.join(map(str, SIZE))
    yield '`calibrate`', lambda: _command('calibrate', train, '-o', lens, '--image-size', size)
    known = ('diagnose', train, '--lens', lens, '--held-out', data / 'test.csv')
    yield '`diagnose`', lambda: _command(*known, '-o', folder / 'diagnosis')
    yield '`diagnose --quick`', lambda: _command(*known, '--quick', '-o', folder / 'quick')
    corners = table_set(data, SIZE)
    grid, focal = grid_of(corners), load_lens(lens).fx
    for tool in TOOLS:
        yield tool, partial(PEERS[tool], corners, grid, focal)


def _command(*words: str | Path) -> None:
    """Run a command of the package on one thread of BLAS."""
    subprocess.run(
        [sys.executable, '-m', 'fisheye_svp_ros.cli', *map(str, words)],
        check=True,
        env=all_cores() | dict.fromkeys(ONE_CORE, '1'),
        stdout=subprocess.DEVNULL,
    )
