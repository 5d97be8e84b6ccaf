"""`fisheye-svp plot`: a recording, a table or a sweep to pictures."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fisheye_svp_ros.commands.notes import say
from fisheye_svp_ros.commands.outputs import add_output_folder
from fisheye_svp_ros.errors import OutputError
from fisheye_svp_ros.io.bags import Bag
from fisheye_svp_ros.io.columns import read_table
from fisheye_svp_ros.io.files import write_together
from fisheye_svp_ros.io.recording import (
    NAMESPACE,
    ResidualSet,
    has_residuals,
    is_tabulated,
    residual_sets,
    tabulate,
)
from fisheye_svp_ros.io.recording_files import is_recording
from fisheye_svp_ros.reporting.terminal import progress

_FIELDS = 4  # residual fields a lens
_TABLES = ('.csv', '.parquet')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument(
        'source',
        type=Path,
        metavar='SOURCE',
        help='rosbag2 recording, table (.csv or .parquet), or folder of a sweep',
    )
    add_output_folder(
        parser,
        'folder to write the pictures (PNG) to; default: plots',
        default='plots',
    )


def run(args: argparse.Namespace) -> None:
    """Draw what the source is good for."""
    from fisheye_svp_ros.reporting.sweep_plots import draw_table, is_drawn

    table = _table_in(args.source)
    with write_together():
        if table:
            with progress('drawing'):
                files = draw_table(read_table(table, is_drawn), args.output)
        else:
            files = _of_bag(args)
    if not files:
        raise OutputError(
            f'{args.source}: nothing to draw; it needs residuals, or results of '
            'different scenarios'
        )
    for path in files:
        print(path)


def _table_in(source: Path) -> Path | None:
    if source.suffix in _TABLES:
        return source
    names = ['sweep.csv'] if is_recording(source) else ['sweep.csv', 'table.csv']
    return next((source / name for name in names if (source / name).exists()), None)


def _of_bag(args: argparse.Namespace) -> list[Path]:
    from fisheye_svp_ros.paper.demonstration_plots import draw_residual_fields
    from fisheye_svp_ros.reporting.sweep_plots import draw_residuals, draw_table
    from fisheye_svp_ros.reporting.terminal import draw_or_note

    bag = Bag(args.source)
    with progress('reading', 2 * bag.size) as passed:
        table = tabulate(bag.records(is_tabulated, passed))
        sets = residual_sets(bag.records(has_residuals, passed))
    if bag.damage:
        say(f'{args.source}: {bag.damage}')
    with progress('drawing'):
        # Rows of the namespace with most of them: others have other metrics.
        most = table[NAMESPACE].mode()[:1]
        files = draw_table(table[table[NAMESPACE].isin(most)], args.output)
        drawings: list[tuple[str, Callable[..., None], tuple[Any, ...]]] = []
        if sets:
            points, lenses = zip(
                *((one.points, one.tags.get('lens', '')) for one in sets), strict=True
            )
            drawings.append(('residuals', draw_residuals, (points, lenses)))
        if fields := _fields(sets):
            drawings.append(('residual_fields', draw_residual_fields, (fields,)))
        files += [
            path
            for name, draw, arguments in drawings
            if draw_or_note(path := args.output / f'{name}.png', draw, *arguments)
        ]
    return files


def _fields(sets: list[ResidualSet]) -> list[ResidualSet]:
    """Return the sets to draw over the image: one a lens and range that a scenario names."""
    named: dict[Any, ResidualSet] = {}
    for one in sets:
        key = one.tags.get('lens'), one.tags.get('radius')
        same_lens = sum(lens == key[0] for lens, _ in named)
        if None not in key and len(one.points) and same_lens < _FIELDS:
            named.setdefault(key, one)
    return list(named.values())
