"""Do thirds of the frames agree?  `python -m benchmark.studies.thirds`.

The frames of a set are dealt at random to three parts, several times over. Each part is
calibrated and diagnosed by itself: once with `viewpoint_shift` taken in and all else its own
choice, once with the causes of the whole set. For each intrinsic and e0: chi^2 of the three
estimates about their weighted mean, under their stated errors, over its 2 degrees of freedom; the
mean over all deals is 1 where the stated errors are all that there is.

Writes docs/results/thirds.md.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmark import study
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.diagnosis import Diagnosis, DiagnosisOptions, can_be_included
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.io.readers import read_observations
from fisheye_svp_ros.scene.observations import Observations

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
    return study.calibrated_and_diagnosed(table, size, options=DiagnosisOptions(included=causes))[
        1
    ]


def estimates(part: Part) -> Array:
    """Return the estimates (9, 2) of one part and their standard errors; NaN where it has none."""
    table = read_observations(part.path)
    frames = np.random.default_rng(part.deal).permutation(table.frames)
    mine = np.isin(table.frame, frames[part.third :: 3])
    found = diagnosed(table.take(mine), part.size, part.causes)
    fitted = found.evaluation.intrinsics
    known = {name: (one.after, one.after_stderr) for name, one in fitted.items()}
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
    cells = [
        [
            label,
            *(
                f'{one[np.isfinite(one)].mean():.1f}' if np.isfinite(one).any() else '-'
                for one in values.T
            ),
        ]
        for label, values in rows.items()
    ]
    return study.page(
        'Do thirds of the frames agree?',
        __doc__,
        command,
        [f'Means over {deals} deals; - where a part always leaves the number open.'],
        study.table(f'set | causes | {" | ".join(NAMES)}', cells),
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Diagnose the parts and write how they agree."""
    parser = study.parser('thirds', __doc__, deals=(5, 'of the frames to three parts'))
    study.add_sets(parser)
    asked = parser.parse_args(arguments)
    todo, labels = [], []
    for path in asked.sets:
        whole = diagnosed(read_observations(path), asked.image_size, (SHIFT,)).causes
        named = tuple(one.effect for one in whole if can_be_included(one.effect))
        for label, causes in (('its own', (SHIFT,)), ('of the whole set', named)):
            labels.append(f'{path.parent.name} | {label}')
            todo += [
                Part(path, asked.image_size, deal, third, causes)
                for deal in range(asked.deals)
                for third in range(3)
            ]
    found = np.array(study.in_processes('thirds', estimates, todo, asked.workers))
    values = agreement(found.reshape(len(labels), asked.deals, 3, len(NAMES), 2))
    sets = ' '.join(f'{path.parent.name}/{path.name}' for path in asked.sets)
    width, height = asked.image_size
    command = (
        f'python -m benchmark.studies.thirds {sets} --image-size {width}x{height} '
        f'--deals {asked.deals}'
    )
    page = report(dict(zip(labels, values, strict=True)), asked.deals, command)
    write_text(asked.output / 'thirds.md', page)
    sys.stdout.write(page)


if __name__ == '__main__':
    main()
