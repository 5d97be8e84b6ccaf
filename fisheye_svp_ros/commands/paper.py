"""`fisheye-svp paper`: Kita's evaluation beside the published numbers, and past it."""

from __future__ import annotations

import argparse

from fisheye_svp_ros.commands.outputs import add_output_folder


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    add_output_folder(
        parser,
        'folder to write paper.json, paper.md, paper.html and the pictures to; default: paper',
        default='paper',
    )


def run(args: argparse.Namespace) -> None:
    """Evaluate and report."""
    import os

    from fisheye_svp_ros.commands.executors import process_pool
    from fisheye_svp_ros.paper.report import write_paper_report
    from fisheye_svp_ros.paper.results import compute, task_count
    from fisheye_svp_ros.reporting.terminal import print_table, progress

    with process_pool(os.cpu_count() or 1) as workers:
        with progress('evaluating', task_count()) as step:
            results = compute(workers.executor, step)
        with progress('drawing'):
            written = write_paper_report(results, args.output, workers.executor)
    print_table(
        f'Tables 1 and 2: {results.agreeing(0.10)} of 36 z and residual cells within 10 % of the '
        f'published ones, {results.agreeing(0.05)} within 5 %',
        ('cell', 'published', 'ours', 'unit', 'difference %'),
        [
            (
                f'{cell.lens} {cell.radius} m {cell.row} {cell.quantity}',
                f'{cell.published:.4f}',
                f'{cell.ours:.4f}',
                cell.unit,
                f'{100 * cell.relative:+.1f}',
            )
            for cell in results.cells()
            if cell.table < 3 and cell.quantity in ('z', 'residual')
        ],
    )
    verdicts = ', '.join(f'{verdict}: {count}' for verdict, count in results.verdicts().items())
    print(f'  {len(results.claims)} statements of the text; {verdicts}')
    for path in written:
        print(f'  {path}')
