"""What spoilt views do to poses, and whether wrong ones are said to be wrong.

`python -m benchmark.studies.poses` writes the section "Poses" of docs/results/reliability.md.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from benchmark import study
from benchmark.studies.boards import directions, grid
from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.optics import engines
from fisheye_svp_ros.pose import Pose, identity, rotation_from_vector
from fisheye_svp_ros.scene.observations import Views, views_of
from fisheye_svp_ros.solve.localization import MIN_POINTS, localize
from fisheye_svp_ros.solve.reliability import examine

SIGMA = 0.3  # px
FAR_OFF = 10.0  # standard errors beyond which a pose is wrong
SCENES = ('room', 'board')
CASES = {
    'clean': 'nothing',
    'outliers': '10 % of the points are off by some 3, 10 or 50 px',
    'swapped': 'two points have swapped their ids',
    'half size': 'the image was halved, the lens was not',
    'double size': 'the image was doubled, the lens was not',
    'lens': 'the lens is that of another camera',
    'mirrored': 'the landmarks are mirrored',
    'millimetres': 'the landmarks are in millimetres',
}
# From one view these cannot be told: a mirrored plane is the same plane seen from behind.
UNTESTABLE = {('mirrored', 'board')}
_LENS, _OTHER = 'fish214', 'fish180'


class Outcome(NamedTuple):
    """What became of views.

    refused: too few points lie in the field of view; unsolved: no pose; warned, passed: with and
    without a reason for doubt; wrong: of the passed, beyond FAR_OFF; cleaned: outliers were
    left out; righted: of these, not wrong.
    """

    views: int
    refused: int
    unsolved: int
    warned: int
    passed: int
    wrong: int
    cleaned: int
    righted: int


def scene(kind: str, count: int, rng: np.random.Generator, points: int = 20) -> tuple[Array, Pose]:
    """Return landmarks (S, N, 3), m, and poses (S,) that see them: a room, or a board of 5 x 4."""
    if kind == 'room':
        return _around(np.radians(80), 0.5, 3.0, count, points, rng)
    place = _within(np.radians(50), (count,), rng) * rng.uniform(0.25, 0.8, (count, 1))
    turn = rotation_from_vector(rng.uniform(-0.6, 0.6, (count, 3)) * [1, 1, 3])
    return np.tile(grid(5, 4, 0.1)[:points], (count, 1, 1)), Pose(turn, place).inverse()


def _around(
    cone: float, near: float, far: float, count: int, points: int, rng: np.random.Generator
) -> tuple[Array, Pose]:
    """Return landmarks (S, N, 3), m, within a cone ahead of cameras, and their poses (S,)."""
    d = _within(cone, (count, points), rng)
    pose = identity(count).retract(rng.normal(size=(count, 6)) * [1, 1, 1, 2, 2, 2])
    return pose.reshape(count, 1).transform(d * rng.uniform(near, far, (count, points, 1))), pose


def spoilt(
    case: str, kind: str, count: int, rng: np.random.Generator
) -> tuple[ForwardModel, Views, Pose]:
    """Return the model to solve with, views and the true poses (S,)."""
    points, pose = scene(kind, count, rng)
    model = ForwardModel(load_lens(lens_path(_LENS)))
    blank = views_of(points, np.zeros((*points.shape[:2], 2)))
    uv = model.predict(pose, blank).uv
    uv += SIGMA * rng.normal(size=uv.shape)
    pairs = np.argsort(rng.uniform(size=uv.shape[:2]), axis=1)[:, :2]
    rows = np.arange(count)[:, None]
    if case == 'outliers':
        uv[rows, pairs] += rng.normal(size=(count, 2, 2)) * rng.choice([3, 10, 50], (count, 1, 1))
    elif case == 'swapped':
        uv[rows, pairs] = uv[rows, pairs[:, ::-1]]
    elif case.endswith('size'):
        uv *= 0.5 if case == 'half size' else 2.0
    elif case == 'lens':
        model = ForwardModel(load_lens(lens_path(_OTHER)))
    elif case == 'mirrored':
        points = points * [-1, 1, 1]
    elif case == 'millimetres':
        points = 1000 * points
    return model, views_of(points, uv, np.full(uv.shape[:2], 1 / SIGMA)), pose


def tried(case: str, kind: str, count: int, rng: np.random.Generator) -> Outcome:
    """Solve and examine spoilt views, and hold the poses against the truth."""
    model, views, true = spoilt(case, kind, count, rng)
    inside = model.back_project(views.uv).valid & views.used
    seen: Mask = inside.sum(axis=1) >= MIN_POINTS
    if not seen.any():
        return Outcome(count, count, 0, 0, 0, 0, 0, 0)
    views, true = views.take(seen), true.take(seen)
    checked = examine(model, views, localize(model, views))
    found = checked.result
    with np.errstate(invalid='ignore'):
        deviation = np.sqrt(np.diagonal(found.covariance, axis1=-2, axis2=-1))
    off = np.abs(found.pose.difference(true))
    wrong = np.zeros(len(off), dtype=bool)
    for part in (slice(0, 3), slice(3, 6)):
        size, error = (np.linalg.norm(x[:, part], axis=1) for x in (deviation, off))
        wrong |= error > FAR_OFF * size
    passed = found.converged & np.array([not reason for reason in checked.reasons])
    cleaned = found.converged & checked.outliers.any(axis=1)
    return Outcome(
        count,
        int((~seen).sum()),
        int((~found.converged).sum()),
        int((found.converged & ~passed).sum()),
        int(passed.sum()),
        int((wrong & passed).sum()),
        int(cleaned.sum()),
        int((cleaned & ~wrong).sum()),
    )


def lost_minima(points: int, cone: float, count: int, rng: np.random.Generator) -> int:
    """Return how many views of few points miss a minimum that other starts find.

    cone: half angle, rad, of the landmarks as the camera sees them.
    """
    landmarks, pose = _around(cone, 1.0, 1.5, count, points, rng)
    model = ForwardModel(load_lens(lens_path(_LENS)))
    uv = model.predict(pose, views_of(landmarks, np.zeros((count, points, 2)))).uv
    views = views_of(
        landmarks, uv + SIGMA * rng.normal(size=uv.shape), np.full(uv.shape[:2], 1 / SIGMA)
    )
    best = np.full(count, np.inf)
    for start in range(12):
        change = rng.normal(size=(count, 6)) * [0.5, 0.5, 0.5, 2, 2, 2] * (start > 0)
        other = localize(model, views, pose.retract(change))
        best = np.fmin(best, np.where(other.converged, other.cost, np.inf))
    return int((localize(model, views).cost > best + 1e-3).sum())


def section(outcomes: dict[tuple[str, str], Outcome], lost: dict[int, tuple[int, int]]) -> str:
    """Return the section of docs/results/reliability.md."""
    spoilt_views = [o for (case, _), o in outcomes.items() if case != 'clean']
    told = [o for place, o in outcomes.items() if place not in UNTESTABLE and place[0] != 'clean']
    clean = [o for (case, _), o in outcomes.items() if case == 'clean']
    lines = [
        f'{sum(o.views for o in spoilt_views)} spoilt views of 20 points, {SIGMA} px of noise; '
        f'a pose is wrong when it is more than {FAR_OFF:.0f} of its stated standard errors off.',
        f'Wrong poses that pass: {sum(o.wrong for o in told)}, those left out that one view '
        'cannot tell (below). Clean views that do not pass: '
        f'{sum(o.views - o.passed for o in clean)} of {sum(o.views for o in clean)}.',
        '',
        *study.table(
            'spoilt by | scene | views | refused | no pose | warned | passed | wrong and passed | '
            'outliers rejected | of these right',
            [
                [CASES[case] + ' (cannot be told)' * ((case, kind) in UNTESTABLE), kind, *o]
                for (case, kind), o in outcomes.items()
            ],
            numbers=True,
        ),
        '',
        'Views of few points have several minima: the best of twelve starts, the true '
        'pose among them, against `localize` without a start.',
        '',
        *study.table(
            'points | views | minima missed',
            [(points, count, missed) for points, (missed, count) in lost.items()],
            numbers=True,
        ),
    ]
    return '\n'.join(lines)


def main() -> None:
    """Run the study and write its section."""
    count = (
        study.parser('poses', __doc__, None, workers=False, views=(720, 'of each case and scene'))
        .parse_args()
        .views
    )
    engines.settle(1e9)
    outcomes = {
        (case, kind): tried(case, kind, count, np.random.default_rng([i, j]))
        for i, case in enumerate(CASES)
        for j, kind in enumerate(SCENES)
    }
    lost = {}
    for points in (4, 5):
        cones = np.radians([15, 30, 60, 85])
        missed = [
            lost_minima(points, cone, count, np.random.default_rng(i))
            for i, cone in enumerate(cones)
        ]
        lost[points] = sum(missed), count * len(cones)
    text = section(outcomes, lost)
    study.write_section(study.RELIABILITY, 'poses', text)
    print(text)


def _within(angle: float, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
    """Return unit directions (*shape, 3) up to an angle from z."""
    theta, azimuth = angle * np.sqrt(rng.uniform(size=shape)), rng.uniform(0, 2 * np.pi, shape)
    return directions(theta, azimuth)


if __name__ == '__main__':
    main()
