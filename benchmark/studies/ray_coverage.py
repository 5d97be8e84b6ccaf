"""Do stated ray errors contain the true ones: `make study NAME=ray_coverage`.

Photographs of a board that may be bent, through a Kannala-Brandt lens whose viewpoint may move,
five to eight or fourteen to eighteen of them; the image points of every other set are warped by
waves of .05 to .4 px, rms. Each set is calibrated and diagnosed. The ray errors that the diagnosis
states of both lenses at 0.3, 1 and 5 m are compared with the true ones: the share of true errors
below, within and above their 95 % intervals, and the geometric means of the true error over the
stated one, and of the errors of both lenses over those of least squares (`calibrate --plain`). A
second table has that ratio for such photographs through a lens whose viewpoint stands still, of a
board as it is said to be, or off in one way.

Writes docs/results/ray_coverage.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from benchmark import study
from benchmark.studies.boards import (
    FEW,
    FRAMES,
    HEIGHT,
    WIDTH,
    BoardErrors,
    draw_set,
    draw_warped_set,
)
from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.solve.ray_errors import RANGES, typical_points

SIZE = (WIDTH, HEIGHT)
BOARDS = {
    'as it is said to be': BoardErrors(bent=False, off=False),
    'landmarks off': BoardErrors(bent=False, off=True),
    'bent': BoardErrors(bent=True, off=False),
}


class Outcome(NamedTuple):
    """Of one set: its kind, whether the extended lens is offered, and the ray errors.

    true, value, low, high (2, R), mrad: of the lens as calibrated and of the extended one; plain
    (R,), mrad: of that by least squares; ratios (B,): of the errors of both for each of `BOARDS`,
    none of a warped set.
    """

    few: bool
    warped: bool
    offered: bool
    true: Array
    value: Array
    low: Array
    high: Array
    plain: Array
    ratios: Array

    @property
    def outside(self) -> Mask:
        """Which true errors (2, 2, R) lie below and which above their intervals."""
        return np.stack([self.true < self.low, self.true > self.high], axis=1)

    @property
    def gain(self) -> float:
        """The error of the lens as calibrated over that of the extended one, all ranges."""
        given, extended = np.sqrt((self.true**2).mean(axis=1))
        return float(given / extended)


def trial(number: int) -> Outcome:
    """Calibrate and diagnose one set: of four, two have few frames and two a warp."""
    number, few = divmod(number, 2)
    seen, truth, size = draw_warped_set(number, FEW if few else FRAMES)
    given, found = study.calibrated_and_diagnosed(seen, SIZE, free_intrinsics=True)
    uv, plain = typical_points(seen.uv), study.calibrated(seen, SIZE, plain=True)
    *true, least_squares = (
        study.ray_errors(lens, truth, uv) for lens in (given, found.lens, plain)
    )
    stated = found.ray_error_mrad()
    value, low, high = (
        np.array([[one[name] for one in stated[lens]] for lens in ('given', 'extended')])
        for name in ('value', 'low', 'high')
    )
    offered = found.decision['lens'].say in ('use_extended', 'recalibrate')
    ratios = [] if size else [_over_plain(number // 2, few, errors) for errors in BOARDS.values()]
    return Outcome(
        bool(few),
        bool(size),
        offered,
        np.array(true),
        value,
        low,
        high,
        least_squares,
        np.array(ratios),
    )


def _over_plain(seed: int, few: int, errors: BoardErrors) -> float:
    """Return the ray error of the lens that `calibrate` writes over that by least squares."""
    seen, truth = draw_set(seed, FEW if few else FRAMES, errors=errors)
    ours, plain = (
        study.ray_error(study.calibrated(seen, SIZE, plain=plain), truth, typical_points(seen.uv))
        for plain in (False, True)
    )
    return ours / plain


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
            gains = [
                np.exp(np.mean([np.log(after / before) for after, before in pairs]))
                for pairs in ([(one.true[side], one.plain) for one in some] for side in (0, 1))
            ]
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
            rows.append([name, len(some), *cells, *(f'{gain:.2f}' for gain in gains)])
    sentences = []
    outside = np.mean([one.outside.any(axis=1) for one in outcomes], axis=0)
    for name, shares in zip(('given', 'extended'), outside, strict=True):
        each = ', '.join(
            f'{100 * (1 - share):.0f} % at {far:g} m'
            for far, share in zip(RANGES, shares, strict=True)
        )
        sentences.append([f'Within, of the {name} lens: {each}.'])
    for name, some in {
        'all': list(outcomes),
        'those offered': [one for one in outcomes if one.offered],
    }.items():
        worse = sum(one.gain < 1 / 1.1 for one in some)
        sentences.append(
            [
                f'More than 10 % worse than the lens as calibrated, of {name}: '
                f'{worse} of {len(some)}.'
            ]
        )
    twice = [one for one in outcomes if one.gain >= 2]
    missed = sum(not one.offered for one in twice)
    sentences.append([f'Not offered, of those at least twice as good: {missed} of {len(twice)}.'])
    head = (
        'sets | number | given: below | within | above | true / stated '
        '| extended: below | within | above | true / stated '
        '| given / least squares | extended / least squares'
    )
    return study.page(
        'Coverage of ray errors',
        __doc__,
        command,
        study.table(head, rows),
        *sentences,
        _boards_table(outcomes),
    )


def _boards_table(outcomes: Sequence[Outcome]) -> list[str]:
    """Return the lines of the table of lenses by least squares and by `calibrate`."""
    rows = []
    for i, name in enumerate(BOARDS):
        for few in (False, True):
            ratios = [one.ratios[i] for one in outcomes if one.few == few and len(one.ratios)]
            if ratios:
                low, high = np.quantile(ratios, (0.05, 0.95))
                mean = np.exp(np.mean(np.log(ratios)))
                frames = '5 to 8' if few else '14 to 18'
                rows.append([name, frames, len(ratios), f'{mean:.2f}', f'{low:.2f} to {high:.2f}'])
    head = 'board | frames | number | calibrate / least squares | 90 % of the sets'
    return study.table(head, rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw, diagnose and compare sets."""
    study.run_sets(
        'ray_coverage', __doc__, trial, report, arguments, (50, 'of each of four kinds'), each=4
    )


if __name__ == '__main__':
    main()
