"""docs/results/benchmarks.md from what was measured."""

from __future__ import annotations

import platform
import textwrap
from collections.abc import Iterator, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple

from benchmark.speed.compiled import compiler, mrcal_revision
from benchmark.speed.harness import OURS, NotHereError, Row

_PACKAGES = (
    'numpy',
    'scipy',
    'numba',
    'opencv-python-headless',
    'poselib',
    'pycolmap',
    'gtsam',
    'ros-jazzy-rclpy',
    'mrcal',
)
# Columns of words; all others hold numbers.
_WORDS = (
    'what',
    'node',
    'version',
    'who',
    'notes',
    'work',
    'that grows',
    'command',
    'on',
    'met',
    'engine',
    'against',
)
_HEAD = """# Benchmarks

`make bench` runs `{command}` in its own environment (`benchmark/requirements.txt`).

All rows of a table do the same work with the same lens, data ({noise} px of noise) and start,
unless a note says otherwise, in turns on one core. Times are medians of processor time. "Off" is
the largest distance of a result from the reference: the NumPy engine for image points, SciPy's
`least_squares` with tolerances of 1e-14 for poses and rigs.
"""


class Table(NamedTuple):
    """A section with one table; `notes` stand below."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    text: str = ''
    notes: Sequence[str] = ()


def document(command: str, noise: float, sections: Sequence[Row | Table]) -> str:
    """Return the report as Markdown."""
    rows = [section for section in sections if isinstance(section, Row)]
    parts = [_HEAD.format(command=command, noise=noise)]
    tables = [
        goals(rows),
        *(of_row(section) if isinstance(section, Row) else section for section in sections),
    ]
    return '\n'.join([*parts, versions(), *(markdown(table) for table in tables)])


def markdown(table: Table) -> str:
    """Return a section as Markdown."""
    lines = [f'## {table.title}', '']
    if table.text:
        lines += [table.text, '']
    if table.rows:
        marks = ['---' if name in _WORDS else '---:' for name in table.header]
        lines += ['| ' + ' | '.join(row) + ' |' for row in (table.header, marks, *table.rows)]
        lines.append('')
    lines += [f'- {note}' for note in table.notes]
    return '\n'.join(lines) + ('\n' if table.notes else '')


def number(value: float) -> str:
    """Return a number to three digits."""
    return f'{value:.0f}' if value >= 100 else f'{value:.3g}'


def versions() -> str:
    """Return a paragraph of what was compared, and on what."""
    found = {'Python': platform.python_version(), 'processor': _processor()}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = 'not installed'
    for name, look in (('C compiler', compiler), ('mrcal (source)', mrcal_revision)):
        try:
            found[name] = look()
        except NotHereError as reason:
            found[name] = str(reason)
    text = ', '.join(f'{name} {value}' for name, value in found.items())
    return textwrap.fill(f'Versions: {text}.', 100, break_on_hyphens=False) + '\n'


def goals(rows: Sequence[Row]) -> Table:
    """Compare with what is to be reached."""
    lines = []
    for row in rows:
        for goal in row.goals:
            reached = row.ratio(goal.ours, goal.peer)
            met = '-' if reached is None else 'yes' if reached >= goal.ratio else 'no'
            lines.append(
                (
                    row.title,
                    goal.ours.removeprefix(OURS + ', '),
                    goal.peer,
                    f'{goal.ratio:.3g} ×',
                    'not measured' if reached is None else f'{number(reached)} ×',
                    met,
                )
            )
    return Table('Goals', ('work', 'engine', 'against', 'goal', 'reached', 'met'), lines)


def of_row(row: Row) -> Table:
    """Return the table of one row: a line a side."""
    compared = any(timing.error is not None for timing in row.timings)
    header = (
        'who',
        row.unit,
        'quartiles',
        *([f'off, {row.error_unit}'] if compared else ()),
        'notes',
    )
    lines = []
    for timing in row.timings:
        low, middle, high = (number(value / row.scale) for value in timing.quartiles)
        off = ['' if timing.error is None else f'{timing.error:.1e}'] if compared else ()
        lines.append((timing.name, middle, f'{low} to {high}', *off, timing.note))
    notes = [f'{name} did not take part: {why}.' for name, why in row.left_out.items()]
    return Table(row.title, header, lines, row.text, notes)


def _processor() -> str:
    for line in _lines(Path('/proc/cpuinfo')):
        if line.startswith('model name'):
            return line.split(':', 1)[1].strip()
    return platform.processor() or platform.machine()


def _lines(path: Path) -> Iterator[str]:
    if path.is_file():
        yield from path.read_text(encoding='utf-8', errors='replace').splitlines()
