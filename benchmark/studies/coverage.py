"""Do 95 % intervals cover?  `python -m benchmark.studies.coverage`.

A lens is calibrated and diagnosed on half of the frames, every other one, or dealt at random
several times (`--deals`).  In each frame of the other half the camera is posed from the left and
from the right half of the points, and from the upper and the lower one: the differences should lie
within their intervals in 95 of 100 cases, by noise alone, with the lens's parameters, and with the
misfit that remains (`diagnosis.uncertainty`).  Without a table: simulated cameras with displaced
landmarks and an image field that no catalogue holds, of which the truth is known: poses of the
other half, and points that two of the cameras see as a rig, by what the lens files carry
(`diagnosis.model_errors`); how often each cause was named.  Writes docs/results/coverage.json.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmark import study
from benchmark.studies.boards import draw_waves, joined, photographed
from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.diagnosis import Diagnosis, ErrorParts, LensErrors, pose_maps
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.io.readers import read_observations
from fisheye_svp_ros.optics.curves import KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, identity, rotation_from_vector
from fisheye_svp_ros.reporting.terminal import progress
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.simulate.render import Print
from fisheye_svp_ros.simulate.targets import board_views
from fisheye_svp_ros.solve.bundle_adjustment import adjust_poses
from fisheye_svp_ros.solve.initial_rig import localize_frames
from fisheye_svp_ros.solve.rig_state import Linearization, RigState, RigViews, group_by_frame
from fisheye_svp_ros.solve.stereo_depth import triangulate_optimally
from fisheye_svp_ros.study.trust import depth_errors, localize_with_errors

WITHIN = 1.959964  # standard deviations, 95 %
LEVELS = ('noise', 'noise and parameters', 'with the misfit')
RIG = Pose(rotation_from_vector(np.array([0.02, 0.1, -0.01])), np.array([-0.15, 0.0, 0.01]))
POINTS = 40  # that a rig sees
NOISE = 0.1  # px


class Simulated(NamedTuple):
    """A simulated camera: its photographs, poses (F,) and what it sees of points before it."""

    table: Observations
    size: tuple[int, int]
    poses: Pose | None
    see: Callable[[Array], Array] | None


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the study, write it, print what came of it."""
    parser = study.parser(
        'coverage',
        __doc__,
        study.RESULTS / 'coverage.json',
        workers=False,
        image_size=('1280x800', 'of the tables'),
        name=('', 'of the data in the output'),
        deals=(0, 'random ones, to halves'),
        cameras=(20, 'simulated ones'),
    )
    parser.add_argument('tables', type=Path, nargs='*', help='of one camera and board')
    asked = parser.parse_args(arguments)
    sets = (
        [simulated(number) for number in range(asked.cameras)]
        if not asked.tables
        else [measured(asked.tables, study.image_size(asked.image_size))]
    )
    halves: list[Array] = []
    poses: list[Array] = []
    lenses: list[Lens] = []
    named: Counter[str] = Counter()
    deals = max(asked.deals, 1)
    with progress('halves', 2 * len(sets) * deals) as advance:
        for one, deal in product(sets, range(deals)):
            frames = one.table.frames
            if asked.deals:
                frames = np.random.default_rng([6, deal]).permutation(frames)
            for half in (0, 1):
                mine = np.isin(one.table.frame, frames[half::2])
                test = one.table.take(~mine)
                _, found = study.calibrated_and_diagnosed(one.table.take(mine), one.size)
                halves.append(pulls_of(found, test))
                named.update(cause.effect for cause in found.causes)
                if one.poses is not None:
                    poses.append(against_truth(found.lens, test, one.poses))
                if not half:
                    lenses.append(found.lens)
                advance()
    told = coverage(halves) | {'halves': len(halves), 'named': dict(named.most_common())}
    if not asked.tables:
        told |= {
            'poses': coverage(poses),
            'stereo points': coverage(
                of_a_rig(sets[i : i + 2], lenses[i : i + 2]) for i in range(0, len(sets) - 1, 2)
            ),
        }
    name = asked.name or (asked.tables[0].parent.name if asked.tables else 'simulated')
    saved = json.loads(asked.output.read_text()) if asked.output.is_file() else {}
    write_text(asked.output, json.dumps(saved | {name: told}, indent=1) + '\n')
    sys.stdout.write(json.dumps(told, indent=1) + '\n')


def measured(paths: Sequence[Path], size: tuple[int, int]) -> Simulated:
    """Return what a real camera saw of one board, in one table."""
    table = joined(
        [
            replace(one, frame=1000 * i + one.frame)
            for i, one in enumerate(map(read_observations, paths))
        ]
    )
    unknown = np.full(len(table), np.nan)
    return Simulated(replace(table, sigma=unknown, t=unknown), size, None, None)


def coverage(pulls: Iterable[Array]) -> dict[str, Any]:
    """Return how many of pulls (N, levels, P) are within 95 %, and how large they are.

    coverage_interval: of that with the misfit, 95 %, by bootstrap over the first axis.
    """
    every = np.concatenate(list(pulls))
    inside = (np.abs(every[:, -1]) < WITHIN).mean(axis=-1)
    drawn = np.random.default_rng(0).integers(0, len(every), (2000, len(every)))
    low, high = np.quantile(inside[drawn].mean(axis=1), (0.025, 0.975))
    return {
        'differences': int(every.shape[0] * every.shape[2]),
        'coverage_interval': [float(low), float(high)],
        'coverage': {
            level: float((np.abs(every[:, i]) < WITHIN).mean()) for i, level in enumerate(LEVELS)
        },
        'pull_rms': {
            level: float(np.sqrt((every[:, i] ** 2).mean())) for i, level in enumerate(LEVELS)
        },
    }


def against_truth(lens: Lens, test: Observations, poses: Pose) -> Array:
    """Return errors of poses over their standard deviations (F, levels, 6), by a lens file."""
    found, parts = localize_with_errors(LensErrors.from_lens(lens), test)
    return _pulls(found.result.pose.difference(poses.take(found.views.frame)), parts)


def of_a_rig(cameras: Sequence[Simulated], lenses: Sequence[Lens]) -> Array:
    """Return errors of stereo points over their standard deviations (N, levels, 3)."""
    rng = np.random.default_rng(cameras[0].table.uv[0].astype(int))
    points = rng.uniform([-0.6, -0.4, 0.3], [0.6, 0.4, 1.0], (POINTS, 3))
    uv = []
    for camera, pose in zip(cameras, (RIG, identity()), strict=True):
        assert camera.see is not None
        uv.append(camera.see(pose.into_body(points)) + NOISE * rng.normal(size=(POINTS, 2)))
    models = [ForwardModel(lens) for lens in lenses]
    found = triangulate_optimally(models[0], models[1], RIG, uv[0], uv[1]).points
    errors = [LensErrors.from_lens(lens) for lens in lenses]
    parts = depth_errors(errors[0], errors[1], RIG, found)
    known = np.isfinite(found).all(axis=1)
    return _pulls((found - points)[known], ErrorParts(*(part[known] for part in parts)))


def _pulls(difference: Array, parts: ErrorParts) -> Array:
    """Return differences (N, P) over their standard deviations at all levels."""
    levels = (parts.noise, parts.noise + parts.parameters, parts.total)
    return np.stack(
        [difference / np.sqrt(np.diagonal(part, axis1=1, axis2=2)) for part in levels], axis=1
    )


def pulls_of(found: Diagnosis, test: Observations) -> Array:
    """Return differences of poses over their standard deviations (2 F, levels, 6).

    Poses from the left and the right half of the points, and from the upper and the lower one.
    """
    data = group_by_frame(test)
    fit, errors = found.evaluation.fixed_model, found.evaluation.model_errors
    state = localize_frames(data, fit.state)
    linear, pulls = Linearization(data, state, fit.free), []
    for axis in (0, 1):
        middle = np.array(
            [
                np.median(v[w > 0])
                for v, w in zip(data.views.uv[..., axis], data.views.weight, strict=True)
            ]
        )
        first = data.views.uv[..., axis] < middle[:, None]
        sides = [side(data, state, mask) for mask in (first, ~first)]
        difference = sides[0][0].pose.difference(sides[1][0].pose)
        pulls.append(_pulls(difference, errors.propagate(linear, sides[0][1] - sides[1][1])))
    return np.concatenate(pulls)


def side(data: RigViews, state: RigState, mask: Mask) -> tuple[RigState, Array]:
    """Pose the frames from some of their points; return also what makes poses of points."""
    kept = replace(data, views=data.views._replace(weight=np.where(mask, data.views.weight, 0.0)))
    posed = adjust_poses(kept, state)
    return posed, pose_maps(Linearization(kept, posed, ()).frame_columns)


def simulated(number: int) -> Simulated:
    """Return a camera with an image field, and its photographs of a board that errs itself."""
    rng = np.random.default_rng([5, number])
    lens = Lens('lens', 1280, 960, 420.0, 420.0, 640.0, 480.0, KannalaBrandt(-0.01, 0.002), 1.5)
    printed = Print(11, 8, 0.03)
    poses = board_views(lens, printed, 30, (0.2, 0.7), rng)
    points = printed.corners + rng.normal(size=printed.corners.shape) * [4e-5, 4e-5, 2e-4]
    seen = photographed(lens, printed, points, poses, NOISE, rng)
    field = draw_waves(rng, 60.0, 0.06)

    def moved(uv: Array) -> Array:
        return np.asarray(uv + field(uv))

    table = replace(seen, uv=moved(seen.uv))
    return Simulated(
        table, (1280, 960), poses, lambda points: moved(ForwardModel(lens).project(points).uv)
    )


if __name__ == '__main__':
    main()
