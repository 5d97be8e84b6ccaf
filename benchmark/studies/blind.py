"""Blind tests of the diagnosis: `python -m benchmark.studies.blind --trials 200 --workers 2`.

Hides random effects in random scenes, hands table and lens to `diagnose`, and writes what came of
it: a file a mode in docs/results/blind/, and docs/results/blind.md from all that are there
(design, section 8).
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmark import study
from benchmark.studies.blind_effects import HIDDEN
from benchmark.studies.blind_outside import OUTSIDE
from benchmark.studies.blind_report import write_report
from benchmark.studies.blind_trial import MODES, Outcome, Task, run_trial
from fisheye_svp_ros.io.files import write_text

SIZES = (1.0, 0.5, 0.2, 0.1, 0.05)
OUTSIDE_SIZES = (1.0, 0.5)
PAIR_SIZE = 0.5


def tasks(mode: str, trials: int, seed: int) -> Iterator[Task]:
    """Yield the trials of a mode (of every size, for one effect), spread over the effects."""
    names = list(HIDDEN)
    for number in range(trials):
        if mode == 'one':
            yield from (Task(mode, s, (names[number % len(names)],), seed, number) for s in SIZES)
        elif mode == 'background':
            hidden = () if number % 2 else (names[number // 2 % len(names)],)
            yield Task(mode, 1.0, hidden, seed, number)
        elif mode == 'clean':
            yield Task(mode, 0.0, (), seed, number)
        elif mode == 'outside':
            name = list(OUTSIDE)[number % len(OUTSIDE)]
            size = OUTSIDE_SIZES[number // len(OUTSIDE) % len(OUTSIDE_SIZES)]
            yield Task(mode, size, (name,), seed, number)
        else:
            # Every effect is the first of a pair equally often; the second is any other.
            rng = np.random.default_rng([seed, number])
            first = names[number % len(names)]
            second = str(rng.choice([name for name in names if name != first]))
            yield Task(mode, PAIR_SIZE, (first, second), seed, number)


def run(todo: Sequence[Task], workers: int) -> list[Outcome]:
    """Run trials in processes of their own; Ctrl-C keeps those that are done."""
    return study.in_processes('blind trials', run_trial, todo, workers)


def save(mode: str, outcomes: Sequence[Outcome], seed: int, directory: Path) -> None:
    """Write the trials of a mode, one a line, with the command that makes them."""
    # Of a run that was cut short, the sizes of the last trial may be incomplete.
    trials = len(outcomes) // len(list(tasks(mode, 1, seed)))
    whole = [outcome for outcome in outcomes if outcome.task.number < trials]
    command = f'python -m benchmark.studies.blind --modes {mode} --trials {trials} --seed {seed}'
    text = study.json_lines([outcome.to_dict() for outcome in whole], command)
    write_text(directory / f'blind/{mode}.json', text)


def load(directory: Path) -> dict[str, tuple[str, list[Outcome]]]:
    """Return by mode the command and the outcomes that were saved."""
    saved = {}
    for mode in MODES:
        path = directory / f'blind/{mode}.json'
        if path.is_file():
            document = json.loads(path.read_text())
            trials = [Outcome.from_dict(entry) for entry in document['trials']]
            saved[mode] = document['command'], trials
    return saved


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the trials that the command line asks for and write the report."""
    parser = study.parser(
        'blind',
        __doc__,
        trials=(200, 'a mode, and a size of one effect'),
        seed=(0, 'another seed, other trials'),
    )
    parser.add_argument('--modes', nargs='+', choices=MODES, default=MODES, help='what to hide')
    asked = parser.parse_args(arguments)
    for mode in asked.modes:
        outcomes = run(list(tasks(mode, asked.trials, asked.seed)), asked.workers)
        save(mode, outcomes, asked.seed, asked.output)
    write_report(load(asked.output), asked.output)
    sys.stdout.write(f'wrote {asked.output / "blind.md"}\n')


if __name__ == '__main__':
    main()
