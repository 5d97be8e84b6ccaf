"""Tables: what a localizer node adds to a round trip, and how much it can take."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from typing import Any

from benchmark.speed.engines import engines
from benchmark.speed.report import Table, number
from fisheye_svp_ros.optics.engines import VARIABLE

_GOAL = 1e-3  # s that a localizer may add
_TEXT = """From `image_points` in to `~/pose` out, through a localizer (33 landmarks, ShiftVP) and
through a node that answers each set at once with a pose it has not looked for: separate processes
on loopback, the same messages, in turns. "Adds" is the difference of the medians. Throughput: the
highest rate at which every set of one second was answered; then the first at which not, and how
many were. All topics are reliable with a depth of 100."""
_RUN = [sys.executable, '-m', 'benchmark.speed.round_trip']


def tables(count: int = 300) -> list[Table]:
    """Return the table: a line an engine."""
    rows, notes = [], []
    for name in engines():
        run = subprocess.run([*_RUN, str(count)], env={**os.environ, VARIABLE: name},
                             stdout=subprocess.PIPE, text=True, check=False)
        if run.returncode:
            notes.append(f'{name}: the nodes did not run.')
            continue
        rows.append(_line(name, json.loads(run.stdout)))
    header = ('engine', 'echo node, ms', 'localizer, ms', 'adds, ms', 'goal, ms', 'met',
              'echo node, sets/s', 'localizer, sets/s')
    return [Table('Nodes', header, rows, _TEXT, notes)]


def _line(name: str, measured: dict[str, Any]) -> tuple[str, ...]:
    echo, localizer = measured['median'].values()
    added = localizer - echo
    return (
        name, number(1e3 * echo), number(1e3 * localizer), number(1e3 * added),
        f'{1e3 * _GOAL:g}', 'yes' if added < _GOAL else 'no',
        *map(_throughput, measured['throughput'].values()),
    )


def _throughput(rates: list[tuple[float, float]]) -> str:
    whole = [rate for rate, answered in rates if answered == 1]
    lossy = [(rate, answered) for rate, answered in rates if answered < 1]
    text = f'{max(whole, default=0):.0f}'
    return text + ''.join(f'; {100 * part:.0f} % at {rate:.0f}' for rate, part in lossy)
