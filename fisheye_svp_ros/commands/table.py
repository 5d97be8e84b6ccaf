"""`fisheye-svp table`: a recording to a table, one row an input stamp."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from fisheye_svp_ros.io.files import together

_SHOWN = 40  # rows for people


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument('bag', metavar='BAG',
                        help='a rosbag2 recording: its folder or its .mcap file')
    parser.add_argument('-o', '--output', type=Path, metavar='DIR',
                        help='folder for table.csv, table.parquet and table.json')


def run(args: argparse.Namespace) -> None:
    """Join the error topics by stamp, print what varies, write all of it."""
    from fisheye_svp_ros.commands.notes import note_formats, say
    from fisheye_svp_ros.errors import BagError
    from fisheye_svp_ros.io.bags import Bag
    from fisheye_svp_ros.io.recording_table import STAMP, is_tabulated, tabulate
    from fisheye_svp_ros.reporting.progress import progress

    bag = Bag(args.bag)
    with progress('reading', bag.size) as passed:
        columns = tabulate(bag.records(is_tabulated, passed))
    rows = len(columns[STAMP])
    if bag.damage:
        say(f'{args.bag}: {bag.damage}')
    if not rows:
        raise BagError(f'{args.bag}: neither scenarios nor results in it; record them with '
                       '`fisheye-svp record` or `ros2 bag record`')
    _print(args.bag, columns)
    if args.output:
        from fisheye_svp_ros.io.columns import write_columns
        from fisheye_svp_ros.io.results import write_json

        with together():
            write_columns(args.output / 'table', columns)
            write_json(args.output / 'table.json', {
                'bag': str(args.bag), 'rows': rows, 'columns': list(columns),
                'damage': bag.damage,
            })
        note_formats()


def _print(bag: str, columns: dict[str, list[Any]]) -> None:
    """Print the columns that differ from row to row; the others once, above the table."""
    from fisheye_svp_ros.reporting.tables import print_table

    rows = list(zip(*columns.values(), strict=True))
    varying = [name for name, cells in columns.items() if len(set(cells)) > 1] or list(columns)
    for name in columns:
        if name not in varying:
            print(f'  {name}: {_cell(columns[name][0])}')
    picked = [list(columns).index(name) for name in varying]
    print_table(
        f'{bag}: {len(rows)} rows' + (f', the first {_SHOWN}' if len(rows) > _SHOWN else ''),
        varying,
        [[_cell(row[i]) for i in picked] for row in rows[:_SHOWN]],
    )


def _cell(value: Any) -> str:
    if value is None:
        return ''
    return f'{value:.6g}' if isinstance(value, float) else str(value)
