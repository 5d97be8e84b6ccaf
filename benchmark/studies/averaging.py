"""What averaging over all likely models is worth: `make study NAME=averaging`.

Few photographs of a board that may be bent, through a Kannala-Brandt lens whose viewpoint may
move; the image points are formed by a few lines of their own. Each set is calibrated and
diagnosed; against the truth stand the lens of `calibrate`, the lens with the confirmed causes
alone, and the lens that is written. Ray error: rms angle at 0.3, 1 and 5 m over the part of the
image that was photographed, a common motion of the camera frame taken out.

Writes docs/results/averaging.md and docs/images/averaging.png.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmark import study
from benchmark.studies.boards import HEIGHT, WIDTH, draw_set
from fisheye_svp_ros.reporting.diagnosis_plots import AFTER, BEFORE, NOISE
from fisheye_svp_ros.reporting.plots import legend_below, picture
from fisheye_svp_ros.reporting.style import INK


class Outcome(NamedTuple):
    """Of one set: e0 as it is and as it is written, m, its stated error and its weight.

    errors: ray errors, mrad, of three lenses: of `calibrate`, with the causes alone, as written.
    """

    e0: float
    written: float
    stderr: float
    weight: float
    named: bool
    errors: tuple[float, float, float]


def trial(seed: int) -> Outcome:
    """Calibrate and diagnose one set."""
    seen, truth = draw_set(seed)
    given, found = study.calibrated_and_diagnosed(seen, (WIDTH, HEIGHT), free_intrinsics=True)
    named = found.evaluation.extended_lenses(found.evaluation.null.linear.state)['']
    names = [cause.effect for cause in found.causes]
    shift = [
        one
        for one in found.evaluation.averaged_model.effects
        if one.effect.name == 'viewpoint_shift'
    ]
    written = getattr(found.lens.viewpoint_shift, 'e0', 0.0)
    return Outcome(
        truth.viewpoint_shift.e0,
        written,  # type: ignore[union-attr]
        float(shift[0].stderr[0]) if shift else 0.0,
        shift[0].weight if shift else 0.0,
        'viewpoint_shift' in names,
        tuple(study.ray_error(lens, truth, seen.uv) for lens in (given, named, found.lens)),
    )


def report(outcomes: Sequence[Outcome], command: str) -> str:
    """Return the page: geometric means of the ray error over that of `calibrate`."""
    kinds = {
        'a shift that is not named': [one for one in outcomes if one.e0 and not one.named],
        'a shift that is named': [one for one in outcomes if one.e0 and one.named],
        'no shift': [one for one in outcomes if not one.e0],
        'all': list(outcomes),
    }
    rows = []
    for name, some in kinds.items():
        if some:
            errors = np.array([one.errors for one in some])
            ratio = errors[:, 1:] / errors[:, :1]
            rows.append(
                [
                    name,
                    len(some),
                    *(
                        f'{np.exp(np.log(one).mean()):.3f} ({(one > 1.1).sum()})'
                        for one in ratio.T
                    ),
                ]
            )
    return study.page(
        'Averaging over all likely models',
        __doc__,
        command,
        [
            'Ray error over that of `calibrate`, geometric means; in brackets how many lenses are '
            'more than 10 % worse than the one given.'
        ],
        study.table('sets | number | confirmed causes alone | as written', rows),
    )


def draw(path: Path, outcomes: Sequence[Outcome]) -> None:
    """Draw e0 as written against the truth, and what averaging does to the ray error."""
    with picture(path, 10.5, 4.6) as figure:
        left, right = figure.subplots(1, 2)
        open_ = [one for one in outcomes if not one.named]
        for some, color, label in (
            ([one for one in outcomes if one.named], NOISE, 'named'),
            ([one for one in open_ if one.weight], AFTER, 'averaged'),
            ([one for one in open_ if not one.weight], BEFORE, 'not written'),
        ):
            left.errorbar(
                [1e3 * one.e0 for one in some],
                [1e3 * one.written for one in some],
                [1e3 * one.stderr for one in some],
                fmt='o',
                ms=4,
                lw=1,
                color=color,
                label=label,
            )
            before, after = (np.array([one.errors[i] for one in some]) for i in (1, 2))
            right.plot(before, after, 'o', ms=4, color=color)
        left.axline((0, 0), slope=1, color=INK, lw=0.8)
        left.set(xlabel='true e0 / mm', ylabel='e0 in the lens file / mm')
        right.axline((1, 1), slope=1, color=INK, lw=0.8)
        right.set(
            xscale='log',
            yscale='log',
            xlabel='ray error, confirmed causes alone / mrad',
            ylabel='ray error of the lens file / mrad',
        )
        legend_below(figure, left)


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw, diagnose and compare sets."""
    outcomes, output = study.run_sets(
        'averaging', __doc__, trial, report, arguments, (120, 'of photographs')
    )
    draw(output / 'images' / 'averaging.png', outcomes)


if __name__ == '__main__':
    main()
