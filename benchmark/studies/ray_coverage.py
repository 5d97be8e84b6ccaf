"""Do stated ray errors contain the true ones: `make study NAME=ray_coverage`.

Photographs of a board that may be bent, through a Kannala-Brandt lens whose viewpoint may move,
five to eight or fourteen to eighteen of them; the image points of every other set are warped by
waves of .05 to .4 px, rms. Each set is calibrated and diagnosed. The ray errors that the diagnosis
states of both lenses at 0.3, 1 and 5 m are compared with the true ones: the share of true errors
below, within and above their 95 % intervals, and the geometric means of the true error over the
stated one and of the extended lens's error over that of the lens as calibrated.

Writes docs/results/ray_coverage.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from benchmark import study
from benchmark.studies.boards import FEW, FRAMES, HEIGHT, WIDTH, draw_warped_set
from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.solve.ray_errors import RANGES, typical_points


class Outcome(NamedTuple):
    """Of one set: its kind, whether the extended lens is offered, and the ray errors.

    true, value, low, high (2, R), mrad: of the lens as calibrated and of the extended one.
    """

    few: bool
    warped: bool
    offered: bool
    true: Array
    value: Array
    low: Array
    high: Array

    @property
    def outside(self) -> Mask:
        """Which true errors (2, 2, R) lie below and which above their intervals."""
        return np.stack([self.true < self.low, self.true > self.high], axis=1)


def trial(number: int) -> Outcome:
    """Calibrate and diagnose one set: of four, two have few frames and two a warp."""
    number, few = divmod(number, 2)
    seen, truth, size = draw_warped_set(number, FEW if few else FRAMES)
    given, found = study.calibrated_and_diagnosed(seen, (WIDTH, HEIGHT), free_intrinsics=True)
    uv = typical_points(seen.uv)
    true = [study.ray_errors(lens, truth, uv) for lens in (given, found.lens)]
    stated = found.ray_error_mrad()
    value, low, high = (
        np.array([[one[name] for one in stated[lens]] for lens in ('given', 'extended')])
        for name in ('value', 'low', 'high')
    )
    offered = found.decision['lens'].say in ('use_extended', 'recalibrate')
    return Outcome(bool(few), bool(size), offered, np.array(true), value, low, high)


def report(outcomes: Sequence[Outcome], command: str) -> str:
    """Return the page."""
    kinds = {
        f'{"5 to 8" if few else "14 to 18"} frames{", warp" * warped}': [
            one for one in outcomes if (one.few, one.warped) == (few, warped)
        ]
        for few, warped in product((False, True), repeat=2)
    } | {'all': list(outcomes)}
    rows = []
    for name, some in kinds.items():
        if some:
            sides = np.mean([one.outside for one in some], axis=(0, 3))
            ratio = np.exp(np.mean([np.log(one.true / one.value) for one in some], axis=(0, 2)))
            gain = np.exp(np.mean([np.log(one.true[1] / one.true[0]) for one in some]))
            cells = [
                cell
                for (below, above), size in zip(sides, ratio, strict=True)
                for cell in (
                    f'{100 * below:.0f} %',
                    f'{100 * (1 - below - above):.0f} %',
                    f'{100 * above:.0f} %',
                    f'{size:.2f}',
                )
            ]
            rows.append([name, len(some), *cells, f'{gain:.2f}'])
    lines = [
        '# Coverage of ray errors',
        '',
        *study.paragraph(__doc__),
        f'`{command}`',
        '',
        *study.table(
            'sets | number | given: below | within | above | true / stated '
            '| extended: below | within | above | true / stated '
            '| extended / given',
            rows,
        ),
    ]
    outside = np.mean([one.outside.any(axis=1) for one in outcomes], axis=0)
    for name, shares in zip(('given', 'extended'), outside, strict=True):
        each = ', '.join(
            f'{100 * (1 - share):.0f} % at {far:g} m'
            for far, share in zip(RANGES, shares, strict=True)
        )
        lines += ['', f'Within, of the {name} lens: {each}.']
    for name, some in {
        'all': list(outcomes),
        'those offered': [one for one in outcomes if one.offered],
    }.items():
        rms = np.sqrt([(one.true**2).mean(axis=1) for one in some]).reshape(-1, 2)
        lines += [
            '',
            f'More than 10 % worse than the lens as calibrated, of {name}: '
            f'{int((rms[:, 1] > 1.1 * rms[:, 0]).sum())} of {len(some)}.',
        ]
    return '\n'.join([*lines, ''])


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw, diagnose and compare sets."""
    study.run_sets(
        'ray_coverage', __doc__, trial, report, arguments, (50, 'of each of four kinds'), each=4
    )


if __name__ == '__main__':
    main()
