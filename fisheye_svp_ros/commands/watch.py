"""`fisheye-svp watch`: the results of running nodes, live."""

from __future__ import annotations

import argparse
from contextlib import suppress
from typing import TYPE_CHECKING

from fisheye_svp_ros.commands.processes import prepare_ros
from fisheye_svp_ros.nodes.executables import ending_quietly
from fisheye_svp_ros.reporting.wording.metrics import metric_text

if TYPE_CHECKING:
    from rich.console import RenderableType

    from fisheye_svp_ros.nodes.watcher import Watcher

_MIN_COLUMNS = 64  # columns: three numbers, and some of the names, which are broken into lines


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument(
        '--ros-args', nargs=argparse.REMAINDER, default=[], metavar='...', help='as for `ros2 run`'
    )


def run(args: argparse.Namespace) -> None:
    """Follow every result topic until interrupted."""
    with ending_quietly():
        prepare_ros()
        from rich.live import Live

        from fisheye_svp_ros.nodes.session import ros_session
        from fisheye_svp_ros.nodes.watcher import Watcher
        from fisheye_svp_ros.reporting.terminal import console

    with ros_session(args.ros_args) as signals, suppress(KeyboardInterrupt):
        signals.begin()
        watcher = Watcher()
        with Live(console=console(), refresh_per_second=4) as live:
            watcher.spin(lambda: live.update(_result_table(watcher, live.console.width)), signals)
        watcher.destroy_node()


def _result_table(watcher: Watcher, width: int) -> RenderableType:
    from rich import box
    from rich.table import Table

    from fisheye_svp_ros.reporting.terminal import short_number

    if width < _MIN_COLUMNS:
        return f'the terminal must be {_MIN_COLUMNS} columns wide; this one has {width}'
    table = Table(box=box.SIMPLE_HEAD)
    for name in ('node', 'metric'):
        table.add_column(name, overflow='fold')
    for name in ('latest', 'mean', 'largest'):
        table.add_column(name, justify='right', no_wrap=True)
    for node, results in sorted(watcher.results.items()):
        lost = f', {results.lost} not solved' if results.lost else ''
        note = f'; the latest: {results.note}' if results.note else ''
        table.add_row(node, f'{results.sets} sets{lost}{note}')
        for name, metric in results.metrics.items():
            text = metric_text(name)
            values = metric.latest, metric.total / metric.count, metric.largest
            shown = '_'.join(filter(None, text[:2]))
            table.add_row('', shown, *(short_number(text.factor * value) for value in values))
    return table
