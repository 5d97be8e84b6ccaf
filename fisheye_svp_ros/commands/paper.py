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
    from concurrent.futures import ProcessPoolExecutor
    from functools import partial

    import yaml

    from fisheye_svp_ros.evaluation.paper_family import (
        best_of,
        family_document,
        layout_document,
        lens_document,
    )
    from fisheye_svp_ros.evaluation.paper_search import STARTS, recover
    from fisheye_svp_ros.evaluation.paper_tables import LENSES
    from fisheye_svp_ros.files import write_text
    from fisheye_svp_ros.lens import load_lens
    from fisheye_svp_ros.reporting.progress import progress
    from fisheye_svp_ros.share import lens_path

    fish180, fish214 = (load_lens(lens_path(name)) for name in LENSES)
    found = []
    with progress('fitting tables 1 and 2', STARTS) as step, ProcessPoolExecutor() as pool:
        for one in pool.map(partial(recover, (fish180, fish214)), range(STARTS)):
            found.append(one)
            step()
    best = best_of(found)
    documents = {
        'lenses/fish180.yaml': lens_document(fish180, best, STARTS),
        'lenses/fish214.yaml': lens_document(fish214, best, STARTS),
        'environments/kita.yaml': layout_document(best, STARTS),
        'paper_search.yaml': family_document(found),
    }
    for name, document in documents.items():
        text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=95)
        write_text(folder / name, text)
        print(f'  {folder / name}')
