"""`python -m benchmark.speed`: measure everything and write docs/results/benchmarks.md."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

# One core: read when NumPy and its peers are imported.
for _name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'NUMBA_NUM_THREADS'):
    os.environ.setdefault(_name, '1')

from benchmark.speed import (  # noqa: E402
    commands,
    effort,
    growth,
    localization,
    maps,
    nodes,
    projection,
    stereo,
    sweeps,
    variants,
)
from benchmark.speed.report import document  # noqa: E402
from benchmark.speed.scenes import NOISE_PX  # noqa: E402
from fisheye_svp_ros.io.files import write_text  # noqa: E402
from fisheye_svp_ros.reporting.terminal import progress  # noqa: E402

_PARTS = {
    'projection': projection.rows,
    'maps': maps.rows,
    'localization': localization.rows,
    'stereo': stereo.rows,
    'variants': variants.rows,
    'nodes': nodes.tables,
    'commands': commands.tables,
    'effort': effort.tables,
    'sweeps': sweeps.tables,
    'growth': growth.tables,
}


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(prog='python -m benchmark.speed', description=__doc__)
    parser.add_argument('--only', nargs='+', choices=_PARTS, default=list(_PARTS))
    parser.add_argument('-o', '--output', type=Path, default=Path('docs/results/benchmarks.md'))
    args = parser.parse_args()
    chosen = '' if args.only == list(_PARTS) else f' --only {" ".join(args.only)}'
    sections, unfinished = [], args.output.with_name(f'{args.output.name}.part')
    with progress('measuring', len(args.only)) as advance:
        for part in args.only:
            sections += _PARTS[part]()
            # After every part, so that Ctrl-C keeps what is measured; the page changes at the end,
            # since the tests, which are timed too, read it.
            text = document(f'python -m benchmark.speed{chosen}', NOISE_PX, sections)
            write_text(unfinished, text)
            advance()
    unfinished.replace(args.output)
    print(args.output)


if __name__ == '__main__':
    main()
