"""`python -m benchmark.studies.paper search`, then `stopping`: both, `make study NAME=paper`.

`search` solves for the lens curves and the landmarks that the paper does not print, and writes
DIR/lenses, DIR/environments/kita.yaml and DIR/paper_search.yaml; `stopping` then tries solvers
that stop early on what stands in config/, and writes DIR/paper_stopping.yaml.
"""

from __future__ import annotations

import argparse
import os
from concurrent.futures import Executor
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from benchmark.studies.paper.search import STARTS, recover
from benchmark.studies.paper.stopping import stopping_document
from benchmark.studies.paper.writing import (
    best_of,
    calibration_range,
    family_document,
    layout_document,
    lens_document,
    whole_directions,
)
from fisheye_svp_ros.commands.executors import process_pool
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.io.lens_files import lens_from_dict, load_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.paper.tables import LENSES
from fisheye_svp_ros.reporting.terminal import progress


def search(executor: Executor) -> dict[str, Any]:
    """Return the files that the search makes, by name."""
    lenses = tuple(load_lens(lens_path(name)) for name in LENSES)
    found = []
    with progress('fitting tables 1 and 2', STARTS) as step:
        for one in executor.map(partial(recover, lenses), range(STARTS)):
            found.append(one)
            step()
    best = best_of(found)
    documents = [lens_document(lens, best, STARTS) for lens in lenses]
    with progress('calibrating rigs from many sets of poses'):
        ranges = executor.map(
            calibration_range, map(lens_from_dict, documents), [whole_directions(best)] * 2
        )
        family = family_document(found, dict(zip(LENSES, ranges, strict=True)))
    return {
        **{f'lenses/{name}.yaml': one for name, one in zip(LENSES, documents, strict=True)},
        'environments/kita.yaml': layout_document(best, STARTS),
        'paper_search.yaml': family,
    }


def stopping(executor: Executor) -> dict[str, Any]:
    """Return the file that the study of early stops makes, by name."""
    with progress('stopping early'):
        return {'paper_stopping.yaml': stopping_document(executor)}


def main() -> None:
    """Run the studies, one after the other, and write their files."""
    parser = argparse.ArgumentParser(prog='python -m benchmark.studies.paper', description=__doc__)
    studies = {'search': search, 'stopping': stopping}
    parser.add_argument('study', nargs='?', choices=tuple(studies), help='default: both')
    parser.add_argument(
        '-o', '--output', type=Path, default=Path('config'), metavar='DIR', help='default: config'
    )
    args = parser.parse_args()
    for study in [args.study] if args.study else studies:
        with process_pool(os.cpu_count() or 1) as workers:
            files = studies[study](workers.executor)
        for name, document in files.items():
            text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=95)
            write_text(args.output / name, text)
            print(f'  {args.output / name}')


if __name__ == '__main__':
    main()
