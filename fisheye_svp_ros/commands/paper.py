"""`fisheye-svp paper`: Kita's evaluation beside the published numbers, and past it."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fisheye_svp_ros.paper.results import Results


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument('-o', '--output', type=Path, default=Path('paper'), metavar='DIR',
                        help='folder for paper.json, paper.md, paper.html and the pictures; '
                        'default: paper')
    parser.add_argument('--search', action='store_true',
                        help='solve instead for the lens curves and the layout that the paper '
                        'does not print, and write them to DIR/lenses, DIR/environments and '
                        'DIR/paper_search.yaml (some minutes)')


def run(args: argparse.Namespace) -> None:
    """Evaluate and report, or search."""
    if args.search:
        _search(args.output)
    else:
        _report(args.output)


def _report(folder: Path) -> None:
    import os

    from fisheye_svp_ros.commands.executors import local
    from fisheye_svp_ros.paper.report import write_report
    from fisheye_svp_ros.paper.results import compute, tasks
    from fisheye_svp_ros.reporting.progress import progress

    with local(os.cpu_count() or 1) as workers:
        with progress('evaluating', tasks()) as step:
            results = compute(workers.executor, step)
        with progress('drawing'):
            written = write_report(results, folder, workers.executor)
    _print(results)
    for path in written:
        print(f'  {path}')


def _print(results: Results) -> None:
    import numpy as np

    from fisheye_svp_ros.paper.claims import FAILS, HOLDS, IN_PART
    from fisheye_svp_ros.paper.tables import LENSES, agreeing
    from fisheye_svp_ros.reporting.tables import print_table

    tables = np.stack([results.svp[name].localization for name in LENSES])
    print_table(
        f'Tables 1 and 2: {agreeing(tables, 0.10)} of 36 z and residual cells within 10 % of the '
        f'published ones, {agreeing(tables, 0.05)} within 5 %',
        ('cell', 'published', 'ours', 'unit', 'difference %'),
        [
            (f'{cell.lens} {cell.radius} m {cell.row} {cell.quantity}', f'{cell.published:.4f}',
             f'{cell.ours:.4f}', cell.unit, f'{100 * cell.relative:+.1f}')
            for cell in results.cells()
            if cell.table < 3 and cell.quantity in ('z', 'residual')
        ],
    )
    verdicts = [claim.verdict for claim in results.claims]
    print(f'  {len(verdicts)} statements of the text: {verdicts.count(HOLDS)} hold, '
          f'{verdicts.count(IN_PART)} hold in part, {verdicts.count(FAILS)} do not')


def _search(folder: Path) -> None:
    import os
    from functools import partial

    import yaml

    from fisheye_svp_ros.commands.executors import local
    from fisheye_svp_ros.io.files import write_text
    from fisheye_svp_ros.io.lens_files import lens_from_dict, load_lens
    from fisheye_svp_ros.io.share import lens_path
    from fisheye_svp_ros.paper.family import (
        best_of,
        family_document,
        layout_document,
        lens_document,
        whole_directions,
    )
    from fisheye_svp_ros.paper.poses import calibration_range
    from fisheye_svp_ros.paper.search import STARTS, recover
    from fisheye_svp_ros.paper.tables import LENSES
    from fisheye_svp_ros.reporting.progress import progress

    fish180, fish214 = (load_lens(lens_path(name)) for name in LENSES)
    found = []
    with local(os.cpu_count() or 1) as workers:
        with progress('fitting tables 1 and 2', STARTS) as step:
            for one in workers.executor.map(partial(recover, (fish180, fish214)), range(STARTS)):
                found.append(one)
                step()
        best = best_of(found)
        documents = [lens_document(lens, best, STARTS) for lens in (fish180, fish214)]
        recovered = [lens_from_dict(document) for document in documents]
        with progress('calibrating rigs from many sets of poses'):
            ranges = workers.executor.map(
                calibration_range, recovered, [whole_directions(best)] * 2)
            family = family_document(found, dict(zip(LENSES, ranges, strict=True)))
    for name, document in (
        ('lenses/fish180.yaml', documents[0]),
        ('lenses/fish214.yaml', documents[1]),
        ('environments/kita.yaml', layout_document(best, STARTS)),
        ('paper_search.yaml', family),
    ):
        text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=95)
        write_text(folder / name, text)
        print(f'  {folder / name}')
