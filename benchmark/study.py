"""What studies share: command lines, trials side by side, pages, tables, rates, ray errors."""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import re
import sys
import textwrap
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from scipy.stats import binomtest

import fisheye_svp_ros as fsvp
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.diagnosis import Diagnosis, diagnose
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.reporting.terminal import progress
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.solve.ray_errors import RANGES, points_on_rays, without_motion

DOCS = Path(__file__).parents[1] / 'docs'
RESULTS = DOCS / 'results'
RELIABILITY = RESULTS / 'reliability.md'
T = TypeVar('T')
R = TypeVar('R')


def parser(
    study: str,
    doc: str | None,
    output: Path | None = RESULTS,
    workers: bool = True,
    room: str = 'studies',
    **options: tuple[Any, str],
) -> argparse.ArgumentParser:
    """Return the parser of `python -m benchmark.ROOM.STUDY`; options: default and help by name."""
    found = argparse.ArgumentParser(description=doc, prog=f'python -m benchmark.{room}.{study}')
    for name, (default, text) in options.items():
        kind: dict[str, Any] = (
            {'action': 'store_true'}
            if default is False
            else {'type': type(default), 'default': default}
        )
        found.add_argument(f'--{name.replace("_", "-")}', help=text, **kind)
    if workers:
        found.add_argument('--workers', type=int, default=os.cpu_count(), help='processes')
    if output is not None:
        found.add_argument(
            '-o',
            '--output',
            type=Path,
            default=output,
            help='file' if output.suffix else 'directory',
        )
    return found


def image_size(text: str) -> tuple[int, int]:
    """Return width and height of `1280x800`."""
    width, height = map(int, text.split('x'))
    return width, height


def add_sets(found: argparse.ArgumentParser) -> None:
    """Have a parser ask for tables of observations of one camera, and for its image size."""
    found.add_argument('sets', type=Path, nargs='+', metavar='TRAIN.csv')
    found.add_argument('--image-size', type=image_size, required=True, metavar='WxH')


def in_processes(label: str, trial: Callable[[T], R], todo: Sequence[T], workers: int) -> list[R]:
    """Return what a trial makes of each item, in their order; Ctrl-C keeps those that are done."""
    os.environ['OMP_NUM_THREADS'] = os.environ['OPENBLAS_NUM_THREADS'] = '1'
    context = multiprocessing.get_context('spawn')  # the number of threads is read at the start
    outcomes = []
    with (
        progress(label, len(todo)) as advance,
        ProcessPoolExecutor(workers, mp_context=context) as pool,
    ):
        try:
            for outcome in pool.map(trial, todo):
                outcomes.append(outcome)
                advance()
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
    return outcomes


def in_turn(
    label: str,
    trial: Callable[[T], R],
    todo: Sequence[T],
    keep: Callable[[list[R]], None] = lambda outcomes: None,
) -> list[R]:
    """Return what a trial makes of each item; keep: told after each what there is so far."""
    outcomes: list[R] = []
    with progress(label, len(todo)) as advance:
        for one in todo:
            outcomes.append(trial(one))
            keep(outcomes)
            advance()
    return outcomes


def run_sets(
    name: str,
    doc: str | None,
    trial: Callable[[int], R],
    report: Callable[[Sequence[R], str], str],
    arguments: Sequence[str] | None,
    sets: tuple[int, str],
    each: int = 1,
) -> tuple[list[R], Path]:
    """Run a study of sets that are told by number, write and print its page.

    sets: how many, and of what; each: trials of a set.  Returns outcomes and the docs' folder.
    """
    asked = parser(name, doc, DOCS, sets=sets).parse_args(arguments)
    outcomes = in_processes(name.replace('_', ' '), trial, range(each * asked.sets), asked.workers)
    page = report(outcomes, f'python -m benchmark.studies.{name} --sets {asked.sets}')
    write_text(asked.output / 'results' / f'{name}.md', page)
    sys.stdout.write(page)
    return outcomes, asked.output


def table(header: str, rows: Iterable[Iterable[object]], numbers: bool = False) -> list[str]:
    """Return the lines of a table; header: names between ` | `; numbers: in all but the first."""
    count = header.count(' | ')
    return [
        f'| {header} |',
        '| ---' + ' | ---:' * count + ' |' if numbers else '|---' * (count + 1) + '|',
        *(f'| {" | ".join(map(str, row))} |' for row in rows),
    ]


def page(title: str, doc: str | None, command: str, *parts: Iterable[str]) -> str:
    """Return a page: what is done, by the second paragraph of a docstring, the command, parts.

    parts: the lines of each; a blank line comes after.
    """
    lines = [f'# {title}', '', *(doc or '').split('\n\n')[1].split('\n'), '', f'`{command}`', '']
    return '\n'.join([*lines, *(line for part in parts for line in (*part, ''))])


def write_lines(path: Path, lines: Iterable[str]) -> None:
    """Write a page."""
    write_text(path, '\n'.join(lines) + '\n')


def write_section(path: Path, name: str, text: str) -> None:
    """Write what stands between `<!-- name -->` and `<!-- end of name -->` in a page."""
    begin, end = f'<!-- {name} -->', f'<!-- end of {name} -->'
    between = f'{begin}\n{text}\n{end}'
    write_text(path, re.sub(f'{begin}.*{end}', lambda _: between, path.read_text(), flags=re.S))


def write_figures(path: Path, lines: Iterable[str]) -> None:
    """Write what follows upon `<!-- figures -->` in a page."""
    head, mark, _ = path.read_text().partition('<!-- figures -->')
    write_lines(path, [head + mark, *lines])


def write_wrapped(path: Path, lines: Iterable[str]) -> None:
    """Write a page whose lines are broken, those of tables left as they are."""
    write_text(
        path,
        '\n'.join(
            line
            if line.startswith('|')
            else textwrap.fill(
                line,
                100,
                break_on_hyphens=False,
                subsequent_indent='  ' if line.startswith('- ') else '',
            )
            for line in lines
        ),
    )


def node_command(node: str, *parameters: str) -> list[str]:
    """Return the command that runs a node with parameters, `name:=value`."""
    words = [word for one in parameters for word in ('-p', one)]
    return [sys.executable, '-m', 'fisheye_svp_ros.cli', 'run', node, '--ros-args', *words]


def stay_on_this_machine() -> None:
    """Have ROS 2 stay in a domain of its own, on this machine, unless the user says otherwise."""
    os.environ.setdefault('ROS_DOMAIN_ID', '99')
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')


def json_lines(entries: Iterable[Any], command: str = '') -> str:
    """Return entries as JSON, one a line; command: that makes them, which then stands before."""
    lines = ',\n'.join(map(json.dumps, entries))
    if command:
        return f'{{"command": {json.dumps(command)},\n"trials": [\n{lines}\n]}}\n'
    return f'[\n{lines}\n]\n'


class Rate(NamedTuple):
    """A number of successes among trials, with its 95 % interval (Clopper and Pearson, 1934)."""

    successes: int
    trials: int

    @classmethod
    def of(cls, results: Iterable[bool]) -> Rate:
        """Count successes."""
        counted = [bool(one) for one in results]
        return cls(sum(counted), len(counted))

    @property
    def value(self) -> float:
        return self.successes / self.trials if self.trials else float('nan')

    @property
    def interval(self) -> tuple[float, float]:
        if not self.trials:
            return 0.0, 1.0
        low, high = binomtest(self.successes, self.trials).proportion_ci()
        return float(low), float(high)

    @property
    def bounds(self) -> str:
        low, high = self.interval
        return f'{100 * low:.1f} to {100 * high:.1f} %'

    def __str__(self) -> str:
        return f'{100 * self.value:.1f} % ({self.successes}/{self.trials})' if self.trials else '-'


def calibrated(observations: Observations, size: tuple[int, int], plain: bool = False) -> Lens:
    """Return the Kannala-Brandt lens that `calibrate` writes; plain: by least squares."""
    return fsvp.calibrate(observations, 'kannala_brandt', size, plain=plain).lens


def calibrated_and_diagnosed(
    observations: Observations, size: tuple[int, int], **options: Any
) -> tuple[Lens, Diagnosis]:
    """Return the lens that is fitted to observations, and what `diagnose` finds with it."""
    lens = calibrated(observations, size)
    return lens, diagnose(observations, lens, **options)


def ray_errors(lens: Lens, truth: Lens, uv: Array, ranges: Sequence[float] = RANGES) -> Array:
    """Return rms angles (R,), mrad, between rays of two lenses at ranges, m.

    uv (G, 2): image points, px; a motion that is common to all ranges is taken out.
    """
    points = points_on_rays(truth, uv, ranges)
    change = points_on_rays(lens, uv, ranges) - points
    there = np.isfinite(change + points).all(axis=(0, 2))
    angles = without_motion(points[:, there], change[:, there])
    return np.asarray(1e3 * np.sqrt((angles**2).sum(axis=-1).mean(axis=-1)))


def ray_error(lens: Lens, truth: Lens, uv: Array, ranges: Sequence[float] = RANGES) -> float:
    """Return the rms angle, mrad, over all ranges together; see `ray_errors`."""
    return float(np.sqrt((ray_errors(lens, truth, uv, ranges) ** 2).mean()))
