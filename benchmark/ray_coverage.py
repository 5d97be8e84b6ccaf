"""Do stated ray errors contain the true ones: `python -m benchmark.ray_coverage --sets 30`.

Photographs of a board that may be bent, through a Kannala-Brandt lens whose viewpoint may move,
five to eight or fourteen to eighteen of them; the image points of every other set are warped by
waves of .05 to .4 px, rms. Each set is calibrated and diagnosed. The ray errors that the diagnosis
states of both lenses at 0.3, 1 and 5 m are compared with the true ones: the share of true errors
below, within and above their 95 % intervals, and the geometric means of the true error over the
stated one and of the extended lens's error over that of the lens as calibrated.

Writes docs/results/ray_coverage.md.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmark.averaging import HEIGHT, WIDTH
from benchmark.image_field import FRAMES, draw_warped_set
from benchmark.true_rays import ray_errors
from benchmark.workers import in_processes
from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.diagnosis import diagnose
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.solve.lens_calibration import calibrate
from fisheye_svp_ros.solve.ray_errors import typical_points

_FEW = 5, 9
_LENSES = ('given', 'extended')


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
    table, truth, size = draw_warped_set(number, _FEW if few else FRAMES)
    given = calibrate(table, 'kannala_brandt', (WIDTH, HEIGHT)).adjusted.lens
    found = diagnose(table, given, free_intrinsics=True)
    uv = typical_points(table.uv)
    true = [ray_errors(lens, truth, uv) for lens in (given, found.lens)]
    stated = found.conclusion.ray_error_mrad()
    value, low, high = (
        np.array([[one[name] for one in stated[lens]] for lens in _LENSES])
        for name in ('value', 'low', 'high'))
    offered = found.conclusion.decision['lens'].say in ('use_extended', 'recalibrate')
    return Outcome(bool(few), bool(size), offered, np.array(true), value, low, high)


def report(outcomes: Sequence[Outcome], command: str) -> str:
    """Return the page."""
    kinds = {
        '14 to 18 frames': [one for one in outcomes if not one.few and not one.warped],
        '14 to 18 frames, warp': [one for one in outcomes if not one.few and one.warped],
        '5 to 8 frames': [one for one in outcomes if one.few and not one.warped],
        '5 to 8 frames, warp': [one for one in outcomes if one.few and one.warped],
        'all': list(outcomes)}
    lines = ['# Coverage of ray errors', '', *(__doc__ or '').split('\n')[2:8], '',
             f'`{command}`', '',
             '| sets | number | given: below | within | above | true / stated '
             '| extended: below | within | above | true / stated | extended / given |',
             '|---|---|---|---|---|---|---|---|---|---|---|']
    for name, some in kinds.items():
        if some:
            sides = np.mean([one.outside for one in some], axis=(0, 3))
            ratio = np.exp(np.mean([np.log(one.true / one.value) for one in some], axis=(0, 2)))
            gain = np.exp(np.mean([np.log(one.true[1] / one.true[0]) for one in some]))
            cells = [f'{100 * below:.0f} % | {100 * (1 - below - above):.0f} % | '
                     f'{100 * above:.0f} % | {size:.2f}' for (below, above), size in
                     zip(sides, ratio, strict=True)]
            lines.append(f'| {name} | {len(some)} | {" | ".join(cells)} | {gain:.2f} |')
    for name, some in {'all': list(outcomes),
                       'those offered': [one for one in outcomes if one.offered]}.items():
        rms = np.sqrt([(one.true**2).mean(axis=1) for one in some]).reshape(-1, 2)
        lines += ['', f'More than 10 % worse than the lens as calibrated, of {name}: '
                  f'{int((rms[:, 1] > 1.1 * rms[:, 0]).sum())} of {len(some)}.']
    return '\n'.join(lines) + '\n'


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw, diagnose and compare sets."""
    parser = argparse.ArgumentParser(prog='python -m benchmark.ray_coverage')
    parser.add_argument('--sets', type=int, default=30, help='of each of four kinds')
    parser.add_argument('--workers', type=int, default=os.cpu_count(), help='processes')
    parser.add_argument('-o', '--output', type=Path, default=Path('docs'), help='directory')
    asked = parser.parse_args(arguments)
    outcomes = in_processes('ray coverage', trial, range(4 * asked.sets), asked.workers)
    page = report(outcomes, f'python -m benchmark.ray_coverage --sets {asked.sets}')
    write_text(asked.output / 'results' / 'ray_coverage.md', page)
    sys.stdout.write(page)


if __name__ == '__main__':
    main()
