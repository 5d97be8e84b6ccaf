"""Blind trials: sets are generated and handed to `fisheye-svp diagnose` as files.

`python -m benchmark.studies.independent --trials N --seed S --background B --mode one -o DIR`.
What has been diagnosed in DIR is not diagnosed again.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any, NamedTuple

from rich.progress import track

from benchmark.studies.independent.generator import GIVEN, MODES, generate, plan, write
from benchmark.studies.independent.report import write_reports
from benchmark.studies.independent.score import score

LIMIT = 900.0


class Run(NamedTuple):
    """Trials 0 to `trials` - 1 of a seed in a mode, with a background in noise levels."""

    mode: str
    seed: int
    background: float
    trials: int

    @property
    def name(self) -> str:
        """Name of the run's folder and table."""
        return f'{self.mode}_background{self.background:g}_seed{self.seed}'


def trial(run: Run, index: int, folder: Path) -> dict[str, Any]:
    """Return the score of one trial; generate its set and have it diagnosed if need be."""
    place = folder / run.name / f'{index:04d}'
    given, truth, said = place / 'given', place / 'truth.json', place / 'said.json'
    if not said.exists():
        write(
            generate(run.seed, index, plan(run.mode, run.seed, index), run.background),
            given,
            truth,
        )
        answer = diagnose(given, place / 'out')
        fresh = said.with_suffix('.new')
        fresh.write_text(json.dumps(answer))
        fresh.rename(said)
    return {'trial': index, **score(json.loads(truth.read_text()), json.loads(said.read_text()))}


def diagnose(given: Path, output: Path) -> dict[str, Any]:
    """Return diagnosis.json of the command line with its wall time; `failed` says why not."""
    program = Path(sys.executable).with_name('fisheye-svp')
    command = [
        str(program) if program.exists() else shutil.which('fisheye-svp') or 'fisheye-svp',
        'diagnose',
        GIVEN[0],
        '--lens',
        GIVEN[1],
        '--held-out',
        GIVEN[2],
        '-o',
        str(output.resolve()),
    ]
    threads = {'OMP_NUM_THREADS': '1', 'OPENBLAS_NUM_THREADS': '1'}
    begun = time.monotonic()
    try:
        done = subprocess.run(
            command,
            cwd=given,
            env=os.environ | threads,
            timeout=LIMIT,
            capture_output=True,
            text=True,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return {'failed': f'nothing after {LIMIT:g} s', 'seconds': LIMIT}
    seconds = time.monotonic() - begun
    if done.returncode:
        why = (done.stderr.strip() or 'no word').splitlines()[-1]
        return {'failed': f'exit {done.returncode}: {why}', 'seconds': seconds}
    return {**json.loads((output / 'diagnosis.json').read_text()), 'seconds': seconds}


def main() -> None:
    """Run the trials, two at a time, and write tables for people and scripts."""
    parser = argparse.ArgumentParser(
        prog='python -m benchmark.studies.independent', description=__doc__
    )
    parser.add_argument('--trials', type=int, default=69)
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument(
        '--background',
        type=float,
        nargs='+',
        default=[0.0, 0.5, 1.0],
        help='rms of the background, in noise levels',
    )
    parser.add_argument('--mode', nargs='+', choices=MODES, default=list(MODES))
    parser.add_argument('--docs', type=Path, default=Path('docs/results'))
    parser.add_argument(
        '-o',
        '--output',
        type=Path,
        required=True,
        help='folder of the sets and of what was said about them',
    )
    args = parser.parse_args()
    runs = [
        Run(mode, args.seed, size, args.trials) for mode in args.mode for size in args.background
    ]
    for run in runs:
        with ThreadPoolExecutor(2) as pool:
            jobs = [pool.submit(trial, run, i, args.output) for i in range(run.trials)]
            scores = [job.result() for job in track(as_completed(jobs), run.name, len(jobs))]
        scores.sort(key=lambda one: one['trial'])
        write_reports(args.docs, run.name, {**run._asdict(), 'scores': scores})
