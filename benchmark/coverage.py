"""Do 95 % intervals cover?  `python -m benchmark.coverage DATA.csv... --image-size 1280x800`.

A lens is calibrated and diagnosed on half of the frames.  In each frame of the other half the
camera is posed twice, from the left and from the right half of the points: the difference should
lie within its interval in 95 of 100 cases, by noise alone, with the lens's parameters, and with
the misfit that remains (`diagnosis.uncertainty`).  Without a table: simulated cameras with a bent
board, displaced landmarks and an image field that no catalogue holds.  Writes docs/coverage.json.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.diagnosis.diagnosis import Diagnosis, diagnose
from fisheye_svp_ros.diagnosis.model import (
    Data,
    Linearised,
    State,
    fit_poses,
    prepare,
    start_poses,
)
from fisheye_svp_ros.diagnosis.uncertainty import pose_maps
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.io.readers import read_observations
from fisheye_svp_ros.optics.curves import KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.reporting.progress import progress
from fisheye_svp_ros.scene.landmarks import Landmarks
from fisheye_svp_ros.scene.observations import Observations, make_observations
from fisheye_svp_ros.simulate.board_views import board_views
from fisheye_svp_ros.simulate.render import Print
from fisheye_svp_ros.simulate.simulation import simulate
from fisheye_svp_ros.solve.lens_calibration import calibrate

WITHIN = 1.959964  # standard deviations, 95 %
LEVELS = ('noise', 'noise and parameters', 'with the misfit')


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the study, write it, print what came of it."""
    parser = argparse.ArgumentParser(description=__doc__, prog='python -m benchmark.coverage')
    parser.add_argument('tables', type=Path, nargs='*', help='of one camera and board')
    parser.add_argument('--image-size', default='1280x800')
    parser.add_argument('--cameras', type=int, default=20, help='simulated ones')
    parser.add_argument('-o', '--output', type=Path, default=Path('docs/coverage.json'))
    asked = parser.parse_args(arguments)
    width, height = map(int, asked.image_size.split('x'))
    sets = [(joined([read_observations(path) for path in asked.tables]), (width, height))
            ] if asked.tables else [simulated(number) for number in range(asked.cameras)]
    pulls: list[Array] = []
    with progress('halves', 2 * len(sets)) as advance:
        for table, size in sets:
            frames = table.frames
            for half in (0, 1):
                mine = np.isin(table.frame, frames[half::2])
                pulls.append(pulls_of(table.take(mine), table.take(~mine), size))
                advance()
    every = np.concatenate(pulls)
    found: dict[str, Any] = {
        'differences': int(every.shape[0] * every.shape[2]),
        'coverage': {level: float((np.abs(every[:, i]) < WITHIN).mean())
                     for i, level in enumerate(LEVELS)},
        'pull_rms': {level: float(np.sqrt((every[:, i] ** 2).mean()))
                     for i, level in enumerate(LEVELS)},
    }
    name = asked.tables[0].parent.name if asked.tables else 'simulated'
    saved = json.loads(asked.output.read_text()) if asked.output.is_file() else {}
    write_text(asked.output, json.dumps(saved | {name: found}, indent=1) + '\n')
    sys.stdout.write(json.dumps(found, indent=1) + '\n')


def pulls_of(train: Observations, test: Observations, size: tuple[int, int]) -> Array:
    """Return differences over their standard deviations (F, levels, 6)."""
    lens = calibrate(train, 'kannala_brandt', size).adjusted.lens
    found = diagnose(train, lens)
    data = prepare(test)
    state = start_poses(data, found.after.state)
    middle = np.array([np.median(v[w > 0]) for v, w in zip(
        data.views.uv[..., 0], data.views.weight, strict=True)])
    left = data.views.uv[..., 0] < middle[:, None]
    sides = [side(data, state, mask) for mask in (left, ~left)]
    difference = sides[0][0].pose.difference(sides[1][0].pose)
    return np.moveaxis(_over(found, data, state, sides[0][1] - sides[1][1], difference), 0, 1)


def side(data: Data, state: State, mask: Mask) -> tuple[State, Array]:
    """Pose the frames from some of their points; return also what makes poses of points."""
    kept = replace(data, views=data.views._replace(
        weight=np.where(mask, data.views.weight, 0.0)))
    posed = fit_poses(kept, state)
    return posed, pose_maps(Linearised(kept, posed, ()).frame_columns)


def _over(
    found: Diagnosis, data: Data, state: State, maps: Array, difference: Array
) -> Array:
    linear = Linearised(data, state, found.after.free)
    parts = found.errors.through(linear, maps)
    levels = (parts.noise, parts.noise + parts.parameters, parts.total)
    return np.stack([
        difference / np.sqrt(np.diagonal(part, axis1=1, axis2=2)) for part in levels])


def joined(tables: Sequence[Observations]) -> Observations:
    """Return tables of one camera and board as one."""
    frame = [1000 * i + table.frame for i, table in enumerate(tables)]
    return make_observations(
        np.concatenate(frame), *(np.concatenate([getattr(t, name) for t in tables])
                                 for name in ('landmark', 'uv', 'xyz')),
        board=np.concatenate([t.board for t in tables]))


def simulated(number: int) -> tuple[Observations, tuple[int, int]]:
    """Return photographs of a board with errors of its own, through a lens with a field."""
    rng = np.random.default_rng([5, number])
    lens = Lens('lens', 1280, 960, 420.0, 420.0, 640.0, 480.0, KannalaBrandt(-0.01, 0.002), 1.5)
    printed = Print(11, 8, 0.03)
    poses = board_views(lens, printed, 30, (0.2, 0.7), rng)
    points = printed.corners + rng.normal(size=printed.corners.shape) * [4e-5, 4e-5, 2e-4]
    seen = simulate(ForwardModel(lens), Landmarks(np.arange(len(points)), points), poses, 0.1, rng)
    waves = rng.uniform(-1, 1, (6, 2)) / 60.0
    phase, size = rng.uniform(0, 2 * np.pi, 6), 0.06 * rng.normal(size=(6, 2))
    field = np.cos(seen.uv @ waves.T + phase) @ size
    return replace(seen, uv=seen.uv + field, xyz=printed.corners[seen.landmark],
                   sigma=np.full(len(seen), np.nan)), (1280, 960)


if __name__ == '__main__':
    main()
