"""`fisheye-svp paper`: Kita's evaluation beside the published numbers, and past it."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument('-o', '--output', type=Path, default=Path('out/paper'), metavar='DIR',
                        help='folder for paper.json, the reports and the pictures '
                        '(default: %(default)s)')
    parser.add_argument('--search', action='store_true',
                        help='instead, solve for the lens curves and the layout that the paper '
                        'does not print, and write them to DIR/lenses, DIR/environments and '
                        'DIR/paper_search.yaml; some minutes')


def run(args: argparse.Namespace) -> None:
    """Evaluate and report, or search."""
    if args.search:
        _search(args.output)


def _search(folder: Path) -> None:
    import os
    from functools import partial

    import yaml

    from fisheye_svp_ros.commands.executors import local
    from fisheye_svp_ros.evaluation.paper_family import (
        best_of,
        family_document,
        layout_document,
        lens_document,
        whole_directions,
    )
    from fisheye_svp_ros.evaluation.paper_poses import calibration_range
    from fisheye_svp_ros.evaluation.paper_search import STARTS, recover
    from fisheye_svp_ros.evaluation.paper_tables import LENSES
    from fisheye_svp_ros.files import write_text
    from fisheye_svp_ros.lens import lens_from_dict, load_lens
    from fisheye_svp_ros.reporting.progress import progress
    from fisheye_svp_ros.share import lens_path

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
