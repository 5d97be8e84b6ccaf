"""Blind tests through images: `python -m benchmark.blind_images --trials 20`.

An effect is hidden in rendered photographs; `detect`, `calibrate` and `diagnose` get nothing but
the pictures and the board's nominal size.  Its amount is such that it leaves `size` times the
noise of the corners once a lens without it is fitted.  Writes docs/blind/images.json.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.detect.detection import detect
from fisheye_svp_ros.detect.patterns import parse_pattern
from fisheye_svp_ros.detect.photographs import find_photographs
from fisheye_svp_ros.diagnosis.diagnosis import diagnose
from fisheye_svp_ros.errors import FisheyeSvpError
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.optics.curves import Gennery, KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.reporting.progress import progress
from fisheye_svp_ros.scene.observations import make_observations
from fisheye_svp_ros.simulate.board_views import board_views
from fisheye_svp_ros.simulate.render import Exposure, Field, Print, render
from fisheye_svp_ros.solve.lens_calibration import calibrate
from fisheye_svp_ros.solve.measured import rms_px

BOARD = 'chessboard:9x6:25mm'
NOISE = 0.008  # px, of a corner's u and v in these photographs
PHOTOGRAPHS = 20
LENS = Lens('blind', 640, 600, 214.0, 214.3, 320.4, 298.8, KannalaBrandt(-0.01, 0.004, -0.0015),
            np.radians(94.0))
PLAIN = Print(9, 6, 0.025)


class World(NamedTuple):
    """What really happens: the lens, the print, the light, and how image points move besides."""

    lens: Lens = LENS
    printed: Print = PLAIN
    exposure: Exposure = Exposure()
    moved: Callable[[Array], Array] | None = None  # of image points (..., 2), px


@dataclass(frozen=True)
class Trial:
    """One trial: the effect and its size, what was named, the verdict."""

    effect: str
    size: float
    named: tuple[str, ...]
    verdict: str


def _shift(amount: float, rng: np.random.Generator) -> World:
    return World(lens=replace(LENS, viewpoint_shift=Gennery(e0=0.003 * amount)))


def _bow(amount: float, rng: np.random.Generator) -> World:
    middle, turn = PLAIN.corners.mean(axis=0)[:2], rng.uniform(0, np.pi)
    along = np.array([np.cos(turn), np.sin(turn)])
    return World(printed=replace(
        PLAIN, bow=lambda place: 1e-3 * amount * (((place - middle) @ along) / 0.1) ** 2))


def _scale(amount: float, rng: np.random.Generator) -> World:
    return World(printed=replace(
        PLAIN, shift=lambda place: 1e-3 * amount * place * np.array([1.0, 0.0])))


def _survey(amount: float, rng: np.random.Generator) -> World:
    off = np.zeros((6, 9, 2))
    off[rng.integers(0, 6, 3), rng.integers(0, 9, 3)] = 3e-4 * rng.standard_normal((3, 2))

    def shift(place: Array) -> Array:
        column, row = np.moveaxis(np.round(place / PLAIN.size), -1, 0)
        return np.asarray(amount * off[np.clip(row, 0, 5).astype(int),
                                       np.clip(column, 0, 8).astype(int)])

    return World(printed=replace(PLAIN, shift=shift))


def _decentering(amount: float, rng: np.random.Generator) -> World:
    turn = rng.uniform(0, 2 * np.pi)
    p = 1e-3 * amount * np.array([np.cos(turn), np.sin(turn)])

    def moved(uv: Array) -> Array:
        x = (uv - (LENS.cx, LENS.cy)) / LENS.fx
        return np.asarray(LENS.fx * ((x**2).sum(-1, keepdims=True) * p
                                     + 2 * x * (x @ p)[..., None]))

    return World(moved=moved)


def _skew(amount: float, rng: np.random.Generator) -> World:
    return World(moved=lambda uv: 1e-3 * amount * np.stack(
        [uv[..., 1] - LENS.cy, np.zeros(uv.shape[:-1])], axis=-1))


HIDDEN: dict[str, Callable[[float, np.random.Generator], World]] = {
    'viewpoint_shift': _shift, 'target_shape': _bow, 'landmark_scale': _scale,
    'landmark_survey': _survey, 'decentering': _decentering, 'skew': _skew,
}
# Nothing that moves corners: photographs under these are to be found adequate.
CLEAN: dict[str, World] = {
    'nothing': World(), 'defocus': World(exposure=Exposure(blur=1.2, blur_edge=0.8)),
    'uneven light': World(exposure=Exposure(slope=(0.5, -0.3))),
}


def _seen(world: World, poses: Pose) -> Array:
    """Return the corners' image points (P, N, 2), px, NaN for none."""
    uv = project(world.lens, poses.into_body(world.printed.true_corners())).uv
    return np.asarray(uv if world.moved is None else uv + world.moved(uv))


def _amount(make: Callable[[float], World], poses: Pose, size: float) -> float:
    """Return the amount that a lens fit without the effect leaves `size` times the noise of."""
    uv = _seen(make(1.0), poses)
    frame, corner = np.nonzero(np.isfinite(uv).all(axis=-1))
    table = make_observations(frame, corner, uv[frame, corner], PLAIN.corners[corner])
    fitted = calibrate(table, 'kannala_brandt', (LENS.width, LENS.height))
    return size * NOISE * np.sqrt(2) / rms_px(fitted.adjusted.residual)


def _field(world: World, pose: Pose) -> Field | None:
    if world.moved is None:
        return None
    moved, lens = world.moved, world.lens

    def field(place: Array) -> Array:
        flat = np.pad(place.reshape(-1, 2), ((0, 0), (0, 1)))
        uv = project(lens, pose.into_body(flat), limited=False).uv
        return np.asarray(np.nan_to_num(moved(uv)).reshape(place.shape))

    return field


def run_trial(effect: str, size: float, seed: int) -> Trial:
    """Hide an effect in photographs, and ask what it is."""
    rng = np.random.default_rng([seed, sum(map(ord, effect))])
    poses = board_views(LENS, PLAIN, PHOTOGRAPHS, (0.1, 0.28), rng)
    if effect in CLEAN:
        world = CLEAN[effect]
    else:
        def make(amount: float) -> World:
            return HIDDEN[effect](amount, np.random.default_rng(seed))

        world = make(_amount(make, poses, size))
    with tempfile.TemporaryDirectory() as folder:
        for i in range(PHOTOGRAPHS):
            pose = poses.take(i)
            image = render(world.lens, world.printed, pose, world.exposure, rng,
                           _field(world, pose))
            cv2.imwrite(f'{folder}/{i:02d}.png', image)
        try:
            seen = detect(find_photographs([folder]), parse_pattern(BOARD))
            lens = calibrate(seen.observations, 'kannala_brandt', seen.image_size).adjusted.lens
            answer = diagnose(seen.observations, lens, free_intrinsics=True)
        except FisheyeSvpError as error:
            return Trial(effect, size, (), f'refused: {error}')
    named = [{cause.effect, *cause.indistinguishable_from} for cause in answer.causes]
    first = tuple(effect if effect in names else next(iter(sorted(names))) for names in named)
    return Trial(effect, size, first, answer.verdict)


def main() -> None:
    """Run the trials in turn, print and write what was named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--trials', type=int, default=20, help='of each effect')
    parser.add_argument('--size', type=float, default=1.0, help='times the noise')
    parser.add_argument('--seed', type=int, default=0)
    args = parser.parse_args()
    todo = [(effect, args.seed + i) for i in range(args.trials) for effect in (*HIDDEN, *CLEAN)]
    trials = []
    with progress('blind images', len(todo)) as done:
        for effect, seed in todo:
            trials.append(run_trial(effect, args.size, seed))
            print(f'{effect}: {", ".join(trials[-1].named) or "-"} ({trials[-1].verdict})',
                  flush=True)
            done()
    counts = {effect: Counter(name for t in trials if t.effect == effect for name in t.named)
              for effect in (*HIDDEN, *CLEAN)}
    command = f'python -m benchmark.blind_images --trials {args.trials} --size {args.size:g}'
    write_text(Path(__file__).parents[1] / 'docs' / 'blind' / 'images.json', json.dumps({
        'command': command, 'trials': args.trials,
        'named': {effect: dict(count) for effect, count in counts.items()},
        'verdicts': {effect: dict(Counter(t.verdict for t in trials if t.effect == effect))
                     for effect in counts},
    }, indent=1) + '\n')


if __name__ == '__main__':
    main()
