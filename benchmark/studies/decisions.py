"""What the diagnosis decides about lenses whose truth is known: `make study NAME=decisions`.

A camera of the independent simulator is calibrated on one set and diagnosed on another, with a
board whose landmarks are a little off.  Its lens is sound, or off by three of its stated errors in
one intrinsic, or has a viewpoint shift that the calibration did not know of.

Writes docs/results/decisions.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import norm, spearmanr

import fisheye_svp_ros as fsvp
from benchmark import study
from benchmark.studies.boards import directions
from benchmark.studies.independent.camera import Array, draw_lens, image_points
from benchmark.studies.independent.camera import Lens as TrueLens
from benchmark.studies.independent.formation import Departure, observed
from benchmark.studies.independent.scene import Scene, draw_scene
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.optics.curves import Gennery, KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.scene.observations import Observations, make_observations
from fisheye_svp_ros.solve.ray_errors import typical_points

KINDS = ('sound', 'off', 'shift')
OFF = 3.0  # standard errors
OFFSET = 3e-5  # m: of the landmarks of a printed board
SHIFT = 4e-3  # m
RANGES = (0.3, 1.0, 5.0)
SAYS = ('keep', 'use_extended', 'recalibrate', 'undecided')


@dataclass(frozen=True)
class Outcome:
    """What was decided about a lens, and what is true of it.

    decision, target: the answers; bound: of the viewpoint shift, m, NaN where none is stated;
    shift: the true one; gain: the `file` figure; true_gain: 1 - ray error of the extended lens
    over that of the given one, by the truth; same_data: the same over that of a lens which
    `calibrate` makes of the data that are diagnosed; moved: the intrinsic that was put off;
    least, off: by how much the lens is said to be off at least, and the true ray error, at 1 m,
    mrad; NaN where it is not said.
    """

    kind: str
    decision: str
    target: str
    causes: tuple[str, ...]
    bound: float
    shift: float
    gain: float
    true_gain: float
    same_data: float
    moved: str = ''
    least: float = np.nan
    off: float = np.nan

    @property
    def given_over_same(self) -> float:
        """Ray error of the lens as given over that of `calibrate` on the diagnosed data."""
        return (1 - self.same_data) / (1 - self.true_gain)

    @property
    def offered(self) -> bool:
        """Whether the extended lens is to take the place of the given one."""
        return self.decision in ('use_extended', 'recalibrate')


def run(task: tuple[str, int]) -> Outcome:
    """Run one trial: kind and number; the same gives the same data."""
    kind, number = task
    rng = np.random.default_rng([KINDS.index(kind), number])
    shift = rng.choice([-1, 1]) * abs(rng.normal(0, SHIFT)) if kind == 'shift' else 0.0
    lens, noise = draw_lens(rng, 'kannala_brandt', 1.6), float(np.exp(rng.uniform(-3.0, -1.2)))
    tables = [_photograph(rng, lens, shift, noise) for _ in range(2)]
    given, same = (
        fsvp.calibrate(one, 'kannala_brandt', (lens.width, lens.height)).lens for one in tables
    )
    moved = ''
    if kind == 'off':
        given, moved = _move(given, rng)
    found = fsvp.diagnose(tables[1], given)
    document = found.document
    answer = document['decision']['lens']
    bounds = {one['effect']: one['value'] for one in answer.get('bound', [])}
    before, now, after = (
        _ray_error(one, lens, shift, tables[1]) for one in (given, same, found.lens)
    )
    least = off = np.nan
    if answer['figure']['name'] == 'ray_error':
        least, uv = answer['figure']['value'], typical_points(tables[1].uv)
        off = study.ray_errors(given, _truth(lens, shift), uv)[RANGES.index(1.0)]
    return Outcome(
        kind,
        answer['say'],
        document['decision']['target']['say'],
        tuple(cause['effect'] for cause in document['causes']),
        bounds.get('viewpoint_shift', np.nan),
        shift,
        document['file']['gain'],
        1 - after / before,
        1 - after / now,
        moved,
        least,
        off,
    )


def _truth(lens: TrueLens, shift: float) -> Lens:
    """Return the true lens as one of the package's."""
    size, middle = (lens.width, lens.height), (lens.cx, lens.cy)
    curve = KannalaBrandt(*lens.k)
    bare = Lens('truth', *size, lens.fx, lens.fy, *middle, curve, lens.theta_max)
    return bare.with_shift(Gennery(0.0, shift))


def _photograph(
    rng: np.random.Generator, lens: TrueLens, shift: float, noise: float
) -> Observations:
    """Return what the camera sees of a printed board."""
    scene: Scene | None = None
    while scene is None:
        scene = draw_scene(
            rng, lens, 'board', fitted=True, stereo=False, moving=False, noise=noise
        )
    offsets = Departure(landmarks=OFFSET * rng.normal(size=scene.target.points.shape))
    pupil = Departure(pupil=lambda theta, _: shift * _gennery(theta)[:, None] * [0.0, 0.0, 1.0])
    uv, named = observed(rng, scene, [offsets, pupil], 0.0)
    return make_observations(named.frame, named.landmark, uv, scene.target.points[named.landmark])


def _gennery(theta: Array) -> Array:
    safe = np.maximum(theta, 1e-6)
    return np.asarray(safe / np.sin(safe) - 1)


def _move(lens: Lens, rng: np.random.Generator) -> tuple[Lens, str]:
    """Return a lens with one intrinsic off by some of its stated standard errors, and which."""
    stated = (lens.calibration or {})['stderr']
    names: Sequence[str] = [('fx', 'fy'), ('cx',), ('cy',)][rng.integers(3)]
    sign = rng.choice([-1, 1])
    return replace(
        lens.with_parameters(
            names, [lens.parameters[name] + sign * OFF * stated[name] for name in names]
        ),
        calibration=lens.calibration,
    ), 'focal length' if len(names) > 1 else 'principal point'


def _ray_error(lens: Lens, true: TrueLens, shift: float, table: Observations) -> float:
    """Return the rms angle, rad, over ranges between true rays and those of a lens.

    Over the field that was seen; a motion of the whole camera is taken out.
    """
    center = np.array([true.cx, true.cy])
    seen = np.quantile(np.linalg.norm(table.uv - center, axis=1), 0.98)
    theta, azimuth = (
        one.ravel()
        for one in np.meshgrid(
            np.linspace(0.02, true.theta_max, 25), np.linspace(0, 2 * np.pi, 16, endpoint=False)
        )
    )
    uv = image_points(true, theta, azimuth)
    inside = (np.linalg.norm(uv - center, axis=1) < seen) & (uv > 0).all(axis=1)
    inside &= (uv < [true.width, true.height]).all(axis=1)
    theta, azimuth, uv = theta[inside], azimuth[inside], uv[inside]
    origin = shift * _gennery(theta)[:, None] * [0.0, 0.0, 1.0]
    points = np.concatenate([origin + far * directions(theta, azimuth) for far in RANGES])

    def off(motion: Array) -> Array:
        moved = Rotation.from_rotvec(motion[:3]).apply(points) + motion[3:]
        image = fsvp.project(lens, moved).uv
        return np.nan_to_num((image - np.tile(uv, (len(RANGES), 1))) / true.fx).ravel()

    left = least_squares(off, np.zeros(6)).fun
    return float(np.sqrt(2 * np.mean(left**2)))


def _share(hits: Sequence[bool]) -> str:
    """Return a share with its 95 % interval, in percent."""
    found = study.Rate.of(hits)
    low, high = found.interval
    return (
        (f'{100 * found.value:.0f} % ({100 * low:.0f} to {100 * high:.0f}, n = {found.trials})')
        if hits
        else 'none'
    )


def report(outcomes: Sequence[Outcome], command: str) -> str:
    """Return the page of results."""
    of = {kind: [one for one in outcomes if one.kind == kind] for kind in KINDS}
    wanted = {
        'sound': {'keep'},
        'off': {'recalibrate'},
        'shift': {'use_extended', 'recalibrate', 'undecided'},
    }
    rows = [
        [
            kind,
            ', '.join(sorted(wanted[kind])),
            _share([one.decision in wanted[kind] for one in found]),
            *(sum(one.decision == say for one in found) for say in SAYS),
        ]
        for kind, found in of.items()
    ]
    lines = []
    bounded = [one for one in outcomes if np.isfinite(one.bound)]
    covered = [one.bound >= abs(one.shift) for one in bounded]
    finite = [one for one in outcomes if np.isfinite(one.true_gain)]
    rank = spearmanr([one.gain for one in finite], [one.true_gain for one in finite])
    most = norm.sf(norm.isf(0.025) - OFF / 2**0.5)
    for what in sorted({one.moved for one in of['off']}):
        mine = [one for one in of['off'] if one.moved == what]
        lines.append(
            f'- Off in the {what}: recalibrate in '
            f'{_share([one.decision == "recalibrate" for one in mine])}; the rays of such a lens '
            f'err {np.median([one.given_over_same for one in mine]):.2f} times as much as those '
            'of a calibration on the same data, median.'
        )
    twice = [one for one in outcomes if one.given_over_same >= 2]
    others = [one for one in outcomes if one.given_over_same < 2]
    told = [one for one in outcomes if np.isfinite(one.least)]
    lines += [
        '- Offered or to be calibrated again, where a calibration on the same data is at least '
        f'twice as good: {_share([one.offered for one in twice])}; recalibrate where it is not: '
        f'{_share([one.decision == "recalibrate" for one in others])}.',
        '- "Off by at least" exceeds the true ray error at 1 m in '
        f'{_share([one.least > one.off for one in told])}.',
        f'- A test of the one parameter that is off, on data as good as those of the '
        f'calibration, would find {100 * most:.0f} % at a level of 5 %.',
        f'- The bound of the viewpoint shift covers the truth in {_share(covered)}.',
        f'- Rank correlation of `file` with the true gain of rays: {rank.statistic:.2f}.',
        '- Extended lenses more than 10 % worse than those given, where they are offered: '
        f'{_share([one.true_gain < -0.1 for one in finite if one.offered])}; than those '
        'that `calibrate` makes of the same data, all: '
        f'{_share([one.same_data < -0.1 for one in finite])}.',
        '- Ray error of the extended lens over that of `calibrate` on the same data, '
        f'geometric mean: {np.exp(np.mean(np.log1p([-o.same_data for o in finite]))):.2f}.',
    ]
    return study.page(
        'Decisions about lenses whose truth is known',
        __doc__,
        command,
        study.table('lens | expected | as expected | ' + ' | '.join(SAYS), rows),
        lines,
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the trials and write the page."""
    asked = study.parser(
        'decisions', __doc__, study.RESULTS / 'decisions.md', trials=(60, 'of each kind')
    ).parse_args(arguments)
    tasks = [(kind, i) for i in range(asked.trials) for kind in KINDS]
    outcomes = study.in_processes('decisions', run, tasks, asked.workers)
    write_text(
        asked.output,
        report(outcomes, f'python -m benchmark.studies.decisions --trials {asked.trials}'),
    )


if __name__ == '__main__':
    main()
