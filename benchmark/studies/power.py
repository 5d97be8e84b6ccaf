"""What is named of what an oracle sees: `make study NAME=power`.

Boards of the independent simulator, landmarks .03 mm off, through a lens that is calibrated on the
same photographs.  Hidden: a viewpoint shift in five to eight photographs, a focal length that
drifts smoothly or settles as a camera warms up, with the times of the photographs and without, a
pupil that moves sideways; or nothing.  The oracle is a test that is told what to look for, and
knows the noise; its amplitude over standard error is drawn from the range that is stated.  Found:
the effect, or one that it is not told from; false: any other name.

Writes docs/results/power.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

import fisheye_svp_ros as fsvp
from benchmark import study
from benchmark.studies.independent.adjust import Free
from benchmark.studies.independent.camera import draw_lens
from benchmark.studies.independent.effects import EFFECTS, Form, Rng, thermal_drift
from benchmark.studies.independent.formation import Departure, form, observed, simulated
from benchmark.studies.independent.oracle import amplitudes
from benchmark.studies.independent.scene import Scene, Track, draw_scene
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.scene.observations import Observations, make_observations

OFFSET = 3e-5  # m: of the landmarks of a printed board
FEW, ALL = (5, 9), (40, 41)  # photographs: least number, and one more than the most
_LARGEST, _LEAST_POINTS = 0.05, 250


class Family(NamedTuple):
    """What is hidden, as which effect, in how many photographs, how clearly; timed: with times."""

    name: str
    effect: str
    draw: Callable[[Rng, Scene], Form] | None
    frames: tuple[int, int]
    clear: tuple[float, float] = (0.0, 0.0)
    timed: bool = True


FAMILIES = (
    Family('shift, few', 'viewpoint_shift', EFFECTS['viewpoint_shift'].draw, FEW, (5.5, 8)),
    Family('smooth drift', 'focal_drift', EFFECTS['focal_drift'].draw, ALL, (7, 11)),
    Family('thermal drift', 'focal_drift', thermal_drift, ALL, (7, 11)),
    Family('thermal drift, no times', 'focal_drift', thermal_drift, ALL, (7, 11), timed=False),
    Family(
        'sideways pupil', 'pupil_decentering', EFFECTS['pupil_decentering'].draw, ALL, (15, 40)
    ),
    Family('nothing, few', '', None, FEW),
    Family('nothing', '', None, ALL),
)


class Outcome(NamedTuple):
    """Of one set: its family, the oracle's amplitude, names with what they are not told from."""

    family: str
    z: float
    named: tuple[tuple[str, ...], ...]
    offered: bool


def trial(task: tuple[int, int]) -> Outcome:
    """Run one trial, family and number; the same gives the same data."""
    family, rng = FAMILIES[task[0]], np.random.default_rng(task)
    table, size, z = _draw_set(family, rng)
    lens = fsvp.calibrate(table, 'kannala_brandt', size).lens
    document = fsvp.diagnose(table, lens).document
    named = tuple(
        (cause['effect'], *cause['indistinguishable_from']) for cause in document['causes']
    )
    offered = document['decision']['lens']['say'] in ('use_extended', 'recalibrate')
    return Outcome(family.name, z, named, offered)


def _draw_set(family: Family, rng: Rng) -> tuple[Observations, tuple[int, int], float]:
    """Return photographs, image size and the oracle's amplitude."""
    while True:
        lens, noise = draw_lens(rng, 'kannala_brandt', 1.6), float(np.exp(rng.uniform(-3, -1.2)))
        scene = draw_scene(
            rng, lens, 'board', fitted=True, stereo=False, moving=False, noise=noise
        )
        if scene is None:
            continue
        scene = _choose_frames(scene, int(rng.integers(*family.frames)), rng)
        found = _hide(family, scene, rng)
        if found is None or len(scene.frame) < _LEAST_POINTS:
            continue
        offsets = Departure(landmarks=OFFSET * rng.normal(size=scene.target.points.shape))
        uv, named = observed(rng, scene, [offsets, *found], 0.0)
        z = [abs(one or 0.0) for one in amplitudes(scene, Free.of(scene), uv, found)]
        table = make_observations(
            named.frame,
            named.landmark,
            uv,
            scene.target.points[named.landmark],
            t=named.track.times[named.frame] if family.timed else None,
        )
        return table, (lens.width, lens.height), max(z, default=0.0)


def _choose_frames(scene: Scene, count: int, rng: Rng) -> Scene:
    """Return a scene of at most so many of the frames that are not held out."""
    kept, track = np.flatnonzero(~scene.held), scene.track
    chosen = np.sort(rng.choice(kept, min(count, len(kept)), replace=False))
    rows = np.isin(scene.frame, chosen)
    return replace(
        scene,
        track=Track(track.times[chosen], track.centers[chosen], track.turns[chosen], track.moving),
        held=np.zeros(len(chosen), bool),
        frame=np.searchsorted(chosen, scene.frame[rows]),
        camera=scene.camera[rows],
        landmark=scene.landmark[rows],
    )


def _hide(family: Family, scene: Scene, rng: Rng) -> list[Departure] | None:
    """Return the departure that the oracle sees as clearly as is wanted; None for too large."""
    if family.draw is None:
        return []
    draw, nominal, free = family.draw(rng, scene), simulated(scene), Free.of(scene)
    wanted, amount = rng.uniform(*family.clear), 1e-5
    for _ in range(10):
        left = free.step(form(scene, [draw(amount)]) - nominal).left
        seen = float(np.linalg.norm(left)) / scene.noise
        if abs(seen / wanted - 1) < 0.02:
            return [draw(amount)]
        amount *= wanted / max(seen, 1e-9)
        if amount > _LARGEST:
            break
    return None


def report(outcomes: Sequence[Outcome], command: str) -> str:
    """Return the page."""
    rows, false = [], []
    for family in FAMILIES:
        mine = [one for one in outcomes if one.family == family.name]
        wrong = [[name for name in one.named if family.effect not in name] for one in mine]
        false += [bool(names) for names in wrong]
        if mine:
            low, high = family.clear
            found = sum(any(family.effect in name for name in one.named) for one in mine)
            names = ', '.join(sorted({name[0] for names in wrong for name in names}))
            rows.append(
                [
                    family.name,
                    f'{low:g} to {high:g}' if high else '-',
                    f'{found} of {len(mine)}' if family.effect else '-',
                    f'{sum(map(bool, wrong))} of {len(mine)}{names and f" ({names})"}',
                ]
            )
    return study.page(
        'What is named of what an oracle sees',
        __doc__,
        command,
        study.table('hidden | oracle, standard errors | found | false', rows),
        [f'Sets with a false name: {study.Rate.of(false)}.'],
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the trials and write the page."""
    asked = study.parser(
        'power', __doc__, study.RESULTS / 'power.md', trials=(12, 'of each family')
    ).parse_args(arguments)
    tasks = [(family, i) for i in range(asked.trials) for family in range(len(FAMILIES))]
    outcomes = study.in_processes('power', trial, tasks, asked.workers)
    page = report(outcomes, f'python -m benchmark.studies.power --trials {asked.trials}')
    write_text(asked.output, page)


if __name__ == '__main__':
    main()
