"""Where cameras stand, by the lenses that `calibrate` writes: `make study NAME=rig_transforms`.

Four different lenses stand on an arc, 18 deg apart, and take 24 photographs of one board of 7 x 5
corners, 27 cm wide; each sees half or more. Corners are off by 0.05 mm, image fields of lenses and
of frames by 0.04 px each, 0.08 px of noise; the board is flat, or bent by 1.5 mm. Each set is
calibrated as `calibrate` does (generalized), and all cameras together by least squares; the
transforms into the first camera are compared with the true ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

import fisheye_svp_ros as fsvp
from benchmark import study
from benchmark.studies.boards import joined
from benchmark.studies.two_cameras import Hidden, bent_print, photograph_print
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.optics.curves import KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens, intrinsic_names
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.simulate.render import Print
from fisheye_svp_ros.simulate.targets import board_views
from fisheye_svp_ros.solve.bundle_adjustment import adjust
from fisheye_svp_ros.solve.rig_calibration import RigCalibration, start_rig

KINDS = {'flat board': 0.0, 'board bent by 1.5 mm': 1.5e-3}  # m
CAMERAS = tuple(f'cam{i}' for i in range(4))
SIZE = 1280, 960
_RADIUS, _STEP = 0.35, np.radians(18.0)  # m, between neighbors
_BACKGROUND = Hidden(offset=5e-5, frames=24, columns=7, rows=5)


class Outcome(NamedTuple):
    """One set, of a kind.

    errors: by estimate, rms over three cameras, of place, m, and of turn, rad; z: errors of 18
    numbers over their standard errors, of the generalized estimate.
    """

    kind: str
    errors: dict[str, tuple[float, float]]
    z: list[float]


def true_rig() -> Pose:
    """Return the cameras (4,) in the first one."""
    angle = _STEP * np.arange(4)
    place = _RADIUS * np.stack([np.sin(angle), 0.03 * angle, 1 - np.cos(angle)], axis=-1)
    turn = np.stack([0.04 * np.sin(5 * angle), angle, 0.03 * angle], axis=-1)
    return Pose(np.stack([rotation_from_vector(one) for one in turn]), place)


def draw_table(seed: int, bend: float) -> Observations:
    """Draw what four cameras see of a board that is bent by so much, m."""
    rng = np.random.default_rng([23, seed])
    hidden = replace(_BACKGROUND, bend=bend)
    printed = Print(hidden.columns, hidden.rows, 0.27 / hidden.columns)
    board = bent_print(printed, hidden, rng)
    lenses = [_draw_lens(rng, name) for name in CAMERAS]
    rig, each = true_rig(), hidden.frames // 4
    bodies = [
        board_views(lens, printed, each, (0.3, 0.8), rng).compose(
            rig.take(camera).inverse().broadcast_to(each)
        )
        for camera, lens in enumerate(lenses)
    ]
    body = Pose(*(np.concatenate(parts) for parts in zip(*bodies, strict=True)))
    tables = [
        photograph_print(
            lens,
            printed,
            board,
            body.compose(rig.take(camera).broadcast_to(hidden.frames)),
            hidden,
            rng,
            camera,
        )
        for camera, lens in enumerate(lenses)
    ]
    return replace(joined(tables), cameras=CAMERAS, source='rig')


def _draw_lens(rng: np.random.Generator, name: str) -> Lens:
    k = rng.normal(0, [0.015, 0.006])
    focal, (x, y) = rng.uniform(380, 440), rng.normal(0, 8, 2)
    curve = KannalaBrandt(*k.tolist())
    return Lens(name, *SIZE, focal, 1.002 * focal, 639.5 + x, 479.5 + y, curve, 1.4)


def run_trial(number: int) -> Outcome:
    """Calibrate one set by both estimates; the kinds take turns."""
    seed, kind = divmod(number, len(KINDS))
    name, bend = [*KINDS.items()][kind]
    table = draw_table(seed, bend)
    rig = fsvp.calibrate_cameras(table, SIZE).rig
    assert rig is not None and rig.cameras[0] == CAMERAS[0]
    truth = true_rig().take([CAMERAS.index(name) for name in rig.cameras])
    off = rig.rig.difference(truth)[1:]
    z = off / np.sqrt(np.diagonal(rig.covariance, axis1=1, axis2=2))
    errors = {'least squares': _rms(_least_squares(table, rig)), 'generalized': _rms(off)}
    return Outcome(name, errors, z.ravel().tolist())


def _least_squares(table: Observations, found: RigCalibration) -> Array:
    """Return the errors (3, 6) of the rig of least squares; found: to start from."""
    lenses = dict(zip(found.cameras, found.lenses, strict=True))
    start = start_rig(table, lenses, CAMERAS)
    data, state = start.add_frames_of_one(table)
    free = [f'{name}.{one}' for name in start.cameras for one in intrinsic_names(lenses[name])]
    rig = adjust(data, replace(state, labels=start.cameras), free).rig
    return rig.take([start.cameras.index(name) for name in CAMERAS]).difference(true_rig())[1:]


def _rms(off: Array) -> tuple[float, float]:
    place, turn = np.sqrt((off.reshape(3, 2, 3) ** 2).sum(axis=-1).mean(axis=0)).tolist()
    return place, turn


def report(outcomes: Sequence[Outcome], command: str) -> str:
    """Return the page."""
    rows = []
    for kind in dict.fromkeys(one.kind for one in outcomes):
        mine = [one for one in outcomes if one.kind == kind]
        plain, ours = (
            np.array([one.errors[name] for one in mine])
            for name in ('least squares', 'generalized')
        )
        z = np.array([one.z for one in mine]).ravel()
        rows.append(
            [
                f'{kind}: {len(mine)} sets',
                *(_sizes(errors) for errors in (plain, ours)),
                *(_ratios(ratio) for ratio in (ours / plain).T),
                study.Rate.of(np.abs(z) < 1.96),
                f'{np.sqrt((z**2).mean()):.2f}',
            ]
        )
    head = (
        ' | least squares: mm, deg | generalized: mm, deg | ratio, place | ratio, turn'
        ' | within 95 % | rms z'
    )
    return study.page(
        'Transforms of a rig',
        __doc__,
        command,
        study.table(head, rows, numbers=True),
        [
            'Medians of the rms errors of three cameras; ratio: generalized to least squares,',
            'geometric mean (least to largest); within: of 18 numbers a set, those within 1.96',
            'of their stated standard errors, and the rms of their ratio to these (z).',
        ],
    )


def _sizes(errors: Array) -> str:
    place, turn = np.median(errors, axis=0)
    return f'{1e3 * place:.3f}, {np.degrees(turn):.4f}'


def _ratios(ratio: Array) -> str:
    mean = float(np.exp(np.log(ratio).mean()))
    return f'{mean:.2f} ({ratio.min():.2f} to {ratio.max():.2f})'


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the study and write its page."""
    study.run_sets(
        'rig_transforms',
        __doc__,
        run_trial,
        report,
        arguments,
        sets=(20, 'of each kind'),
        each=len(KINDS),
    )


if __name__ == '__main__':
    main()
