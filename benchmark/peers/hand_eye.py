"""Cameras on robots: `python -m benchmark.peers.hand_eye [TRIALS] [DIAGNOSED]`.

A robot turns a fisheye camera before a board; its poses have an offset, a scale and noise of their
own.  Each trial is calibrated with and without the robot's poses, beside OpenCV's hand-eye
calibration on the poses of our lens; some, of a bent board, are diagnosed with and without them,
every other one with a hidden error of the lens.  Writes docs/results/hand_eye.md.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy import stats

from benchmark import study
from benchmark.studies.boards import grid
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.diagnosis import Diagnosis, DiagnosisOptions, diagnose
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.optics.curves import Gennery, KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.scene.observations import Observations, make_observations
from fisheye_svp_ros.solve.hand_eye import Transforms
from fisheye_svp_ros.solve.lens_calibration import Calibration, calibrate, calibrate_hand_eye

TRIALS, DIAGNOSED = 60, 120
_FRAMES, _NOISE_PX = 20, 0.15
_LENS = Lens('made', 1280, 800, 350.0, 350.5, 645.0, 396.0, KannalaBrandt(-0.01, 0.002), 1.6)
_SHIFT = Gennery(e0=0.015)
_SQUARE, _COLUMNS, _ROWS = 0.03, 11, 8
_BEND = 3e-4  # m
_NEAR = 40.0  # px: rays are compared where image points are
_OPENCV = {
    'Tsai': cv2.CALIB_HAND_EYE_TSAI,
    'Park': cv2.CALIB_HAND_EYE_PARK,
    'Daniilidis': cv2.CALIB_HAND_EYE_DANIILIDIS,
}


class Case(NamedTuple):
    """What a trial is: the lens, the table, the robot's poses, and the truth about it."""

    lens: Lens
    table: Observations
    poses: dict[int, Pose]
    truth: Transforms
    noise: tuple[float, float]


class Outcome(NamedTuple):
    """What came of a trial.

    z (13,): errors of the transforms over their standard errors; ours, opencv: errors of the
    camera's place, m, and turn, rad; noise: estimated over true; rays: errors of the lens without
    and with poses, rad; named: causes of the lens without and with poses, None where not asked.
    """

    hidden: str
    z: list[float]
    ours: tuple[float, float]
    opencv: dict[str, tuple[float, float]]
    noise: tuple[float, float]
    rays: tuple[float, float]
    named: tuple[list[str], list[str], bool] | None


def draw_case(seed: int, hidden: bool, bent: bool) -> Case:
    """Return a camera on a robot: poses over half a sphere above the board, all turned."""
    rng = np.random.default_rng(seed)
    lens = replace(_LENS, viewpoint_shift=_SHIFT) if hidden else _LENS
    said = grid(_COLUMNS, _ROWS, _SQUARE)
    across = 2 * said / np.ptp(said[:, 0])
    bend = bent * _BEND * rng.uniform(0.3, 1.0) * (across[:, 0] ** 2 + across[:, 1] * across[:, 0])
    points = said + bend[:, None] * [0.0, 0.0, 1.0] + rng.normal(0, 3e-5, said.shape)
    camera = _camera_poses(rng)
    uv = project(lens, camera.into_body(points)).uv
    uv = uv + rng.normal(0, _NOISE_PX, uv.shape)
    inside = ((uv > 0) & (uv < (lens.width, lens.height))).all(axis=-1)
    frame, landmark = np.nonzero(inside)
    table = make_observations(
        frame, landmark, np.asarray(uv[frame, landmark]), said[landmark], source='robot'
    )
    truth = Transforms(
        Pose(rotation_from_vector(rng.normal(0, 0.5, 3)), rng.normal(0, 0.04, 3)),
        Pose(rotation_from_vector(rng.normal(0, 1.0, 3)), rng.normal(0, 0.5, 3)),
        float(1 + rng.normal(0, 5e-4)),
    )
    noise = float(rng.uniform(1e-4, 4e-4)), float(np.radians(rng.uniform(0.02, 0.08)))
    flange = truth.flange(camera)
    flange = Pose(flange.rotation, flange.position / truth.scale).retract(
        rng.normal(size=(_FRAMES, 6)) * np.repeat(noise, 3)
    )
    poses = {i: flange.take(i) for i in range(_FRAMES)}
    return Case(lens, table, poses, truth, noise)


def _camera_poses(rng: np.random.Generator) -> Pose:
    """Return the camera in the board's frame; the board lies anywhere in its image."""
    tilt = rng.uniform(-0.7, 0.7, (_FRAMES, 2))
    spin = rng.uniform(-np.pi, np.pi, _FRAMES)
    turn = rotation_from_vector(np.column_stack([tilt, 0 * spin]))
    turn = turn @ rotation_from_vector(np.column_stack([0 * tilt, spin]))
    sight = rng.uniform(-1.0, 1.0, (_FRAMES, 2)) * (1.0, 0.6)
    place = np.column_stack([np.tan(sight), np.ones(_FRAMES)])
    place *= rng.uniform(0.3, 0.7, (_FRAMES, 1)) / np.linalg.norm(place, axis=1, keepdims=True)
    return Pose(turn, place).inverse()


def run_trial(task: tuple[int, bool]) -> Outcome:
    """Calibrate one trial with and without poses; diagnose it if asked."""
    seed, diagnosed = task
    hidden = diagnosed and seed % 2 == 1
    case = draw_case(seed, hidden, diagnosed)
    alone = calibrate(case.table, 'kannala_brandt', (_LENS.width, _LENS.height))
    with_robot, found = calibrate_hand_eye(alone, case.table, case.poses)
    truth = case.truth
    z = np.concatenate(
        [
            found.camera.difference(truth.camera),
            found.target.difference(truth.target),
            [found.scale - truth.scale],
        ]
    )
    return Outcome(
        'viewpoint_shift' if hidden else '',
        (z / found.stderr).tolist(),
        _error(found.camera, truth.camera),
        {
            name: _error(_opencv(alone, case, method), truth.camera)
            for name, method in _OPENCV.items()
        },
        (found.noise_m / case.noise[0], found.noise_rad / case.noise[1]),
        (_ray_error(alone, case), _ray_error(with_robot, case)),
        _named(case, alone) if diagnosed else None,
    )


def _error(found: Pose, truth: Pose) -> tuple[float, float]:
    off = found.difference(truth)
    return float(np.linalg.norm(off[:3])), float(np.linalg.norm(off[3:]))


def _opencv(found: Calibration, case: Case, method: int) -> Pose:
    """Return the camera in the flange by OpenCV, from the poses of the calibration's views."""
    flange = Pose.stack([case.poses[i] for i in found.views.frame.tolist()])
    target = found.adjusted.pose.inverse()
    turn, place = cv2.calibrateHandEye(  # type: ignore[attr-defined,unused-ignore]
        list(flange.rotation),
        list(flange.position),
        list(target.rotation),
        list(target.position),
        method=method,
    )
    return Pose(np.asarray(turn, dtype=float), np.asarray(place, dtype=float).ravel())


def _ray_error(found: Calibration, case: Case) -> float:
    """Return the rms angle of a lens's rays at 0.5 m, rad, without a motion of its frame."""
    grid = np.stack(np.meshgrid(np.linspace(100, 1180, 19), np.linspace(60, 740, 13)), -1)
    uv = grid.reshape(-1, 2)
    near = np.linalg.norm(uv[:, None] - case.table.uv, axis=-1).min(axis=1)
    uv = uv[near < _NEAR]
    return 1e-3 * study.ray_error(found.adjusted.lens, case.lens, uv, (0.5,))


def _named(case: Case, found: Calibration) -> tuple[list[str], list[str], bool]:
    """Return the causes in the lens without and with poses, and whether the robot was told."""
    diagnoses = [
        diagnose(
            case.table,
            found.adjusted.lens,
            free_intrinsics=True,
            poses=poses,
            options=DiagnosisOptions(quick=True),
        )
        for poses in (None, case.poses)
    ]
    alone, with_poses = map(_lens_causes, diagnoses)
    return alone, with_poses, diagnoses[1].hand_eye is not None


def _lens_causes(found: Diagnosis) -> list[str]:
    return [
        cause.effect
        for cause in found.causes
        if cause.effect_class.stage not in ('target', 'pose', 'noise')
    ]


def write_results(outcomes: Sequence[Outcome], path: Path = study.RESULTS / 'hand_eye.md') -> None:
    """Write the page of the results."""
    clean = [one for one in outcomes if one.named is None]
    z = np.array([one.z for one in clean])
    inside = (np.abs(z) < stats.norm.ppf(0.975)).mean()
    rows = [('ours', *_median([one.ours for one in clean]))]
    rows += [
        (f'OpenCV, {name}', *_median([one.opencv[name] for one in clean])) for name in _OPENCV
    ]
    rays = np.array([one.rays for one in clean])
    noise = np.array([one.noise for one in clean])
    asked = [one for one in outcomes if one.named is not None]
    study.write_wrapped(
        path,
        [
            '# Cameras on robots',
            '',
            'Written by `make peers NAME=hand_eye`. A robot turns '
            'a camera of '
            f'1280 x 800 px ({_LENS.fx:.0f} px, Kannala-Brandt) before a board of {_COLUMNS} x '
            f'{_ROWS} corners, {_FRAMES} photographs, {_NOISE_PX} px of noise. Its poses '
            'are those of '
            'the flange, with noise of 0.1 to 0.4 mm and 0.02 to 0.08 deg an axis and a scale of '
            '0.05 %. OpenCV solves from the poses of our calibrated lens.',
            '',
            *study.table(
                f'{len(clean)} robots | place, mm | turn, deg',
                [
                    (name, f'{1e3 * place:.3f}', f'{np.degrees(turn):.4f}')
                    for name, place, turn in rows
                ],
            ),
            '',
            'Median errors of the camera in the flange.',
            '',
            f'- Of the {z.size} numbers of the transforms, {100 * inside:.1f} % lie '
            'within 1.96 of '
            'their standard errors; 95 % should.',
            f'- The estimated noise of the robot is {np.median(noise[:, 0]):.2f} (m) and '
            f'{np.median(noise[:, 1]):.2f} (rad) times the true one, median.',
            f'- The rays of the calibrated lens are off by {1e3 * np.median(rays[:, 0]):.3f} mrad '
            f"without the robot's poses, by {1e3 * np.median(rays[:, 1]):.3f} mrad with them "
            '(median).',
            '',
            *(_diagnosed_lines(asked) if asked else ()),
        ],
    )


def _median(errors: Sequence[tuple[float, float]]) -> Array:
    return np.asarray(np.median(np.array(errors), axis=0))


def _diagnosed_lines(asked: Sequence[Outcome]) -> list[str]:
    """Return what diagnoses with and without the poses found."""
    shown = [(one.hidden, *one.named) for one in asked if one.named is not None]
    return [
        f'`diagnose --quick`, {len(shown)} more robots, whose boards are bent by 0.1 to 0.3 mm, '
        f'with the poses and without; they are recognized as those of a robot in '
        f'{sum(told for *_, told in shown)}:',
        '',
        *study.table(
            ' | robots | a cause in the lens, without poses | with poses',
            [
                (
                    hidden or 'no hidden error',
                    len(mine),
                    sum(bool(one[1]) for one in mine),
                    sum(bool(one[2]) for one in mine),
                )
                for hidden in ('', 'viewpoint_shift')
                if (mine := [one for one in shown if one[0] == hidden])
            ],
        ),
        '',
    ]


def main(words: Sequence[str]) -> None:
    """Run the trials on all cores and write the page."""
    trials = int(words[0]) if words else TRIALS
    diagnosed = int(words[1]) if len(words) > 1 else DIAGNOSED
    todo = [(i, False) for i in range(trials)] + [(i, True) for i in range(diagnosed)]
    write_results(study.in_processes('robots', run_trial, todo, 2))


if __name__ == '__main__':
    main(sys.argv[1:])
