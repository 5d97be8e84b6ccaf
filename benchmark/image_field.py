"""What the image field in a lens file is worth: `python -m benchmark.image_field --sets 30`.

Fourteen to eighteen photographs of a board that may be bent, through a Kannala-Brandt lens whose
viewpoint may move; image points are warped by waves of .05 to .4 px, rms, or not at all. Each set
is calibrated and diagnosed; against the truth stand the lens of `calibrate`, the written lens
without its image field, and as it is written. Ray error: rms angle at 0.3, 1 and 5 m over the
part of the image that was photographed, a common motion of the camera frame taken out.

Writes docs/results/image_field.md.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmark.averaging import HEIGHT, WIDTH, draw_set
from benchmark.true_rays import ray_error
from benchmark.workers import in_processes
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.diagnosis import diagnose
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.optics.image_field import ImageField
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.solve.lens_calibration import calibrate

FRAMES = 14, 19
_WAVES, _LENGTHS = 4, (560.0, 1260.0)  # of each axis; px
_PITCH = 25.0  # px, of the spline that stands for the true warp


class Outcome(NamedTuple):
    """Of one set: rms of its warp, px, and whether a field is written.

    errors: ray errors, mrad, of three lenses: of `calibrate`, without the field, as written.
    """

    size: float
    written: bool
    errors: tuple[float, float, float]


def draw_warp(rng: np.random.Generator, size: float) -> Callable[[Array], Array]:
    """Return a sum of waves in all directions, of so many px, rms of the 2-D displacement."""
    way = rng.uniform(0, 2 * np.pi, (2, _WAVES))
    number = 2 * np.pi / rng.uniform(*_LENGTHS, (2, _WAVES))
    wave = number[..., None] * np.stack([np.cos(way), np.sin(way)], axis=-1)
    phase = rng.uniform(0, 2 * np.pi, (2, _WAVES))

    def warp(uv: Array) -> Array:
        waves = np.sin(np.einsum('akj,...j->...ak', wave, uv) + phase).sum(axis=-1)
        return np.asarray(size / np.sqrt(_WAVES) * waves)

    return warp


def draw_warped_set(
    number: int, frames: tuple[int, int] = FRAMES
) -> tuple[Observations, Lens, float]:
    """Draw photographs, the lens that took them and the rms of its warp, px; 0 for even ones."""
    seed, warped = divmod(number, 2)
    rng = np.random.default_rng(10_000 + seed)
    size = float(np.exp(rng.uniform(*np.log([0.05, 0.4])))) * warped
    warp = draw_warp(rng, size)
    table, bare = draw_set(seed, frames, warp)
    low, pitch = np.full(2, -4 * _PITCH), np.full(2, _PITCH)
    shape = (int(HEIGHT / _PITCH) + 9, int(WIDTH / _PITCH) + 9, 2)
    nodes = ImageField(low, pitch, np.zeros(shape)).nodes
    field = ImageField.interpolate(low, pitch, warp(nodes))
    return table, replace(bare, image_field=field), size


def trial(number: int) -> Outcome:
    """Calibrate and diagnose one set; every other one has a warp."""
    table, truth, size = draw_warped_set(number)
    given = calibrate(table, 'kannala_brandt', (WIDTH, HEIGHT)).adjusted.lens
    written = diagnose(table, given, free_intrinsics=True).lens
    lenses = given, replace(written, image_field=None), written
    first, second, third = (ray_error(lens, truth, table.uv) for lens in lenses)
    return Outcome(size, written.image_field is not None, (first, second, third))


def report(outcomes: Sequence[Outcome], command: str) -> str:
    """Return the page: geometric means of the ray error over that without the field."""
    kinds = {
        'warp of .05 to .14 px': [one for one in outcomes if 0 < one.size <= 0.14],
        'warp of .14 to .4 px': [one for one in outcomes if one.size > 0.14],
        'all warps': [one for one in outcomes if one.size],
        'warps, field written': [one for one in outcomes if one.size and one.written],
        'no warp': [one for one in outcomes if not one.size]}
    lines = ['# The image field', '', *(__doc__ or '').split('\n')[2:7], '', f'`{command}`', '',
             'Geometric means of the ray error: without the field over that of `calibrate`,',
             'with the field over that without it; the worst of the latter.', '',
             '| sets | number | field written | without / calibrate | with / without | worst |',
             '|---|---|---|---|---|---|']
    for name, some in kinds.items():
        if some:
            given, without, with_field = np.log([one.errors for one in some]).T
            cells = [np.exp((without - given).mean()), np.exp((with_field - without).mean()),
                     np.exp((with_field - without).max())]
            lines.append(f'| {name} | {len(some)} | {sum(one.written for one in some)} | '
                         + ' | '.join(f'{one:.3f}' for one in cells) + ' |')
    return '\n'.join(lines) + '\n'


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw, diagnose and compare sets."""
    parser = argparse.ArgumentParser(prog='python -m benchmark.image_field')
    parser.add_argument('--sets', type=int, default=30, help='with a warp, and as many without')
    parser.add_argument('--workers', type=int, default=os.cpu_count(), help='processes')
    parser.add_argument('-o', '--output', type=Path, default=Path('docs'), help='directory')
    asked = parser.parse_args(arguments)
    outcomes = in_processes('image field', trial, range(2 * asked.sets), asked.workers)
    page = report(outcomes, f'python -m benchmark.image_field --sets {asked.sets}')
    write_text(asked.output / 'results' / 'image_field.md', page)
    sys.stdout.write(page)


if __name__ == '__main__':
    main()
