"""`fisheye-svp example`: photographs of a bent board through a shifting lens, to try it all on."""

from __future__ import annotations

import argparse

import numpy as np

from fisheye_svp_ros.commands.outputs import add_output_folder
from fisheye_svp_ros.commands.render import parabola, write_photographs
from fisheye_svp_ros.io.files import keep_existing, write_text, write_together
from fisheye_svp_ros.io.lens_files import save_lens
from fisheye_svp_ros.optics.curves import Gennery, KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import identity
from fisheye_svp_ros.simulate.render import Exposure, Print
from fisheye_svp_ros.simulate.targets import board, board_views

_README = """# Fourteen photographs of a bent board

Rendered, with noise, through a fisheye lens whose viewpoint moves (e0 = 4 mm).  The chessboard
is bowed by 1.5 mm in the middle.  `truth/` holds the lens, the poses, and the true corners.

```bash
fisheye-svp detect photographs --board chessboard:9x6:25mm -o observations.csv --overlays overlays
fisheye-svp calibrate observations.csv -o lens.yaml
fisheye-svp diagnose observations.csv --lens lens.yaml -o diagnosis
```

`calibrate`, `localize`, and `diagnose` accept photographs, too: add `--board chessboard:9x6:25mm`.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    add_output_folder(
        parser,
        'folder to write the photographs, the truth and a README to',
        required=True,
    )


def run(args: argparse.Namespace) -> None:
    """Render the photographs, write the truth and a README."""
    lens = Lens(
        'example',
        480,
        450,
        160.3,
        160.5,
        240.4,
        223.7,
        KannalaBrandt(-0.010, 0.004, -0.0015, 0.0),
        np.radians(94.0),
        Gennery(e0=0.004),
    )
    printed = Print(9, 6, 0.025)
    printed = Print(9, 6, 0.025, bow=parabola(printed.corners, 0.0015))
    poses = board_views(lens, printed, 14, (0.10, 0.30), np.random.default_rng(1))
    truth = args.output / 'truth'
    with keep_existing(), write_together():
        write_photographs(
            {'': (lens, identity())},
            board(printed),
            poses,
            Exposure(),
            0,
            args.output / 'photographs',
            truth,
        )
        save_lens(lens, truth / 'lens.yaml')
        write_text(args.output / 'README.md', _README)
    print(f'{args.output}: photographs and README.md, which lists three commands to try on them')
