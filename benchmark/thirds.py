"""Do thirds of the frames agree?  `python -m benchmark.thirds TRAIN.csv... --image-size WxH`.

The frames of a set are dealt at random to three parts, several times over. Each part is
calibrated and diagnosed by itself: once with `viewpoint_shift` taken in and all else its own
choice, once with the causes of the whole set. For each intrinsic and e0: chi^2 of the three
estimates about their weighted mean, under their stated errors, over its 2 degrees of freedom; the
mean over all deals is 1 where the stated errors are all that there is.

Writes docs/results/thirds.md.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmark.workers import in_processes
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.diagnosis import Diagnosis, DiagnosisOptions, can_be_included, diagnose
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.io.readers import read_observations
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.solve.lens_calibration import calibrate

SHIFT = 'viewpoint_shift'
NAMES = ('fx', 'fy', 'cx', 'cy', 'k1', 'k2', 'k3', 'k4', 'e0')


class Part(NamedTuple):
    """A part of a set: its file, size of the images, deal, place in it, and causes taken in."""

    path: Path
    size: tuple[int, int]
    deal: int
    third: int
    causes: tuple[str, ...]


def diagnosed(table: Observations, size: tuple[int, int], causes: tuple[str, ...]) -> Diagnosis:
    """Calibrate and diagnose a table, some causes taken in without a test."""
    lens = calibrate(table, 'kannala_brandt', size).adjusted.lens
    return diagnose(table, lens, options=DiagnosisOptions(included=causes))


def named(path: Path, size: tuple[int, int]) -> tuple[str, ...]:
    """Return the causes of a whole set that can be taken in without a test."""
    found = diagnosed(read_observations(path), size, (SHIFT,)).causes
    return tuple(cause.effect for cause in found if can_be_included(cause.effect))


def estimates(part: Part) -> Array:
    """Return the estimates (9, 2) of one part and their standard errors; NaN where it has none."""
    table = read_observations(part.path)
    frames = np.random.default_rng(part.deal).permutation(table.frames)
    mine = np.isin(table.frame, frames[part.third :: 3])
    found = diagnosed(table.take(mine), part.size, part.causes)
    known = {name: (one.after, one.after_stderr) for name, one in found.intrinsics.items()}
    shift = next(c for c in found.causes if c.effect == SHIFT).parameters['e0']
    known['e0'] = shift['value'], shift['stderr']
    return np.array([known[name] for name in NAMES])


def agreement(parts: Array) -> Array:
    """Return chi^2 (..., 9) over degrees of freedom of estimates (..., 3, 9, 2)."""
    value, weight = parts[..., 0], parts[..., 1] ** -2.0
    mean = (value * weight).sum(axis=-2, keepdims=True) / weight.sum(axis=-2, keepdims=True)
    return np.asarray(((value - mean) ** 2 * weight).sum(axis=-2) / (parts.shape[-3] - 1))


def report(rows: dict[str, Array], deals: int, command: str) -> str:
    """Return the page; rows: chi^2 (deals, 9) by set and causes."""
    lines = ['# Do thirds of the frames agree?', '', (__doc__ or '').split('\n\n')[1], '',
             f'    {command}', '', f'Means over {deals} deals; - where a part always leaves the '
             'number open.', '', f'| set | causes | {" | ".join(NAMES)} |',
             '|---' * (len(NAMES) + 2) + '|']
    for label, values in rows.items():
        there = np.isfinite(values)
        means = np.where(there, values, 0.0).sum(axis=0) / np.maximum(there.sum(axis=0), 1)
        cells = [f'{mean:.1f}' if some else '-'
                 for mean, some in zip(means, there.any(axis=0), strict=True)]
        lines.append(f'| {label} | {" | ".join(cells)} |')
    return '\n'.join(lines) + '\n'


def main(arguments: Sequence[str] | None = None) -> None:
    """Diagnose the parts and write how they agree."""
    parser = argparse.ArgumentParser(prog='python -m benchmark.thirds')
    parser.add_argument('sets', type=Path, nargs='+', metavar='TRAIN.csv')
    parser.add_argument('--image-size', required=True, metavar='WxH')
    parser.add_argument('--deals', type=int, default=5)
    parser.add_argument('--workers', type=int, default=os.cpu_count(), help='processes')
    parser.add_argument('-o', '--output', type=Path, default=Path('docs/results'),
                        help='directory')
    asked = parser.parse_args(arguments)
    width, height = (int(side) for side in asked.image_size.split('x'))
    todo, labels = [], []
    for path in asked.sets:
        whole = named(path, (width, height))
        for label, causes in (('its own', (SHIFT,)), ('of the whole set', whole)):
            labels.append(f'{path.parent.name} | {label}')
            todo += [Part(path, (width, height), deal, third, causes)
                     for deal in range(asked.deals) for third in range(3)]
    found = np.array(in_processes('thirds', estimates, todo, asked.workers))
    values = agreement(found.reshape(len(labels), asked.deals, 3, len(NAMES), 2))
    sets = ' '.join(f'{path.parent.name}/{path.name}' for path in asked.sets)
    command = (f'python -m benchmark.thirds {sets} --image-size {asked.image_size} '
               f'--deals {asked.deals}')
    page = report(dict(zip(labels, values, strict=True)), asked.deals, command)
    write_text(asked.output / 'thirds.md', page)
    sys.stdout.write(page)


if __name__ == '__main__':
    main()
