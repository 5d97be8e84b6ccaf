"""Table: sweeps of a thousand to a million scenarios, undisturbed, and killed and resumed."""

from __future__ import annotations

import filecmp
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import NamedTuple

import psutil
import yaml

from benchmark.speed.commands import all_cores
from benchmark.speed.report import Table, number

# Seeds, with 32 cases each: a thousand to a million scenarios; and how often each is run.
_SIZES = ((31, 15), (312, 3), (3125, 1), (31_250, 1))
_CASES = {
    'sweep.shift_scale': [0.5, 1.0, 1.5, 2.0],
    'sweep.radius': [2.0, 1.0, 0.5, 0.2],
    'sweep.noise_px': [0.1, 0.3],
}
_WORKERS = ('--workers', '2')
_WATCH = 0.1  # s
_TEXT = """`fisheye-svp sweep FILE`: one camera, 33 landmarks, swept over `shift_scale`, `radius`,
`noise_px` and `seed`. Each further scenario: without the start. Memory: maximum of all
processes."""


class Run(NamedTuple):
    """A sweep that ended: s of processor and on the clock, and the most memory, MiB."""

    processor: float
    clock: float
    memory: float


def tables() -> list[Table]:
    """Return the table."""
    rows, starts = [], []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        one = _sweep_file(folder, 0)
        for seeds, repeats in _SIZES:
            path = _sweep_file(folder, seeds)
            outs = [folder / f'{path.stem}_{i}' for i in range(repeats)]
            pairs = [(_run(one, out / 'one'), _run(path, out / 'all')) for out in outs]
            starts += [start for start, _ in pairs]
            rows.append(_line(_scenarios(seeds), 'one process', pairs))
        run = _run(path, folder / 'undisturbed', _WORKERS)
        rows.append(_line(_scenarios(seeds), ' '.join(_WORKERS), [(starts[-1], run)]))
        notes = [
            f'The start: {number(median(run.processor for run in starts))} s of processor time.',
            _disturbed(path, folder, run.clock),
        ]
    header = (
        'scenarios',
        'on',
        'on the clock, s',
        'processor, s',
        'each further one, ms',
        'memory, MiB',
    )
    return [Table('Sweeps', header, rows, _TEXT, notes)]


def _line(scenarios: int, on: str, pairs: Sequence[tuple[Run, Run]]) -> tuple[str, ...]:
    """Return the line of sweeps that each were run after one of one scenario."""
    further = median(run.processor - start.processor for start, run in pairs)
    medians = [median(values) for values in zip(*(run for _, run in pairs), strict=True)]
    figures = (medians[1], medians[0], 1e3 * further / (scenarios - 1), medians[2])
    return f'{scenarios}', on, *map(number, figures)


def _disturbed(path: Path, folder: Path, clock: float) -> str:
    """Kill a sweep twice on its way, let it end, and compare with the undisturbed one."""
    out = folder / 'disturbed'
    for resume in ((), ('--resume',)):
        process = _start(path, out, (*_WORKERS, *resume))
        time.sleep(clock / 3)
        tree = [*process.children(recursive=True), process]
        process.kill()
        psutil.wait_procs(tree)
    _run(path, out, (*_WORKERS, '--resume'))
    names = [
        name
        for name in ('sweep.parquet', 'sweep.csv', 'sweep.json')
        if (folder / 'undisturbed' / name).exists()
    ]
    equal, *other = filecmp.cmpfiles(folder / 'undisturbed', out, names, shallow=False)
    same = 'the same files, byte for byte' if not any(other) else f'other files: {other}'
    return (
        'The million on two processes, killed (SIGKILL) after a third of the time and again '
        f'after another, then resumed: {same} ({", ".join(f"`{n}`" for n in equal)}).'
    )


def _scenarios(seeds: int) -> int:
    count = max(seeds, 1)
    for values in _CASES.values() if seeds else ():
        count *= len(values)
    return count


def _sweep_file(folder: Path, seeds: int) -> Path:
    swept = {**_CASES, 'sweep.seed': list(range(seeds))} if seeds else {'sweep.seed': [0]}
    nodes = {'synthetic_camera': {'lens': 'fish180', **swept}, 'localizer': {'svp': True}}
    path = folder / f'scenarios_{_scenarios(seeds)}.yaml'
    path.write_text(yaml.safe_dump({k: {'ros__parameters': v} for k, v in nodes.items()}))
    return path


def _start(path: Path, out: Path, more: Sequence[str] = ()) -> psutil.Popen:
    command = [sys.executable, '-m', 'fisheye_svp_ros.cli', 'sweep', path, '-o', out, *more]
    return psutil.Popen(list(map(str, command)), env=all_cores(), stdout=subprocess.DEVNULL)


def _run(path: Path, out: Path, more: Sequence[str] = ()) -> Run:
    begin, memory = time.perf_counter(), 0.0
    process = _start(path, out, more)
    while True:
        ended, status, usage = os.wait4(process.pid, os.WNOHANG)
        if ended:
            break
        tree = (process, *process.children(recursive=True))
        memory = max(memory, sum(map(_memory, tree)))
        time.sleep(_WATCH)
    if status:
        raise RuntimeError(f'the sweep of {path.name} ended with status {status}')
    # Workers have been waited for, so theirs is in it.
    processor = usage.ru_utime + usage.ru_stime
    return Run(processor, time.perf_counter() - begin, memory)


def _memory(process: psutil.Process) -> float:
    """Return what a process occupies, MiB, what it shares by its part; 0 when it is gone."""
    try:
        return float(process.memory_full_info().pss) / 2**20
    except psutil.Error:
        return 0.0
