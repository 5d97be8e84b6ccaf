"""Names and standard errors on sets like real ones: `python -m benchmark.studies.local_errors`.

A camera photographs one board 15 to 35 times. Its viewpoint moves by 0, 3 or 7 mm (e0), the board
is bent by 0, 0.4 or 1.2 mm. Beside that everything has errors of its own: corners and paper, a
radial ripple and a decentering that the lens's model has no place for, a smooth static image
field, another one in every photograph, outliers, points not found. The lens is calibrated as
Kannala-Brandt and diagnosed; then once more with the shift taken in, so that e0 is estimated
whether it is named or not.

Writes docs/results/local_errors.json and .md.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from benchmark import study
from benchmark.studies.boards import Rng, draw_waves, photographed
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.diagnosis import DiagnosisOptions, diagnose
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.optics.curves import Gennery, KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.reporting.diagnosis_document import diagnosis_document
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.simulate.render import Print
from fisheye_svp_ros.simulate.targets import board_views

SHIFTS, BENDS = (0.0, 3e-3, 7e-3), (0.0, 4e-4, 1.2e-3)  # m
BOARDS = ((9, 6, 0.025, 0.12), (11, 8, 0.03, 0.2), (6, 4, 0.04, 0.2))  # square and nearest, m
SIZE = (1280, 960)


class Taken(NamedTuple):
    """What a camera photographed, and the e0 (m), bend (m) and lens behind it."""

    table: Observations
    shift: float
    bend: float
    lens: Lens


def draw_set(number: int) -> Taken:
    """Return a set of photographs with everything that real ones have."""
    rng = np.random.default_rng([99, number])
    shift, bend = SHIFTS[number % 3], BENDS[number // 3 % 3]
    columns, rows, square, nearest = BOARDS[number // 9 % 3]
    focal = rng.uniform(300.0, 420.0)
    center = np.array(SIZE) / 2 + 10 * rng.normal(size=2)
    curve = KannalaBrandt(*(rng.normal(size=3) * [0.03, 0.004, 0.001] - [0.02, 0.0, 0.0]))
    lens = Lens(
        'true',
        *SIZE,
        focal,
        focal * (1 + 1e-4 * rng.normal()),
        *center,
        curve,
        1.5,
        Gennery(e0=shift),
    )
    printed = Print(columns, rows, square)
    poses = board_views(lens, printed, int(rng.integers(15, 35)), (nearest, 0.7), rng)
    points = bent(printed.corners, bend, rng)
    seen = photographed(lens, printed, points, poses, rng.uniform(0.08, 0.2), rng)
    far = 2 * (rng.random((len(seen), 1)) < 0.004) * rng.normal(size=(len(seen), 2))
    table = replace(seen, uv=seen.uv + own_errors(seen, center, rng) + far)
    return Taken(table.take(rng.random(len(seen)) < rng.uniform(0.9, 1.0)), shift, bend, lens)


def bent(corners: Array, bend: float, rng: Rng) -> Array:
    """Return corners (L, 3) of a board that is bent, stretched and printed unevenly."""
    size = float(np.ptp(corners, axis=0).max()) / 2
    x, y = ((corners - corners.mean(axis=0))[:, :2] / size).T
    shapes = np.stack([x * x, x * y, y * y, x**3 / 2, y**3 / 2, x * x * y / 2], axis=-1)
    weight = rng.normal(size=6)
    points = corners + rng.normal(size=corners.shape) * [2e-5, 2e-5, 5e-5]
    points[:, 2] += bend * shapes @ weight / np.linalg.norm(weight)
    points[:, :2] *= 1 + 2e-4 * rng.normal(size=2)
    return points


def own_errors(seen: Observations, center: Array, rng: Rng) -> Array:
    """Return what lens and frames have of their own (M, 2), px, at the points of a table."""
    reach = float(np.hypot(*SIZE)) / 2
    at = (seen.uv - center) / reach
    x, y = at.T
    radius = np.linalg.norm(at, axis=1, keepdims=True)
    ripple = (
        sum(
            0.08 * rng.normal() / j * np.sin(2 * np.pi * j * radius + rng.uniform(0, 6))
            for j in (1, 2, 3)
        )
        * at
        / np.maximum(radius, 1e-9)
    )
    p = 3e-4 * reach * rng.normal(size=2)
    decentering = np.stack(
        [
            p[0] * (3 * x * x + y * y) + 2 * p[1] * x * y,
            p[1] * (3 * y * y + x * x) + 2 * p[0] * x * y,
        ],
        axis=-1,
    )
    static = draw_waves(rng, 80.0, 0.04)(seen.uv)
    powers = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    framed = 0.03 * rng.normal(size=(int(seen.frame.max()) + 1, 2, 6))[seen.frame]
    return np.asarray(ripple + decentering + static + (framed @ powers[..., None])[..., 0])


def trial(number: int) -> dict[str, Any]:
    """Return what was hidden, what was named, and e0 with its standard error, mm."""
    table, shift, bend, _ = draw_set(number)
    lens, diagnosis = study.calibrated_and_diagnosed(table, SIZE)
    options = DiagnosisOptions(included=('viewpoint_shift',))
    found, asked = map(diagnosis_document, (diagnosis, diagnose(table, lens, options=options)))
    e0 = next(c for c in asked['causes'] if c['effect'] == 'viewpoint_shift')['parameters']['e0']
    return {
        'number': number,
        'e0_mm': 1e3 * shift,
        'bend_mm': 1e3 * bend,
        'points': len(table),
        'verdict': found['verdict'],
        'causes': [c['effect'] for c in found['causes']],
        'found_mm': 1e3 * e0['value'],
        'stderr_mm': 1e3 * e0['stderr'],
        'heldout_rms_px': [found[m]['heldout_rms_px'] for m in ('base', 'named', 'extended')],
    }


def report(trials: Sequence[dict[str, Any]]) -> str:
    """Return the page on what came of it."""
    pulls = np.array([(t['found_mm'] - t['e0_mm']) / t['stderr_mm'] for t in trials])
    within = [np.mean(np.abs(pulls) < limit) for limit in (1.0, 1.96)]
    rows = []
    for shift, bend in product(SHIFTS, BENDS):
        mine = [t for t in trials if (t['e0_mm'], t['bend_mm']) == (1e3 * shift, 1e3 * bend)]
        if mine:
            named = [
                sum(n in t['causes'] for t in mine) for n in ('viewpoint_shift', 'target_shape')
            ]
            rms = np.array([t['heldout_rms_px'] for t in mine])
            ratios = np.median(rms[:, 1:] / rms[:, :1], axis=0)
            rows.append(
                [
                    f'{1e3 * shift:g}',
                    f'{1e3 * bend:g}',
                    len(mine),
                    *named,
                    *(f'{ratio:.2f}' for ratio in ratios),
                ]
            )
    return study.page(
        'Sets like real ones',
        __doc__,
        f'python -m benchmark.studies.local_errors --trials {len(trials)}',
        [
            f'The true e0 lies within one standard error in {within[0]:.1%} and within 1.96 in '
            f'{within[1]:.1%} of {len(pulls)} sets.'
        ],
        study.table(
            'e0, mm | bend, mm | sets | `viewpoint_shift` named | `target_shape` named '
            "| held-out rms over the calibration's, `named` | `extended`",
            rows,
        ),
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the trials and write what came of them."""
    asked = study.parser('local_errors', __doc__, trials=(200, 'sets')).parse_args(arguments)
    trials = study.in_processes('sets', trial, range(asked.trials), asked.workers)
    write_text(asked.output / 'local_errors.json', study.json_lines(trials))
    page = report(trials)
    write_text(asked.output / 'local_errors.md', page)
    sys.stdout.write(page)


if __name__ == '__main__':
    main()
