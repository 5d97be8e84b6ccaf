"""Who is told to use a lens, and who is not: `make study NAME=loss`.

Photographs of a board through a camera of a simulator of its own, which shares no code with the
package. Of sound kinds the lens is good, whatever the residuals are: boards that are flat, bent,
bumpy, or bent by another amount in every photograph, landmarks that are off, light that changes,
a camera in the hand that moves while its rows are read.
Of bad kinds it is not, or the world is not what the table says: a focal length or a center that
differs from frame to frame, few photographs, absurd noise, corners that are mirrored in a quarter
of the photographs, an image size that is too large. Each set is calibrated and diagnosed, with
noise from .02 to .3 px.

A set is sound where the true ray error at 1 m of the lens that is to be used is below .3 mrad, or
twice the noise of a point. A false alarm is one that is told not to use its lens, or to take its
photographs again; a false reassurance is a bad set that is told to keep or use a lens, and that
the photographs are enough. The last columns have how often stated 95 % intervals hold the true
error at 0.3, 1 and 5 m, of the lens that is to be used, in sound kinds.

Writes docs/results/loss.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from benchmark import study
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.diagnosis import Diagnosis
from fisheye_svp_ros.scene.observations import Observations, make_observations
from fisheye_svp_ros.solve.ray_errors import (
    RANGES,
    points_on_rays,
    typical_points,
    without_motion,
)

Rng = np.random.Generator
SIZE, TOO_LARGE = (1280, 960), (1600, 1200)
FOCAL, CENTER = 300.0, (643.0, 477.0)
CURVE = (-0.02, 0.004, -0.001, 0.0003)
SOUND = (
    'flat',
    'bent',
    'bumpy',
    'bends by frame',
    'landmarks off',
    'light changes',
    'moves while read',
)
BAD = ('breathes', 'center moves', 'few frames', 'absurd noise', 'mirrored', 'size too large')
GOOD, NOISES = 3e-4, 2.0  # rad, and times the noise of a point: rays so good are sound
COLUMNS, ROWS, SQUARE = 9, 6, 0.03
TURN = 0.01  # rad about each axis, from the first row to the last: .3 rad/s in 30 ms


class Outcome(NamedTuple):
    """Of one set: its kind, answers, the true ray errors and the stated intervals (R,), mrad."""

    kind: str
    noise_mrad: float
    lens: str
    photographs: str
    true: Array
    low: Array
    high: Array

    @property
    def is_sound(self) -> bool:
        """Whether the lens that is to be used is good."""
        good = max(1e3 * GOOD, NOISES * self.noise_mrad)
        return self.kind in SOUND and bool(self.true[RANGES.index(1.0)] < good)

    @property
    def is_alarm(self) -> bool:
        """Whether the user is told not to use the lens, or to take all again."""
        return self.lens in ('undecided', 'recalibrate') and self.photographs == 'retake'

    @property
    def is_reassured(self) -> bool:
        """Whether the user is told that all is well."""
        return self.lens in ('keep', 'use_extended') and self.photographs == 'enough'


def height(theta: Array, focal: float) -> Array:
    """Return image heights, px, of incidence angles, rad."""
    return np.asarray(focal * (theta + sum(k * theta ** (2 * i + 3) for i, k in enumerate(CURVE))))


def project(points: Array, focal: float, center: Array) -> tuple[Array, Array]:
    """Return image points (N, 2), px, and incidence angles (N,) of points (N, 3), m."""
    r = np.hypot(points[:, 0], points[:, 1])
    theta = np.arctan2(r, points[:, 2])
    return center + (height(theta, focal) / r)[:, None] * points[:, :2], theta


def true_points(uv: Array) -> Array:
    """Return the points (R, G, 3), m, that image points (G, 2) see at the ranges."""
    off = uv - CENTER
    h = np.hypot(*off.T)
    angles = np.linspace(0, np.radians(110), 20001)
    theta = np.interp(h, height(angles, FOCAL), angles)
    along = np.column_stack([np.sin(theta)[:, None] * off / h[:, None], np.cos(theta)])
    return np.asarray(np.array(RANGES)[:, None, None] * along)


def draw_pose(rng: Rng) -> tuple[Array, Array]:
    """Return rotation (3, 3) and position (3,), m, of a board that faces the camera."""
    off, around = np.radians(rng.uniform(0, 70)), rng.uniform(0, 2 * np.pi)
    ahead = np.array([np.sin(off) * np.cos(around), np.sin(off) * np.sin(around), np.cos(off)])
    x = np.cross([0.0, 1.0, 0.1], ahead)
    x /= np.linalg.norm(x)
    facing = np.column_stack([x, np.cross(ahead, x), ahead])
    turn = Rotation.from_rotvec([*rng.normal(0, 0.4, 2), rng.uniform(-0.5, 0.5)]).as_matrix()
    return facing @ turn, ahead * rng.uniform(0.15, 0.5)


def shape(kind: str, rng: Rng, at: Array, size: float) -> Array:
    """Return by how much landmarks (N, 2) of a board leave its plane (N,), m, rms about size."""
    if kind == 'bumpy':
        middles = rng.uniform(-1, 1, (4, 2))
        bumps = [np.exp(-((at - middle) ** 2).sum(axis=1) / 0.5) for middle in middles]
        return np.asarray(rng.normal(0, size, 4) @ bumps)
    square = at[:, 0] ** 2
    return np.asarray(rng.normal(0, size) * (square - square.mean()) / square.std())


def draw(kind: str, rng: Rng) -> tuple[Observations, float]:
    """Return the table of a set, and its noise, px."""
    x, y = np.meshgrid(np.arange(COLUMNS), np.arange(ROWS))
    flat = SQUARE * np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()])
    middle = flat.mean(axis=0)
    at = (flat - middle)[:, :2] / (np.ptp(flat, axis=0).max() / 2)
    noise = 2.0 if kind == 'absurd noise' else float(np.exp(rng.uniform(*np.log([0.02, 0.3]))))
    count = int(rng.integers(2, 7)) if kind == 'few frames' else int(rng.integers(14, 31))
    size, change = rng.uniform(3e-4, 2e-3), rng.uniform(0.006, 0.02)
    board = flat + (rng.normal(0, size / 8, flat.shape) if kind == 'landmarks off' else 0)
    board[:, 2] += shape(kind, rng, at, size) if kind in ('bent', 'bumpy') else 0
    mirrored = (COLUMNS * y + COLUMNS - 1 - x).ravel()
    rows: list[Array] = []
    while len(rows) < count:
        rotation, place = draw_pose(rng)
        points = board.copy()
        points[:, 2] += shape(kind, rng, at, size) if kind == 'bends by frame' else 0
        focal = FOCAL * (1 + change * rng.normal() * (kind == 'breathes'))
        center = CENTER + 8 * rng.normal(size=2) * (kind == 'center moves')
        points = (points - middle) @ rotation.T + place
        uv, theta = project(points, focal, center)
        if kind == 'moves while read':
            row = uv[:, 1:] / SIZE[1] - 0.5
            points = points + np.cross(row * rng.normal(0, TURN, 3), points)
            uv, theta = project(points, focal, center)
        light = float(np.exp(0.4 * rng.normal())) if kind == 'light changes' else 1.0
        uv = uv + light * noise * rng.normal(size=uv.shape)
        seen = (uv > 5).all(axis=1) & (uv < np.array(SIZE) - 5).all(axis=1) & (theta < 1.7)
        if seen.sum() >= 30:
            turned = kind == 'mirrored' and len(rows) % 4 == 0
            landmark = mirrored if turned else np.arange(len(flat))
            frame = np.full(seen.sum(), len(rows))
            rows.append(np.column_stack([frame, landmark[seen], uv[seen]]))
    every = np.concatenate(rows)
    landmark = every[:, 1].astype(int)
    return make_observations(
        every[:, 0].astype(int), landmark, every[:, 2:], flat[landmark]
    ), noise


def trial(number: int) -> Outcome:
    """Calibrate and diagnose one set."""
    kinds = (*SOUND, *BAD)
    seed, place = divmod(number, len(kinds))
    kind = kinds[place]
    table, noise = draw(kind, np.random.default_rng([seed, place]))
    size = TOO_LARGE if kind == 'size too large' else SIZE
    given, found = study.calibrated_and_diagnosed(table, size)
    used = found.lens if found.offers_extended else given
    uv = typical_points(table.uv)
    truth, points = true_points(uv), points_on_rays(used, uv)
    there = np.isfinite(points).all(axis=(0, 2))
    off = without_motion(truth[:, there], (points - truth)[:, there])
    true = 1e3 * np.sqrt((off**2).sum(axis=-1).mean(axis=-1))
    return Outcome(
        kind,
        1e3 * noise / FOCAL,
        found.decision['lens'].say,
        found.decision['photographs'].say,
        true,
        *_interval(found),
    )


def _interval(found: Diagnosis) -> tuple[Array, Array]:
    side = 'extended' if found.offers_extended else 'given'
    errors = found.ray_error_mrad()[side][: len(RANGES)]
    low, high = (np.array([error[end] for error in errors]) for end in ('low', 'high'))
    return low, high


def report(outcomes: Sequence[Outcome], command: str) -> str:
    """Return the page."""
    rows = []
    for kind in (*SOUND, *BAD):
        some = [one for one in outcomes if one.kind == kind]
        cells = [kind, len(some), sum(one.is_sound for one in some)]
        cells += [sum(one.is_alarm for one in some), sum(one.is_reassured for one in some)]
        cells.append(f'{np.median([one.true[1] for one in some]):.2g}')
        cells += _held(some) if kind in SOUND else ['-'] * len(RANGES)
        rows.append(cells)
    sound = [one for one in outcomes if one.is_sound]
    bad = [one for one in outcomes if one.kind in BAD]
    every = [one for one in outcomes if one.kind in SOUND]
    sentences = [
        f'False alarms: {sum(one.is_alarm for one in sound)} of {len(sound)} sound sets; '
        f'{sum(one.is_reassured for one in sound)} of them are told that all is well.',
        f'False reassurances: {sum(one.is_reassured for one in bad)} of {len(bad)} bad sets.',
        f'True errors within their stated 95 % intervals: {", ".join(_held(every))} at 0.3, 1 '
        f'and 5 m, of {len(every)} sets of sound kinds.',
    ]
    head = (
        'kind | sets | sound | alarms | all is well | true error at 1 m, mrad (median) '
        '| within: 0.3 m | 1 m | 5 m'
    )
    return study.page(
        'Whom a diagnosis alarms and reassures',
        __doc__,
        command,
        study.table(head, rows),
        *([sentence] for sentence in sentences),
    )


def _held(outcomes: Sequence[Outcome]) -> list[str]:
    """Return the shares of true errors within their intervals, by range."""
    inside = [(one.low <= one.true) & (one.true <= one.high) for one in outcomes]
    return [f'{100 * share:.0f} %' for share in np.mean(inside, axis=0)]


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw, diagnose and count sets."""
    kinds = len(SOUND) + len(BAD)
    study.run_sets('loss', __doc__, trial, report, arguments, (20, 'of each kind'), each=kinds)


if __name__ == '__main__':
    main()
