"""Blind tests through images: `python -m benchmark.studies.blind_images --trials 100`.

An effect is hidden in rendered photographs; `detect`, `calibrate` and `diagnose` get nothing but
the pictures and the board's nominal size (of a lens that was bumped after its calibration, that
calibration as well).  Its amount is such that it leaves `size` times the noise of the corners once
a lens without it is fitted.  Appends each trial to docs/results/blind/images.jsonl, leaves out
those that are there, and writes docs/results/blind_images.md of all.
"""

from __future__ import annotations

import json
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from benchmark import study
from benchmark.studies.blind_motion import Swing, of_rows, swing
from benchmark.studies.boards import Rng
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.detect.detection import detect
from fisheye_svp_ros.detect.patterns import parse_pattern
from fisheye_svp_ros.detect.photographs import find_photographs
from fisheye_svp_ros.diagnosis import diagnose
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import FisheyeSvpError
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.optics.curves import Gennery, KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Observations, make_observations
from fisheye_svp_ros.simulate.render import Exposure, Field, Print, render
from fisheye_svp_ros.simulate.targets import board_views
from fisheye_svp_ros.solve.lens_calibration import calibrate
from fisheye_svp_ros.solve.measured_poses import rms_px
from fisheye_svp_ros.solve.table_poses import solve_table

KEPT = study.RESULTS / 'blind' / 'images.jsonl'
BOARD = 'chessboard:9x6:25mm'
NOISE = 0.0053  # px, of a corner's u and v in these photographs
PHOTOGRAPHS = 20
RATE = 10.0  # photographs a second, of a video
LENS = Lens(
    'blind',
    640,
    600,
    214.0,
    214.3,
    320.4,
    298.8,
    KannalaBrandt(-0.01, 0.004, -0.0015),
    np.radians(94.0),
)
PLAIN = Print(9, 6, 0.025)
NOTHING = '-'


class World(NamedTuple):
    """What really happens: the lens, the print, the light, and how image points move besides.

    later: the lens of the second half of the photographs, where it is another; bumped: the lens
    was calibrated before; line_time, s: from row to row, of frames of a video.
    """

    lens: Lens = LENS
    printed: Print = PLAIN
    exposure: Exposure = Exposure()
    moved: Callable[[Array], Array] | None = None  # of image points (..., 2), px
    later: Lens | None = None
    bumped: bool = False
    line_time: float = 0.0

    def of_frame(self, frame: int) -> Lens:
        """Return the lens of a photograph."""
        return self.lens if self.later is None or 2 * frame < PHOTOGRAPHS else self.later


@dataclass(frozen=True)
class Trial:
    """One trial: the effect and its size, the classes that were named, what was left."""

    effect: str
    size: float
    seed: int
    verdict: str
    named: list[list[str]]
    left: list[str]
    odd: int = 0  # photographs that `detect` found something odd about

    @property
    def hit(self) -> bool:
        """Whether the effect, or a class that holds it, was named."""
        return any(self.effect in names for names in self.named)


def _shift(amount: float, rng: Rng) -> World:
    return World(lens=replace(LENS, viewpoint_shift=Gennery(e0=0.003 * amount)))


def _bow(amount: float, rng: Rng) -> World:
    middle, turn = PLAIN.corners.mean(axis=0)[:2], rng.uniform(0, np.pi)
    along = np.array([np.cos(turn), np.sin(turn)])
    return World(
        printed=replace(
            PLAIN, bow=lambda place: 1e-3 * amount * (((place - middle) @ along) / 0.1) ** 2
        )
    )


def _scale(amount: float, rng: Rng) -> World:
    return World(
        printed=replace(PLAIN, shift=lambda place: 1e-3 * amount * place * np.array([1.0, 0.0]))
    )


def _survey(amount: float, rng: Rng) -> World:
    off = np.zeros((6, 9, 2))
    off[rng.integers(0, 6, 3), rng.integers(0, 9, 3)] = 3e-4 * rng.standard_normal((3, 2))

    def shift(place: Array) -> Array:
        column, row = np.moveaxis(np.round(place / PLAIN.size), -1, 0)
        return np.asarray(
            amount * off[np.clip(row, 0, 5).astype(int), np.clip(column, 0, 8).astype(int)]
        )

    return World(printed=replace(PLAIN, shift=shift))


def _in_plane(uv: Array) -> Array:
    return np.asarray((uv - (LENS.cx, LENS.cy)) / LENS.fx)


def _decentering(amount: float, rng: Rng) -> World:
    p = 1e-3 * amount * _direction(rng)

    def moved(uv: Array) -> Array:
        x = _in_plane(uv)
        return np.asarray(
            LENS.fx * ((x**2).sum(-1, keepdims=True) * p + 2 * x * (x @ p)[..., None])
        )

    return World(moved=moved)


def _tilt(amount: float, rng: Rng) -> World:
    slope = 1e-3 * amount * _direction(rng)

    def moved(uv: Array) -> Array:
        x = _in_plane(uv)
        return np.asarray(LENS.fx * x * (1 / (1 - x @ slope) - 1)[..., None])

    return World(moved=moved)


def _skew(amount: float, rng: Rng) -> World:
    return World(
        moved=lambda uv: (
            1e-3 * amount * np.stack([uv[..., 1] - LENS.cy, np.zeros(uv.shape[:-1])], axis=-1)
        )
    )


def _profile(amount: float, rng: Rng) -> World:
    periods, phase = rng.uniform(1.5, 2.0), rng.uniform(0, 2 * np.pi)

    def moved(uv: Array) -> Array:
        x = uv - (LENS.cx, LENS.cy)
        height = np.linalg.norm(x, axis=-1, keepdims=True)
        ripple = np.sin(2 * np.pi * periods * height / 320 + phase) - np.sin(phase)
        return np.asarray(0.1 * amount * ripple * x / np.maximum(height, 1e-9))

    return World(moved=moved)


def _center(amount: float, rng: Rng) -> World:
    du, dv = amount * _direction(rng)
    return World(lens=replace(LENS, cx=LENS.cx + du, cy=LENS.cy + dv), bumped=True)


def _step(amount: float, rng: Rng) -> World:
    du, dv = 0.1 * amount * _direction(rng)
    larger = 1 + 3e-4 * amount
    return World(
        later=replace(
            LENS, fx=larger * LENS.fx, fy=larger * LENS.fy, cx=LENS.cx + du, cy=LENS.cy + dv
        )
    )


def _shutter(amount: float, rng: Rng) -> World:
    return World(line_time=1e-5 * amount)


def _direction(rng: Rng) -> Array:
    turn = rng.uniform(0, 2 * np.pi)
    return np.array([np.cos(turn), np.sin(turn)])


HIDDEN: dict[str, Callable[[float, Rng], World]] = {
    'viewpoint_shift': _shift,
    'target_shape': _bow,
    'landmark_scale': _scale,
    'landmark_survey': _survey,
    'decentering': _decentering,
    'sensor_tilt': _tilt,
    'skew': _skew,
    'radial_profile': _profile,
    'principal_point': _center,
    'session_step': _step,
    'rolling_shutter': _shutter,
}
# Nothing that moves corners: photographs under these are to be found adequate.
CLEAN: dict[str, World] = {
    'nothing': World(),
    'defocus': World(exposure=Exposure(blur=1.2, blur_edge=0.8)),
    'uneven light': World(exposure=Exposure(slope=(0.5, -0.3))),
}
ASIDE: dict[str, World] = {'over-exposed': World(exposure=Exposure(gain=1.4))}


def _seen(world: World, swung: Swing) -> Array:
    """Return the corners' image points (P, N, 2), px, NaN for none."""
    if world.line_time:
        return of_rows(world.lens, swung, world.printed.true_corners(), world.line_time)
    points = swung.poses.into_body(world.printed.true_corners())
    uv = np.stack([project(world.of_frame(i), one).uv for i, one in enumerate(points)])
    return np.asarray(uv if world.moved is None else uv + world.moved(uv))


def _amount(make: Callable[[float], World], swung: Swing, size: float) -> float:
    """Return the amount that a lens fit without the effect leaves `size` times the noise of."""
    world = make(1.0)
    uv = _seen(world, swung)
    frame, corner = np.nonzero(np.isfinite(uv).all(axis=-1))
    table = make_observations(frame, corner, uv[frame, corner], PLAIN.corners[corner])
    if world.bumped:
        residual = solve_table(table, ForwardModel(LENS)).result.residual
    else:
        residual = calibrate(table, 'kannala_brandt', (640, 600)).adjusted.residual
    return float(size * NOISE * np.sqrt(2) / rms_px(residual))


def _field(world: World, lens: Lens, pose: Pose) -> Field | None:
    if world.moved is None:
        return None
    moved = world.moved

    def field(place: Array) -> Array:
        flat = np.pad(place.reshape(-1, 2), ((0, 0), (0, 1)))
        uv = project(lens, pose.into_body(flat), limited=False).uv
        return np.asarray(np.nan_to_num(moved(uv)).reshape(place.shape))

    return field


def photographs(effect: str, size: float, seed: int, folder: str) -> World:
    """Render the photographs of a trial into a folder; return what was done in them."""
    rng = np.random.default_rng([seed, sum(map(ord, effect))])
    swung = (
        swing(
            LENS,
            PLAIN.corners,
            PLAIN.columns,
            np.arange(PHOTOGRAPHS) / RATE,
            rng,
        )
        if effect == 'rolling_shutter'
        else Swing(
            board_views(LENS, PLAIN, PHOTOGRAPHS, (0.1, 0.28), rng), np.zeros((PHOTOGRAPHS, 6))
        )
    )
    world = (CLEAN | ASIDE).get(effect)
    if world is None:

        def make(amount: float) -> World:
            return HIDDEN[effect](amount, np.random.default_rng(seed))

        world = make(_amount(make, swung, size))
    images: list[Array] = []
    for i in range(PHOTOGRAPHS):
        lens, pose = world.of_frame(i), swung.poses.take(i)
        exposure = replace(world.exposure, twist=tuple(swung.twist[i]), line_time=world.line_time)
        images.append(render(lens, world.printed, pose, exposure, rng, _field(world, lens, pose)))
    if world.line_time:
        _write_video(f'{folder}/video.mkv', images)
    else:
        for i, image in enumerate(images):
            cv2.imwrite(f'{folder}/{i:02d}.png', image)
    return world


def _write_video(path: str, images: Sequence[Array]) -> None:
    """Write a video without loss."""
    video = cv2.VideoWriter(path, cv2.VideoWriter_fourcc(*'FFV1'), RATE, (640, 600))
    for image in images:
        video.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    video.release()


def run_trial(effect: str, size: float, seed: int) -> Trial:
    """Hide an effect in photographs, and ask what it is."""
    with tempfile.TemporaryDirectory() as folder:
        bumped = photographs(effect, size, seed, folder).bumped
        videos = [str(path) for path in Path(folder).glob('*.mkv')]
        try:
            seen = detect(find_photographs(videos or [folder]), parse_pattern(BOARD))
            trial = _asked(effect, size, seed, seen.observations, LENS if bumped else None)
            return replace(trial, odd=sum(bool(one.notes) for one in seen.searched))
        except FisheyeSvpError as error:
            return Trial(effect, size, seed, f'refused: {error}', [], [])


def _asked(effect: str, size: float, seed: int, table: Observations, lens: Lens | None) -> Trial:
    fitted = lens or calibrate(table, 'kannala_brandt', (640, 600)).adjusted.lens
    answer = diagnose(table, fitted, free_intrinsics=lens is None)
    return Trial(
        effect,
        size,
        seed,
        answer.verdict,
        [[cause.effect, *cause.indistinguishable_from] for cause in answer.causes],
        [one.variable for one in answer.remaining],
    )


def todo(trials: int, seed: int) -> list[tuple[str, int]]:
    """Return effects and seeds: `trials` with an effect in turn, two fifths as many without."""
    hidden, clean = list(HIDDEN), list(CLEAN)
    tasks = [(hidden[i % len(hidden)], seed + i // len(hidden)) for i in range(trials)]
    for i in range(2 * trials // 5):
        tasks.insert(7 * (i // 2), (clean[i % len(clean)], seed + i // len(clean)))
    return [*tasks, *((effect, seed + i) for effect in ASIDE for i in range(trials // 10))]


def load() -> list[Trial]:
    """Return the trials that were run."""
    lines = KEPT.read_text().splitlines() if KEPT.is_file() else []
    trials = [Trial(**json.loads(line)) for line in lines]
    return list({(t.effect, t.size, t.seed): t for t in trials}.values())


def report(trials: Sequence[Trial], size: float) -> list[str]:
    """Return the page."""
    mine = [trial for trial in trials if trial.size == size]
    hidden = [t for t in mine if t.effect in HIDDEN]
    clean = [t for t in mine if t.effect in CLEAN]
    aside = [t for t in mine if t.effect in ASIDE]
    counts = {
        e: Counter(
            e if e in names else names[0]
            for t in mine
            if t.effect == e
            for names in t.named or [[NOTHING]]
        )
        for e in (*HIDDEN, *CLEAN, *ASIDE)
    }
    others = {name for c in counts.values() for name in c} - {*HIDDEN, NOTHING}
    columns = [*HIDDEN, *sorted(others), NOTHING]
    rows = [
        [effect, sum(t.effect == effect for t in mine), *(count[name] or '' for name in columns)]
        for effect, count in counts.items()
    ]
    lines = [
        '# Blind tests through images',
        '',
        f'The effect was named in {_rate([t.hit for t in hidden])} of the sets. Unlike in '
        '[other blind tests](blind_independent.md), only',
        f'photographs are given: {PHOTOGRAPHS} of a board ({BOARD}), {LENS.width} x {LENS.height} '
        'px, rendered through a lens of',
        '94°. `detect`, `calibrate` and `diagnose` find the model error. A lens fitted without '
        'the effect',
        f'leaves {size:g} times the noise ({NOISE} px) of it.',
        '',
        '- `principal_point`: the lens was calibrated before it was bumped.',
        '- `rolling_shutter`: frames of a video of a swinging camera.',
        '- Defocus and uneven light count as clean: they are no errors of the lens.',
        '- Over-exposed photographs are reported by `detect`, and have a row of their own.',
        '',
        'Intervals are 95 %.',
        '',
        '```bash',
        f'python -m benchmark.studies.blind_images --trials {len(hidden)}',
        '```',
        '',
        f'- effect named: {_rate([t.hit for t in hidden])}',
        f'- nothing else named: {_rate([t.hit and len(t.named) == 1 for t in hidden])}',
        f'- clean photographs found adequate: {_rate([t.verdict == "adequate" for t in clean])}',
        f'- no effect named in them: {_rate([not t.named for t in clean])}',
        '- over-exposed: `detect` reports all photographs in '
        f'{_rate([t.odd == PHOTOGRAPHS for t in aside])}; still found adequate: '
        f'{_rate([t.verdict == "adequate" for t in aside])}',
        '',
        'Trials by hidden effect (rows) and named effect (columns):',
        '',
        *study.table('hidden | trials | ' + ' | '.join(columns), [row for row in rows if row[1]]),
    ]
    failed = [t for t in hidden if not t.hit] + [t for t in clean if t.verdict != 'adequate']
    if failed:
        lines += [
            '',
            'Every trial that failed:',
            '',
            *(
                f'- {t.effect} #{t.seed}: {t.verdict}; named: '
                f'{", ".join(" or ".join(names) for names in t.named) or "nothing"}; '
                f'left: {", ".join(t.left) or "nothing"}'
                for t in failed
            ),
        ]
    return lines


def _rate(results: Sequence[bool]) -> str:
    found = study.Rate.of(results)
    low, high = found.interval
    return f'{found}, {100 * low:.0f} to {100 * high:.0f} %'


def main() -> None:
    """Run the trials that are not there yet, and write the page."""
    args = study.parser(
        'blind_images',
        __doc__,
        None,
        workers=False,
        trials=(100, 'with an effect (100)'),
        size=(1.0, 'times the noise'),
        seed=(0, 'of the first of each effect'),
    ).parse_args()
    done = {(t.effect, t.size, t.seed) for t in load()}

    def keep(task: tuple[str, int]) -> None:
        trial = run_trial(task[0], args.size, task[1])
        with KEPT.open('a') as file:
            file.write(json.dumps(asdict(trial)) + '\n')

    study.in_turn(
        'blind images',
        keep,
        [
            (effect, seed)
            for effect, seed in todo(args.trials, args.seed)
            if (effect, args.size, seed) not in done
        ],
    )
    study.write_lines(study.RESULTS / 'blind_images.md', report(load(), args.size))


if __name__ == '__main__':
    main()
