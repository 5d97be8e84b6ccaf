"""What the image field in a lens file is worth: `make study NAME=image_field`.

Fourteen to eighteen photographs of a board that may be bent, through a Kannala-Brandt lens whose
viewpoint may move; image points are warped by waves of .05 to .4 px, rms, or not at all. Each set
is calibrated and diagnosed; against the truth stand the lens of `calibrate`, the written lens
without its image field, and as it is written. Ray error: rms angle at 0.3, 1 and 5 m over the
part of the image that was photographed, a common motion of the camera frame taken out.

Writes docs/results/image_field.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from benchmark import study
from benchmark.studies.boards import HEIGHT, WIDTH, draw_warped_set


class Outcome(NamedTuple):
    """Of one set: rms of its warp, px, and whether a field is written.

    errors: ray errors, mrad, of three lenses: of `calibrate`, without the field, as written.
    """

    size: float
    written: bool
    errors: tuple[float, float, float]


def trial(number: int) -> Outcome:
    """Calibrate and diagnose one set; every other one has a warp."""
    seen, truth, size = draw_warped_set(number)
    given, found = study.calibrated_and_diagnosed(seen, (WIDTH, HEIGHT), free_intrinsics=True)
    lenses = given, replace(found.lens, image_field=None), found.lens
    first, second, third = (study.ray_error(lens, truth, seen.uv) for lens in lenses)
    return Outcome(size, found.lens.image_field is not None, (first, second, third))


def report(outcomes: Sequence[Outcome], command: str) -> str:
    """Return the page: geometric means of the ray error over that without the field."""
    kinds = {
        'warp of .05 to .14 px': [one for one in outcomes if 0 < one.size <= 0.14],
        'warp of .14 to .4 px': [one for one in outcomes if one.size > 0.14],
        'all warps': [one for one in outcomes if one.size],
        'warps, field written': [one for one in outcomes if one.size and one.written],
        'no warp': [one for one in outcomes if not one.size],
    }
    rows = []
    for name, some in kinds.items():
        if some:
            given, without, with_field = np.log([one.errors for one in some]).T
            ratios = np.exp(
                [
                    (without - given).mean(),
                    (with_field - without).mean(),
                    (with_field - without).max(),
                ]
            )
            rows.append(
                [
                    name,
                    len(some),
                    sum(one.written for one in some),
                    *(f'{one:.3f}' for one in ratios),
                ]
            )
    return study.page(
        'The image field',
        __doc__,
        command,
        [
            'Geometric means of the ray error: without the field over that of `calibrate`,',
            'with the field over that without it; the worst of the latter.',
        ],
        study.table(
            'sets | number | field written | without / calibrate | with / without | worst', rows
        ),
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw, diagnose and compare sets."""
    study.run_sets(
        'image_field',
        __doc__,
        trial,
        report,
        arguments,
        (30, 'with a warp, and as many without'),
        each=2,
    )


if __name__ == '__main__':
    main()
