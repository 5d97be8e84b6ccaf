"""Which constants of the decisions matter: each doubled and halved (`make study NAME=constants`).

Boards as they are said to be, with landmarks off, bent, or with all of it through a lens whose
viewpoint may move, five to eighteen photographs of each, and real sets where `--data` names their
folder, are diagnosed once. Then the
decisions are made again with each number of the rooms that decide changed to its double and its
half (of a share from one half on, what is missing to 1), all else as it is. A number that changes
no answer, no reason and no flaw of any set is a candidate to go. Numbers that a search needs
before it decides (selection, variances) are no part of this.

Writes docs/results/constants.md.
"""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from benchmark import study
from benchmark.studies.boards import FEW, FRAMES, HEIGHT, WIDTH, BoardErrors, draw_set
from fisheye_svp_ros.diagnosis import (
    Diagnosis,
    adequacy,
    conclusion,
    decision,
    findings,
    frame_changes,
    lens_evidence,
)
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.io.readers import read_observations
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.solve import lens_checks, ray_errors

ROOMS: tuple[ModuleType, ...] = (
    decision,
    adequacy,
    frame_changes,
    conclusion,
    lens_evidence,
    findings,
    lens_checks,
    ray_errors,
)
FACTORS = (2.0, 0.5)
NO_AMOUNTS = ('_NEAR_RANGE', 'SAMPLES')  # a place in a list, and the length of one
SIZE = (WIDTH, HEIGHT)
REAL = {'ov_cube': (1280, 800), 'ov_plane': (1280, 800)}
KINDS = (
    BoardErrors(bent=False, off=False),
    BoardErrors(bent=False, off=True),
    BoardErrors(bent=True, off=False),
    None,
)


class Constant(NamedTuple):
    """A number of a room: its name, its value, and the comment beside it."""

    room: str
    name: str
    value: float
    comment: str


class Outcome(NamedTuple):
    """Of one set: its name, and what is decided otherwise, by constant and factor."""

    name: str
    changes: Mapping[tuple[str, str, float], str]


def constants() -> list[Constant]:
    """Return the numbers that the rooms assign to names in capitals, in order."""
    found = []
    for room in ROOMS:
        text = inspect.getsource(room)
        lines = text.splitlines()
        for node in ast.parse(text).body:
            if not isinstance(node, ast.Assign):
                continue
            comment = lines[node.lineno - 1].partition('  # ')[2]
            for name in _names(node):
                value = getattr(room, name)
                if not name.isupper() or name in NO_AMOUNTS:
                    continue
                if isinstance(value, int | float) and value > 0:
                    found.append(Constant(room.__name__, name, value, comment))
    return found


def _names(node: ast.Assign) -> Iterator[str]:
    for target in node.targets:
        parts = target.elts if isinstance(target, ast.Tuple) else [target]
        yield from (part.id for part in parts if isinstance(part, ast.Name))


@contextmanager
def changed(constant: Constant, factor: float) -> Iterator[None]:
    """Have every room see a multiple of a constant; of a share near 1, of what is missing."""
    value = type(constant.value)(factor * constant.value)
    if 0.5 <= constant.value < 1:
        value = 1 - factor * (1 - constant.value)
    users = [room for room in ROOMS if constant.name in vars(room)]
    if constant.name.startswith('_'):
        users = [room for room in ROOMS if room.__name__ == constant.room]
    for room in users:
        setattr(room, constant.name, value)
    try:
        yield
    finally:
        for room in users:
            setattr(room, constant.name, constant.value)


def answers(found: Diagnosis, contradicted: bool) -> dict[str, str]:
    """Return what is decided anew about an evaluated set, with reasons, and its flaws."""
    said = conclusion.conclude(
        found.evaluation,
        found.causes,
        found.components,
        found.advice,
        found.candidates,
        contradicted,
    )
    flaws = ', '.join(flaw.kind.name for flaw in said.adequacy.flaws)
    return {
        **{about: f'{one.say} ({one.reason.name})' for about, one in said.decision.items()},
        'flaws': flaws or 'none',
    }


def trial(task: tuple[int, str]) -> Outcome:
    """Diagnose one set and decide about it with every constant changed; task: number, data."""
    number, data = task
    name, table, size = _table(number, Path(data))
    lens: Lens = study.calibrated(table, size)
    found = study.diagnose(table, lens)
    contradicted = any(pair.verdict == 'contradict' for pair in found.cameras)
    base, changes = answers(found, contradicted), dict[tuple[str, str, float], str]()
    for constant in constants():
        for factor in FACTORS:
            with changed(constant, factor):
                after = answers(found, contradicted)
            differs = [
                f'{about} {base[about]} → {after[about]}'
                for about in base
                if after[about] != base[about]
            ]
            if differs:
                changes[constant.room, constant.name, factor] = '; '.join(differs)
    return Outcome(name, changes)


def _table(number: int, data: Path) -> tuple[str, Observations, tuple[int, int]]:
    if number < 0:
        name, size = [*REAL.items()][number]
        return name, read_observations(data / name / 'train.csv'), size
    seed, kind = divmod(number, len(KINDS))
    table, _ = draw_set(seed, FEW if seed % 2 else FRAMES, errors=KINDS[kind])
    return f'set {number}', table, SIZE


def report(outcomes: Sequence[Outcome], command: str) -> str:
    """Return the page."""
    rows = []
    for constant in constants():
        cells: list[Any] = [
            f'`{constant.room.rpartition(".")[2]}.{constant.name}`',
            f'{constant.value:g}',
            constant.comment,
        ]
        for factor in FACTORS:
            key = constant.room, constant.name, factor
            who = [one.name for one in outcomes if key in one.changes]
            cells.append(f'{len(who)}' + (f' ({who[0]})' if who else ''))
        rows.append(cells)
    idle = sum(row[-1] == row[-2] == '0' for row in rows)
    head = 'constant | value | of what | doubled: sets that change | halved: sets that change'
    return study.page(
        'Constants of the decisions',
        __doc__,
        command,
        [f'{len(rows)} numbers, {len(outcomes)} sets; {idle} change no answer of any.'],
        study.table(head, rows),
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Diagnose the sets, decide again, write and print the page."""
    parser = study.parser('constants', __doc__, study.DOCS, sets=(40, 'simulated sets'))
    parser.add_argument('--data', type=Path, help='folder of ov_cube and ov_plane', default=None)
    asked = parser.parse_args(arguments)
    numbers = [*range(-len(REAL), 0)] * (asked.data is not None) + [*range(asked.sets)]
    todo = [(number, str(asked.data or '')) for number in numbers]
    outcomes = study.in_processes('constants', trial, todo, asked.workers)
    data = ' --data DATA' * (asked.data is not None)
    page = report(outcomes, f'python -m benchmark.studies.constants --sets {asked.sets}{data}')
    write_text(asked.output / 'results' / 'constants.md', page)
    print(page, end='')


if __name__ == '__main__':
    main()
