"""`fisheye-svp table`: a recording to a table, one row an input stamp."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from fisheye_svp_ros.commands.notes import note_formats, say
from fisheye_svp_ros.commands.outputs import add_output_folder
from fisheye_svp_ros.errors import BagError
from fisheye_svp_ros.io.bags import Bag
from fisheye_svp_ros.io.columns import plain_columns, write_table
from fisheye_svp_ros.io.files import write_json, write_together
from fisheye_svp_ros.io.recording import STAMP, is_tabulated, tabulate
from fisheye_svp_ros.reporting.terminal import console, print_table, progress, short_number

if TYPE_CHECKING:
    from pandas import DataFrame

Cells = dict[str, list[str]]  # by column
_MAX_ROWS = 40  # rows for people


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument(
        'bag', metavar='BAG', help='rosbag2 recording: its folder, or its .mcap or .db3 file'
    )
    add_output_folder(
        parser,
        'folder to write table.csv, table.parquet and table.json to',
    )


def run(args: argparse.Namespace) -> None:
    """Join the error topics by stamp, print what varies, write all of it."""
    bag = Bag(args.bag)
    with progress('reading', bag.size) as passed:
        table = tabulate(bag.records(is_tabulated, passed))
    rows = len(table)
    if bag.damage:
        say(f'{args.bag}: {bag.damage}')
    if not rows:
        raise BagError(
            f'{args.bag}: it holds neither scenarios nor results; record them with '
            '`fisheye-svp record` or `ros2 bag record`'
        )
    _print(args.bag, table)
    if args.output:
        with write_together():
            write_table(args.output / 'table', table)
            write_json(
                args.output / 'table.json',
                {
                    'bag': str(args.bag),
                    'rows': rows,
                    'columns': list(table),
                    'damage': bag.damage,
                },
            )
        note_formats()


def _print(bag: str, table: DataFrame) -> None:
    """Print the columns that differ from row to row; the others once, above the table."""
    varying = [name for name in table if table[name].nunique(dropna=False) > 1] or list(table)
    columns = plain_columns(table.head(_MAX_ROWS))
    for name in columns:
        if name not in varying:
            print(f'  {name}: {_cell(columns[name][0])}')
    rows = len(table)
    print(f'{bag}: {rows} rows' + (f', the first {_MAX_ROWS}' if rows > _MAX_ROWS else ''))
    tags, metrics = dict[str, list[str]](), dict[str, list[str]]()
    for name in varying:
        to = metrics if '.' in name else tags
        to[name] = [_cell(value) for value in columns[name]]
    if len(tags) > 1:
        tags.pop(STAMP, None)  # the scenario says it more readably
    for block in _blocks(tags, metrics):
        print_table(
            '',
            list(block),
            zip(*block.values(), strict=True),
            words=[name for name in block if name.endswith(('.note', '.warning'))],
        )


def _blocks(tags: Cells, metrics: Cells) -> Iterator[Cells]:
    """Yield the tags and as many of the metrics as a line has room for, until all are told."""

    def total_width(columns: Cells) -> int:
        return sum(3 + max(map(len, (name, *cells))) for name, cells in columns.items())

    block: Cells = {}
    for name, cells in metrics.items():
        if block and total_width({**tags, **block, name: cells}) > console().width:
            yield tags | block
            block = {}
        block[name] = cells
    yield tags | block


def _cell(value: Any) -> str:
    if value is None:
        return ''
    return short_number(value) if isinstance(value, float) else str(value)
