"""`fisheye-svp demo`: the whole node graph as processes, recorded, summarized and plotted."""

from __future__ import annotations

import argparse
import os
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fisheye_svp_ros.commands.node_sweeps import start_in_step, values
from fisheye_svp_ros.commands.notes import note_formats
from fisheye_svp_ros.commands.outputs import add_output_folder
from fisheye_svp_ros.commands.processes import Processes
from fisheye_svp_ros.commands.record import TOPICS
from fisheye_svp_ros.errors import OutputError
from fisheye_svp_ros.io.bags import Bag
from fisheye_svp_ros.io.columns import write_table
from fisheye_svp_ros.io.files import write_json, write_text, write_together
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.recording import (
    ResidualSet,
    has_residuals,
    is_tabulated,
    tabulate,
)
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.nodes.executables import missing_rclpy
from fisheye_svp_ros.optics import engines
from fisheye_svp_ros.paper.demonstration import (
    TASKS,
    DemoRow,
    camera_parameters,
    compute_demo,
    demo_rows,
    rectified_pair,
    residual_fields,
)
from fisheye_svp_ros.paper.tables import LENSES
from fisheye_svp_ros.reporting.terminal import print_table, progress, range_text
from fisheye_svp_ros.reporting.undistort_report import (
    draw_pair,
    print_remaining,
    remaining_document,
    rows_left,
)
from fisheye_svp_ros.scene.observations import RADII

_MARK, _RECORDING, _ANSWER = '.demo', 'recording', 'errors.png'
_PATIENCE = 900.0  # s; only a hang takes this long


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    add_output_folder(
        parser,
        'folder to write errors.png, the recording (it replaces an earlier one), demo.json, '
        'table.csv, table.parquet, and more pictures to. Default: demo',
        default='demo',
    )
    parser.add_argument(
        '--lenses',
        nargs='+',
        default=list(LENSES),
        choices=LENSES,
        metavar='LENS',
        help=f"the paper's lenses to run: {' '.join(LENSES)}",
    )
    parser.add_argument(
        '--radii',
        nargs='+',
        type=float,
        default=list(RADII),
        choices=RADII,
        metavar='M',
        help="the paper's landmark distances to run, m: " + ' '.join(map(str, RADII)),
    )


def run(args: argparse.Namespace) -> None:
    """Run the graph; make everything else from its recording.

    Where no node can run, the same scenarios are computed in this process.
    """
    lenses, radii = list(dict.fromkeys(args.lenses)), list(dict.fromkeys(args.radii))
    bag = args.output / _RECORDING
    if reason := missing_rclpy():
        print(
            f'  ROS 2 is missing ({reason}): the same scenarios run in one process, without nodes.'
        )
        table, fields = compute_demo(lenses, radii)
    else:
        with progress('running the nodes'):
            record(bag, args.output / 'logs', lenses, radii)
        table = tabulate(Bag(bag).records(is_tabulated))
        fields = residual_fields(Bag(bag).records(has_residuals))
    rows = demo_rows(table, lenses, radii)
    with progress('rectifying a pair'):
        pair, images = rectified_pair(load_lens(lens_path(lenses[0])))
        apart = rows_left(pair)
    with write_together():
        write_table(args.output / 'table', table)
        write_json(
            args.output / 'demo.json',
            {
                'recording': None if reason else str(bag),
                'rows': [row._asdict() for row in rows],
                'rectified': remaining_document(apart),
            },
        )
    if _draw(args.output, rows, fields):
        print(
            f'{args.output / _ANSWER}: the errors of this package next to those that Kita '
            'published. The same as tables:\n'
        )
    draw_pair(args.output / 'rectified.png', *images)
    note_formats()
    _print(rows)
    print_remaining(
        f'A pair of {lenses[0]}, rectified at {range_text(pair.left.range)}: row difference '
        'between left and right',
        apart,
    )
    print(f'  {"" if reason else "recording, "}table, and more pictures: {args.output}')


def record(bag: Path, logs: Path, lenses: Sequence[str], radii: Sequence[float]) -> None:
    """Run the node graph through its scenarios, in lock-step, into a recording."""
    mark = logs.parent / _MARK
    if bag.exists() and not mark.exists():
        raise OutputError(f'{bag}: it exists and is not from an earlier demo; choose another -o')
    # All is solved before Numba is loaded, let alone compiled.
    if os.environ.get(engines.VARIABLE, 'auto') == 'auto':
        engines.use('numpy')
    write_text(mark, 'fisheye-svp demo made `recording`, and replaces it.\n')
    shutil.rmtree(bag, ignore_errors=True)
    cameras = []
    with Processes(logs) as processes:
        # Markers too: the layouts in config/layouts show them.
        topics = f'{TOPICS}|.*/markers'
        processes.start('recorder', ['record', '-o', str(bag), '--topics', topics])
        for task in TASKS:
            cameras.append(f'camera_{task.name}')
            start_in_step(
                processes,
                cameras[-1],
                [task.node],
                ['-r', f'__ns:=/{task.name}'],
                values(**camera_parameters(task, lenses, radii)),
            )
        processes.wait(cameras, _PATIENCE)
        processes.stop('recorder')
        for task in TASKS:
            processes.stop(task.node)


def _print(rows: Sequence[DemoRow]) -> None:
    for task in TASKS:
        mine = [row for row in rows if row.task == task.name]
        axis = () if task.name == 'depth' else ('axis, deg', 'Kita, deg')
        print_table(
            task.title,
            (
                'lens',
                'radius, m',
                task.swept,
                'error, mm',
                'Kita, mm',
                *axis,
                'image, px',
                'Kita, px',
            ),
            map(_cells, mine),
        )


def _cells(row: DemoRow) -> tuple[str, ...]:
    def span(values: tuple[float, float], scale: float) -> str:
        low, high = (scale * value for value in values)
        return number(low) if not low < high else f'{low:g} to {high:g}'

    def number(value: float) -> str:
        return '' if np.isnan(value) else f'{value:.4f}'

    axis = map(number, np.degrees([row.axis_error, row.published_axis_error]))
    return (
        row.lens,
        f'{row.radius:g}',
        row.where,
        number(1e3 * row.error),
        span(row.published_error, 1e3),
        *(() if row.task == 'depth' else axis),
        number(row.pixels),
        span(row.published_pixels, 1),
    )


def _draw(folder: Path, rows: Sequence[DemoRow], fields: Sequence[ResidualSet]) -> bool:
    """Draw the pictures; return whether that of the errors was drawn."""
    from fisheye_svp_ros.paper.demonstration_plots import draw_comparison, draw_residual_fields
    from fisheye_svp_ros.reporting.terminal import draw_or_note

    drawn = draw_or_note(folder / _ANSWER, draw_comparison, rows)
    draw_or_note(folder / 'residuals.png', draw_residual_fields, fields)
    return drawn
