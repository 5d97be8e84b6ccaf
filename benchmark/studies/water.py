"""Blind trials of the medium: `python -m benchmark.studies.water --trials 120 --workers 2`.

Cameras calibrated in air (another noise than that of the photographs, so that their lens is a
little off) photograph a board through a tilted port into a hidden medium, or do not: decoys look
through a plate with air on both sides, have another focal length or another curve.  Lens and
table alone are handed to `diagnose`; with --air the lens is what `calibrate` makes of photographs
in air.  Rays are traced by bisection, as nowhere in the package.  Writes
docs/results/water/trials.json.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial

import numpy as np

from benchmark import study
from benchmark.studies.boards import Seen, angle_behind_window, as_table, directions, grid
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.diagnosis import diagnose
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.optics.curves import IMAGE_HEIGHTS, KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.solve.lens_calibration import calibrate
from fisheye_svp_ros.solve.robust_calibration import calibrate_without_outliers
from fisheye_svp_ros.study.trust import assess_lens, with_covariance

KINDS = ('water', 'water', 'water', 'plate', 'focal', 'curve', 'air')


@dataclass(frozen=True)
class Outcome:
    """What came of a trial: what was hidden, and what was named."""

    number: int
    kind: str
    free: bool
    index: float
    distance: float
    tilt: float
    thickness: float
    noise: float
    rough: bool
    air: bool
    causes: list[str]
    found: dict[str, list[float]]
    rms_px: float
    heldout_rms_px: float


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the trials, write them, print what came of them."""
    asked = study.parser(
        'water',
        __doc__,
        study.RESULTS / 'water' / 'trials.json',
        trials=(120, 'of all kinds'),
        rough=(False, 'with errors of board and frames'),
        air=(False, 'lenses calibrated in air'),
    ).parse_args(arguments)
    run = partial(run_trial, rough=asked.rough, air=asked.air)
    outcomes = study.in_processes('trials', run, range(asked.trials), asked.workers)
    command = (
        f'python -m benchmark.studies.water --trials {asked.trials}'
        + ' --rough' * asked.rough
        + ' --air' * asked.air
    )
    write_text(asked.output, study.json_lines(map(asdict, outcomes), command))
    sys.stdout.write(summary(outcomes))


def summary(outcomes: Sequence[Outcome]) -> str:
    """Return what came of the trials, in lines."""
    lines = []
    for kind in dict.fromkeys(KINDS):
        mine = [one for one in outcomes if one.kind == kind]
        named = [one for one in mine if 'medium_index' in one.found]
        lines.append(f'{kind}: {len(mine)} trials, a medium named in {len(named)}')
        if kind == 'water' and named:
            lines += _accuracy(named)
    return '\n'.join(lines) + '\n'


def _accuracy(named: Sequence[Outcome]) -> list[str]:
    found = np.array([one.found['medium_index'] for one in named])
    index = np.array([one.index for one in named])
    off, told = found[:, 0] / index - 1, found[:, 1] > 0
    pull = (found[told, 0] - index[told]) / found[told, 1]
    away = [1e3 * abs(one.found['distance'][0] - one.distance) for one in named]
    other = sum(bool(set(one.causes) - {'flat_port'}) for one in named)
    return [
        f'  index within 1 %: {np.mean(np.abs(off) < 0.01):.3f}, median error '
        f'{100 * np.median(np.abs(off)):.3f} %, worst {100 * np.abs(off).max():.2f} %; '
        f'error over standard error, rms: {np.sqrt(np.mean(pull**2)):.2f}',
        f'  distance: median error {np.median(away):.2f} mm; other causes beside it: {other}',
    ]


def run_trial(number: int, rough: bool = False, air: bool = False) -> Outcome:
    """Run one trial; the same number always gives the same data.

    rough: with errors of board and frames; air: the lens from photographs in air.
    """
    rng = np.random.default_rng([17, number])
    kind = KINDS[number % len(KINDS)]
    free = bool(number // len(KINDS) % 2)
    lens, noise = _lens(rng), float(rng.choice([0.05, 0.1, 0.2, 0.4]))
    index = float(rng.uniform(1.32, 1.36)) if kind == 'water' else 1.0
    distance, thickness = rng.uniform(0.003, 0.09), rng.uniform(0.0, 0.012)
    tilt = rng.normal(scale=0.03, size=2)
    true = lens
    if kind == 'focal':
        true = replace(lens, fx=1.33 * lens.fx, fy=1.33 * lens.fy)
    elif kind == 'curve':
        true = replace(
            lens,
            image_height=IMAGE_HEIGHTS['stereographic'](),
            fx=1.15 * lens.fx,
            fy=1.15 * lens.fy,
        )
    refracted = kind in ('water', 'plate')

    def see(points: Array) -> Array:
        if refracted:
            return _through(true, points, distance, tilt, thickness, index)
        return _central(true, points)

    seen = _photographs(true, see, noise, rough, rng)
    given = _calibrated(lens, rng, free, rough)
    if air:
        table = _photographs(lens, lambda points: _central(lens, points), noise, rough, rng)
        given = _calibrated_in_air(table, (lens.width, lens.height))
    found = diagnose(seen, given, free_intrinsics=free)
    port = next((c for c in found.causes if c.form == 'flat_port(medium)'), None)
    values = (
        {}
        if port is None
        else {name: [entry['value'], entry['stderr']] for name, entry in port.parameters.items()}
    )
    return Outcome(
        number,
        kind,
        free,
        index,
        float(distance),
        float(np.hypot(*tilt)),
        float(thickness),
        noise,
        rough,
        air,
        [c.effect for c in found.causes],
        values,
        found.figures.named.rms_px,
        found.figures.named.heldout_rms_px,
    )


def _lens(rng: np.random.Generator) -> Lens:
    """Return a fisheye lens: half a field of 60 to 85 degrees on 1280 x 960 px."""
    half = np.radians(rng.uniform(60, 85))
    curve = KannalaBrandt(rng.normal(scale=0.02), rng.normal(scale=0.004), rng.normal(scale=0.001))
    f = 800 / float(curve.value_and_slope(np.array(half))[0])
    return Lens(
        'lens',
        1280,
        960,
        f,
        f * (1 + rng.normal(scale=1e-3)),
        640 + rng.normal(scale=8),
        480 + rng.normal(scale=8),
        curve,
        half,
    )


def _calibrated(lens: Lens, rng: np.random.Generator, free: bool, rough: bool) -> Lens:
    """Return the lens as a calibration in air might have found it."""
    worse = 5.0 if rough else 1.0
    off = 1 + worse * rng.normal(scale=2e-4)
    block = {'rms_px': 0.2} if free else None
    return replace(
        lens,
        fx=lens.fx * off,
        fy=lens.fy * off,
        calibration=block,
        cx=lens.cx + worse * rng.normal(scale=0.1),
        cy=lens.cy + worse * rng.normal(scale=0.1),
    )


def _calibrated_in_air(table: Observations, size: tuple[int, int]) -> Lens:
    """Return the lens file that `calibrate` writes of photographs in air."""
    result, kept, _ = calibrate_without_outliers(
        table, lambda rows: calibrate(rows, 'kannala_brandt', size)
    )
    found = result.adjusted
    return with_covariance(found.lens, assess_lens(kept, found.lens, found.names))


def _central(lens: Lens, points: Array) -> Array:
    """Image points (N, 2), px, of points (N, 3), m, through a lens in air."""
    r = np.linalg.norm(points[:, :2], axis=-1)
    theta = np.arctan2(r, points[:, 2])
    height = lens.image_height.value_and_slope(theta)[0] / np.maximum(r, 1e-12)
    uv = np.array([lens.cx, lens.cy]) + height[:, None] * points[:, :2] * [lens.fx, lens.fy]
    return np.where((theta < lens.max_incidence)[:, None], uv, np.nan)


def _through(
    lens: Lens, points: Array, distance: float, tilt: Array, thickness: float, index: float
) -> Array:
    """The same through a pane whose normal is tilted: bisection in the plane of each ray."""
    normal = np.array([np.tan(tilt[1]), -np.tan(tilt[0]), 1.0])
    normal /= np.linalg.norm(normal)
    z = points @ normal
    across = points - z[:, None] * normal
    r = np.linalg.norm(across, axis=-1)
    angle = angle_behind_window(r, z, thickness, 1.5, distance, index)
    way = across / np.maximum(r, 1e-12)[:, None]
    ray = np.cos(angle)[:, None] * normal + np.sin(angle)[:, None] * way
    return np.where((z > distance + thickness)[:, None], _central(lens, ray), np.nan)


def _photographs(
    lens: Lens,
    see: Callable[[Array], Array],
    noise: float,
    rough: bool,
    rng: np.random.Generator,
) -> Observations:
    """Return 10 to 24 photographs of a board, 70 % of it in the image at least.

    rough: the board is bent and its points are off, each photograph has a smooth error of its own,
    one point in a hundred is far off.
    """
    size = rng.uniform(0.03, 0.06)
    board = grid(11, 8, size)
    shape = board
    if rough:
        bend = 2e-3 * (board[:, 0] / (5 * size)) ** 2
        shape = board + 1e-4 * rng.normal(size=board.shape) + bend[:, None] * [0.0, 0.0, 1.0]
    frames: list[Seen] = []
    count = int(rng.integers(10, 25))
    while len(frames) < count:
        angle, azimuth = np.radians(rng.uniform(0, 45)), rng.uniform(0, 2 * np.pi)
        away = size * 11 * np.exp(rng.uniform(np.log(0.8), np.log(4.0)))
        turn = rotation_from_vector(rng.normal(size=3) * [0.4, 0.4, 1.0])
        place = Pose(turn, away * directions(angle, azimuth))
        uv = see(place.transform(shape)) + noise * rng.normal(size=(len(board), 2))
        if rough:
            wave, phase = rng.uniform(-0.01, 0.01, (2, 2)), rng.uniform(0, 2 * np.pi, 2)
            uv = uv + 0.15 * np.cos(np.nan_to_num(uv) @ wave + phase)
            far = rng.uniform(size=len(uv)) < 0.01
            uv[far] += rng.normal(scale=20.0, size=(int(far.sum()), 2))
        inside = ((uv > 0) & (uv < [lens.width, lens.height])).all(axis=-1)
        if inside.mean() > 0.7:
            frames.append((np.flatnonzero(inside), uv[inside]))
    return as_table(frames, board)


if __name__ == '__main__':
    main()
