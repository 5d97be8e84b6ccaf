"""`fisheye-svp sweep`: a sweep, offline, one row a scenario."""

from __future__ import annotations

import argparse
import fcntl
import os
import shutil
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.commands.executors import completed_tasks, dask, process_pool
from fisheye_svp_ros.commands.node_sweeps import read_sweep
from fisheye_svp_ros.commands.notes import count_text, note_formats, say
from fisheye_svp_ros.commands.outputs import add_output_folder
from fisheye_svp_ros.errors import OutputError, ParameterError
from fisheye_svp_ros.io.columns import TableParts
from fisheye_svp_ros.io.files import (
    read_json,
    read_text,
    write_json,
    write_text,
    write_together,
)
from fisheye_svp_ros.io.share import sweep_path
from fisheye_svp_ros.optics import engines
from fisheye_svp_ros.reporting.terminal import print_table, progress, short_number
from fisheye_svp_ros.reporting.wording.metrics import metric_text
from fisheye_svp_ros.study.summary import Summary, summarize
from fisheye_svp_ros.study.sweep import (
    Plan,
    column_types,
    fingerprint,
    part_check,
    solve_rows,
    tasks,
    work,
    write_rows,
)

if TYPE_CHECKING:
    from pandas import DataFrame

_MAX_SCENARIOS = 1_000_000  # scenarios; more are rather a slip in the file than meant
_PARTS, _SUMMARY = 'parts', 'sweep.json'
_MARK = 'sweep.txt'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument(
        'file',
        type=Path,
        metavar='FILE',
        help='ROS parameter file in which sweep.PARAMETER is a list, or the name '
        'of one in config/sweeps',
    )
    add_output_folder(
        parser,
        'folder to write sweep.parquet, sweep.csv and sweep.json to; default: sweep',
        default='sweep',
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        '--workers',
        type=_count,
        default=0,
        metavar='N',
        help='number of worker processes; default: none, all in this one',
    )
    where.add_argument(
        '--dask', metavar='ADDRESS', help='address of a Dask scheduler: run on its cluster'
    )
    parser.add_argument('--resume', action='store_true', help='continue an interrupted run in DIR')
    parser.add_argument(
        '--large', action='store_true', help=f'allow more than {_MAX_SCENARIOS} scenarios'
    )


def run(args: argparse.Namespace) -> None:
    """Solve what is not solved yet; join the parts."""
    path = sweep_path(str(args.file))
    plan = read_sweep(path)
    if len(plan.sweep) > _MAX_SCENARIOS and not args.large:
        lengths = ' x '.join(f'{len(v)} {name}' for name, v in plan.sweep.lists.items())
        raise ParameterError(
            f'{path}: {len(plan.sweep)} scenarios ({lengths}); add --large to run them all'
        )
    parts = TableParts(args.output / _PARTS, column_types(plan))
    with _sole_writer(parts.folder):
        _run(args, path, plan, parts)
        shutil.rmtree(parts.folder, ignore_errors=True)


@contextmanager
def _sole_writer(folder: Path) -> Iterator[None]:
    """Hold a folder, which is made, for this process; raise OutputError where another has it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(folder, os.O_RDONLY)
    except OSError as cause:
        raise OutputError(f'{folder}: cannot be written ({cause.strerror})') from cause
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        try:
            yield
        finally:
            with suppress(OSError):  # parts are kept for --resume
                folder.rmdir()
    except BlockingIOError as cause:
        raise OutputError(
            f'{folder.parent}: another sweep is writing there; wait for it, or choose another -o'
        ) from cause
    finally:
        os.close(handle)


def _run(args: argparse.Namespace, path: Path, plan: Plan, parts: TableParts) -> None:
    mine = fingerprint(plan)
    summary = args.output / _SUMMARY
    if args.resume and summary.exists():
        if read_json(summary, OutputError).get('fingerprint') == mine:
            say(f'{args.output} already holds this sweep')
            return
        raise OutputError(
            f'{args.output}: it holds another, finished sweep; choose another -o, or leave '
            '--resume out to replace it'
        )
    engine = _claim(parts, mine, args.resume, work(plan))
    _solve(args, plan, parts, engine)
    if missing := {numbers.start for numbers in tasks(plan)} - parts.numbers():
        raise OutputError(
            f'{parts.folder}: {len(missing)} parts of the sweep are missing; '
            'compute them again with --resume'
        )
    with write_together():
        _report(path, args.output, plan, mine, _join(args.output / 'sweep', plan, parts))
    note_formats()


def _claim(parts: TableParts, mine: str, resume: bool, points: int) -> str:
    """Make the folder of the parts this sweep's own; refuse that of another sweep.

    Return the engine for all of the sweep: the one that it was begun with.
    """
    mark = parts.folder / _MARK
    if not mark.exists() or not (resume or parts.numbers()):  # of a run that solved nothing
        engine = engines.settle(points)
        write_text(mark, f'{mine} {engine}')
        return engine
    if not resume:
        raise OutputError(
            f'{parts.folder}: it holds an interrupted sweep; continue with '
            '--resume, or remove the folder'
        )
    theirs, _, engine = read_text(mark, OutputError).partition(' ')
    if theirs != mine:
        raise OutputError(
            f'{parts.folder}: it holds another, interrupted sweep; choose another '
            '-o, or remove the folder'
        )
    return engine


def _solve(args: argparse.Namespace, plan: Plan, parts: TableParts, engine: str) -> None:
    done = parts.numbers()
    remaining = [numbers for numbers in tasks(plan) if numbers.start not in done]
    count = sum(map(len, remaining))
    if count < len(plan.sweep):
        say(f'{len(plan.sweep) - count} of {len(plan.sweep)} scenarios are already done')
    with (
        progress('sweeping', count) as advance,
        closing(_written(args, plan, remaining, parts, engine)) as written,
    ):
        for numbers in written:
            advance(len(numbers))


def _written(
    args: argparse.Namespace,
    plan: Plan,
    remaining: Sequence[range],
    parts: TableParts,
    engine: str,
) -> Generator[range]:
    """Yield tasks as their parts are written: by whoever solves them, but on a cluster."""
    write = partial(write_rows, parts, engine, plan)
    if args.dask:
        with dask(args.dask) as workers:
            for numbers, rows in completed_tasks(
                partial(solve_rows, engine, plan), remaining, workers
            ):
                parts.write(numbers.start, rows)
                yield numbers
    elif args.workers:
        with process_pool(args.workers) as workers:
            for numbers, _ in completed_tasks(write, remaining, workers):
                yield numbers
    else:
        for numbers in remaining:
            write(numbers)
            yield numbers


def _join(path: Path, plan: Plan, parts: TableParts) -> dict[str, Summary]:
    """Write the parts as one table; return the summary of each metric.

    Raises OutputError as `TableParts.join` does.
    """
    metrics: dict[str, list[Array]] = {
        name: [] for name, kind in column_types(plan).items() if kind is float and '.' in name
    }

    def take(part: DataFrame) -> None:
        for name, values in metrics.items():
            values.append(part[name].to_numpy())

    parts.join(path, part_check(plan), take)
    return {name: summarize(np.concatenate(values)) for name, values in metrics.items()}


def _report(
    path: Path, folder: Path, plan: Plan, mine: str, summaries: Mapping[str, Summary]
) -> None:
    """Print and write what came out, metric by metric."""
    count = len(plan.sweep)
    print_table(f'{path}: {count_text(count, "scenario")}', *_summary_table(summaries))
    write_json(
        folder / _SUMMARY,
        {
            'fingerprint': mine,
            'file': str(path),
            'scenarios': count,
            'swept': {name: list(values) for name, values in plan.sweep.lists.items()},
            'metrics': {name: s._asdict() for name, s in summaries.items()},
        },
    )


def _summary_table(
    summaries: Mapping[str, Summary],
) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return header and rows, in mm and degrees; without what is zero in every set."""
    lost = any(summary.missing for summary in summaries.values())
    header = ('metric', 'sets', *(('not solved',) if lost else ()), 'median', 'mean', 'largest')
    rows = []
    for name, summary in summaries.items():
        text = metric_text(name)
        numbers = [short_number(text.factor * value) for value in summary[2:]]
        if set(numbers) != {'0'}:
            missing = (str(summary.missing),) if lost else ()
            rows.append((text.title(), str(summary.solved), *missing, *numbers))
    return header, rows


def _count(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f'{text!r} is not a number of processes')
    return int(text)
