"""Tables: how soon nodes are ready, what a localizer adds to a round trip, how much it takes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from statistics import median
from typing import Any

from benchmark.speed.engines import engines
from benchmark.speed.report import Table, number
from fisheye_svp_ros.nodes import NODES
from fisheye_svp_ros.optics.engines import VARIABLE

_GOAL = 1e-3  # s that a localizer may add
_TEXT = """Latency from `image_points` to `~/pose` of a localizer (33 landmarks, ShiftVP) and of an
echo node that answers at once, in processes of their own on loopback: what the localizer adds, for
a camera that moves on a circle of 0.2 m, 150 sets a turn, and for one that jumps 0.1 rad from set
to set, so that each set is solved again, without a start. Throughput: the highest rate at which
all sets were answered, then the first at which not, and how many."""
_RUN = [sys.executable, '-m', 'benchmark.speed.round_trip']
_START_GOAL = 1.0  # s from the first import to a node that is ready
_FIRST_START_GOAL = 2.0  # s, the same where Numba has compiled nothing yet
_STARTS = 9
_WITH_FILES = ('measured_camera', 'rectifier', 'rig_localizer')  # which cannot start without any
_START_TEXT = f"""From the start of Python to a node that is ready, its lens loaded, modules
compiled: medians of {_STARTS} starts, wall clock and processor time. The last line: what Numba
compiles is not there yet, and is made in the background."""
_START = """
import sys, time
begun = time.perf_counter()
from fisheye_svp_ros.nodes import executables
kind = executables._node_class(sys.argv[1])
import rclpy
rclpy.init(args=['--ros-args', '-p', 'lens:=fish214', '-p', 'board:=chessboard:9x6:25mm'])
node = kind()
print(time.perf_counter() - begun, time.process_time())
"""


def tables(count: int = 300) -> list[Table]:
    """Return the table: a line an engine."""
    rows, notes = [], []
    for name in engines():
        run = subprocess.run(
            [*_RUN, str(count)],
            env={**os.environ, VARIABLE: name},
            stdout=subprocess.PIPE,
            text=True,
            check=False,
        )
        if run.returncode:
            notes.append(f'{name}: the nodes did not run.')
            continue
        rows.append(_line(name, json.loads(run.stdout)))
    header = (
        'engine',
        'echo node, ms',
        'localizer, ms',
        'adds, ms',
        'goal, ms',
        'met',
        'adds after jumps, ms',
        'echo node, sets/s',
        'localizer, sets/s',
    )
    return [_starts(), Table('Nodes', header, rows, _TEXT, notes)]


def _starts() -> Table:
    names = [name for name in NODES if name not in _WITH_FILES]
    seconds: dict[str, list[list[float]]] = {name: [] for name in names}
    for _ in range(_STARTS):
        for name in names:
            seconds[name].append(_start(name, {}))
    rows = [_start_line(name, several, _START_GOAL) for name, several in seconds.items()]
    with tempfile.TemporaryDirectory() as empty:
        first = _start('localizer', {'NUMBA_CACHE_DIR': empty})
    rows.append(_start_line('localizer, nothing compiled', [first], _FIRST_START_GOAL))
    header = ('node', 'on the clock, s', 'processor, s', 'goal, s', 'met')
    return Table('Starts of nodes', header, rows, _START_TEXT)


def _start(name: str, environment: dict[str, str]) -> list[float]:
    """Return how long a node takes until it is ready, on the clock and of the processor, s."""
    run = subprocess.run(
        [sys.executable, '-c', _START, name],
        env={**os.environ, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        check=True,
    )
    return [float(word) for word in run.stdout.split()]


def _start_line(name: str, several: Sequence[Sequence[float]], goal: float) -> tuple[str, ...]:
    clock, processor = (median(column) for column in zip(*several, strict=True))
    return name, number(clock), number(processor), f'{goal:g}', 'yes' if clock < goal else 'no'


def _line(name: str, measured: dict[str, Any]) -> tuple[str, ...]:
    echo, localizer = measured['motion']
    added = localizer - echo
    jumps = measured['jumps'][1] - measured['jumps'][0]
    return (
        name,
        number(1e3 * echo),
        number(1e3 * localizer),
        number(1e3 * added),
        f'{1e3 * _GOAL:g}',
        'yes' if added < _GOAL else 'no',
        number(1e3 * jumps),
        *map(_throughput, measured['throughput']),
    )


def _throughput(rates: list[tuple[float, float]]) -> str:
    whole = [rate for rate, answered in rates if answered == 1]
    lossy = [(rate, answered) for rate, answered in rates if answered < 1]
    text = f'{max(whole, default=0):.0f}'
    return text + ''.join(f'; {100 * part:.0f} % at {rate:.0f}' for rate, part in lossy)
