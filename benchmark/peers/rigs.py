"""Rigs of four cameras all around: `make peers NAME=rigs`.

Cameras of 180 degrees, 90 degrees apart, see a board between two of them and before each.  Each
trial is calibrated by ours (lenses, then rig) and by OpenCV 5's `calibrateMultiview`, which starts
at our lenses: without a start it refuses these views.  multical and pycolmap start there too,
where .venv-rigs has them (`benchmark.peers.rig_peers`).  Then the cameras see a board each
while the rig moves.  Writes docs/results/rigs.md.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy import stats

from benchmark import study
from benchmark.studies.boards import facing, grid, surround_rig
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.optics.curves import KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.scene.observations import Observations, make_observations
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.lens_calibration import calibrate
from fisheye_svp_ros.solve.rig_calibration import RigCalibration, calibrate_rig
from fisheye_svp_ros.solve.rig_state import group_by_frame
from fisheye_svp_ros.study.trust import assess_lens, with_covariance

TRIALS = 60
_LENS = Lens(
    'around', 1280, 800, 400.0, 400.0, 639.5, 399.5, KannalaBrandt(-0.01, 0.002), np.radians(90.0)
)
_CAMERAS = tuple(f'cam{i}' for i in range(4))
_RIG = surround_rig(4, 0.1)
_SEAMS, _FRAMES, _NOISE_PX = 32, 64, 0.2  # photographs between two cameras, all, px
_MOVING, _TURN = 24, 0.35  # photographs of each camera, rad
_PEERS = Path(__file__).parents[2] / '.venv-rigs' / 'bin' / 'python'
_BOARD = grid(9, 6, 0.05)


class Outcome(NamedTuple):
    """What came of a trial.

    z (18,): errors of three cameras over their standard errors; errors: by whom, rms of place, m,
    and of turn, rad, and processor time, s; why: what kept a peer from an answer.
    """

    z: list[float]
    errors: dict[str, tuple[float, float, float]]
    why: dict[str, str]


def draw_points(seed: int) -> Array:
    """Return image points (C, F, 54, 2), px, NaN where a camera does not see the whole board."""
    rng = np.random.default_rng(seed)
    uv = np.full((4, _FRAMES, len(_BOARD), 2), np.nan)
    for frame in range(_FRAMES):
        azimuth = np.pi / 2 * (frame % 4) + (np.pi / 4 if frame < _SEAMS else 0.0)
        azimuth += rng.normal(0, 0.1 if frame < _SEAMS else 0.4)
        ahead = np.array([np.sin(azimuth), rng.normal(0, 0.2), np.cos(azimuth)])
        ahead /= np.linalg.norm(ahead)
        turn = facing(ahead) @ rotation_from_vector(rng.normal(0, 0.4, 3))
        board = Pose(turn, rng.uniform(0.4, 0.8) * ahead).transform(_BOARD)
        for camera in range(4):
            image = project(_LENS, _RIG.take(camera).inverse().transform(board))
            inside = (image.uv > 0) & (image.uv < (_LENS.width - 1, _LENS.height - 1))
            if image.valid.all() and inside.all():
                uv[camera, frame] = image.uv
    return uv + rng.normal(0, _NOISE_PX, uv.shape)


def as_table(uv: Array) -> Observations:
    """Return image points (C, F, N, 2) as a table."""
    camera, frame, landmark = np.nonzero(np.isfinite(uv[..., 0]))
    return make_observations(
        frame,
        landmark,
        np.asarray(uv[camera, frame, landmark]),
        _BOARD[landmark],
        camera=camera,
        cameras=_CAMERAS,
        source='surround',
    )


def run_trial(seed: int) -> Outcome:
    """Calibrate one trial by ours and by OpenCV."""
    uv = draw_points(seed)
    table, start = as_table(uv), process_time()
    lenses = {}
    for number, name in enumerate(_CAMERAS):
        rows = table.take(table.camera == number)
        found = calibrate(rows, 'kannala_brandt', (_LENS.width, _LENS.height), name=name)
        lens = found.adjusted.lens
        lenses[name] = with_covariance(lens, assess_lens(rows, lens, found.adjusted.names))
    rig = calibrate_rig(table, lenses, _CAMERAS)
    errors = {'ours': (*_sizes(rig.rig), process_time() - start)}
    start = process_time()
    theirs = _opencv(uv, list(lenses.values()))
    errors['OpenCV'] = (*_sizes(theirs), process_time() - start)
    why = {}
    for peer, answer in _peers(table, uv, list(lenses.values())).items():
        if 'why' in answer:
            why[peer] = answer['why']
        else:
            found = np.array(answer['rig'])
            errors[peer] = (*_sizes(Pose(found[:, :3, :3], found[:, :3, 3])), answer['seconds'])
    return Outcome(_z_scores(rig), errors, why)


def _z_scores(found: RigCalibration) -> list[float]:
    off = found.rig.difference(_RIG)[1:]
    return (off / np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))).ravel().tolist()


def run_moving(seed: int) -> list[float]:
    """Return the errors (18,) over their standard errors of cameras that see a board each."""
    rng = np.random.default_rng(seed)
    boards = [
        _RIG.take(camera).compose(
            Pose(
                rotation_from_vector(rng.normal(0, 0.2, 3)),
                np.array([0.0, 0.0, rng.uniform(0.5, 0.7)]),
            )
        )
        for camera in range(4)
    ]
    uv = np.full((4, _MOVING, len(_BOARD), 2), np.nan)
    for frame in range(_MOVING):
        body = Pose(
            rotation_from_vector(rng.uniform(-_TURN, _TURN, 3)), rng.uniform(-0.08, 0.08, 3)
        )
        for camera, board in enumerate(boards):
            place = body.compose(_RIG.take(camera))
            image = project(_LENS, place.inverse().transform(board.transform(_BOARD)))
            uv[camera, frame] = image.uv
    uv += rng.normal(0, _NOISE_PX, uv.shape)
    return _z_scores(calibrate_rig(as_table(uv), dict.fromkeys(_CAMERAS, _LENS), _CAMERAS))


def _sizes(rig: Pose) -> tuple[float, float]:
    off = rig.difference(_RIG)[1:]
    place, turn = np.sqrt((off.reshape(3, 2, 3) ** 2).sum(axis=-1).mean(axis=0)).tolist()
    return place, turn


def _peers(table: Observations, uv: Array, lenses: Sequence[Lens]) -> dict[str, Any]:
    """Return what the peers of .venv-rigs answer; they start where we do."""
    if not _PEERS.exists():
        return {}
    start = initial_state(group_by_frame(table), lenses[0], lenses[1:])
    with TemporaryDirectory() as folder:
        path = Path(folder, 'problem.npz')
        np.savez(
            path,
            uv=uv[:, table.frames],
            board=_BOARD,
            size=[_LENS.width, _LENS.height],
            lenses=[
                [one.fx, one.fy, one.cx, one.cy, *(one.parameters[f'k{i}'] for i in range(1, 5))]
                for one in lenses
            ],
            body=_matrices(start.pose),
            rig=_matrices(start.rig),
        )
        answer = subprocess.run(
            [_PEERS, Path(__file__).with_name('rig_peers.py')],
            input=f'{path}\n',
            capture_output=True,
            text=True,
            check=True,
        )
    return dict(json.loads(answer.stdout))


def _matrices(pose: Pose) -> Array:
    matrix = np.tile(np.eye(4), (*pose.shape, 1, 1))
    matrix[..., :3, :3], matrix[..., :3, 3] = pose
    return matrix


def _opencv(uv: Array, lenses: Sequence[Lens]) -> Pose:
    """Return the cameras in the first one by `cv2.calibrateMultiview`, started at lenses."""
    seen = np.isfinite(uv[..., 0]).all(axis=-1)
    used = np.flatnonzero(seen.any(axis=0))
    points = [
        [
            uv[camera, frame].astype(np.float32)
            if seen[camera, frame]
            else np.empty((0, 2), np.float32)
            for frame in used
        ]
        for camera in range(4)
    ]
    k = [np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]]) for lens in lenses]
    d = [np.array([[lens.parameters[f'k{i}']] for i in range(1, 5)]) for lens in lenses]
    *_, turns, places = cv2.calibrateMultiview(  # type: ignore[attr-defined,unused-ignore]
        [_BOARD.astype(np.float32)] * len(used),
        points,
        [(_LENS.width, _LENS.height)] * 4,
        seen[:, used].astype(np.uint8),
        np.full((4, 1), cv2.CALIB_MODEL_FISHEYE, np.uint8),
        k,
        d,
        None,
        None,
        flags=cv2.CALIB_USE_INTRINSIC_GUESS,
        flagsForIntrinsics=np.full((4, 1), cv2.CALIB_FIX_SKEW, np.int32),
    )
    rotation = np.stack([cv2.Rodrigues(one)[0] for one in turns]).astype(float)
    return Pose(rotation, np.array(places, dtype=float).reshape(4, 3)).inverse()


def write_results(
    outcomes: Sequence[Outcome],
    moving: Sequence[list[float]],
    path: Path = study.RESULTS / 'rigs.md',
) -> None:
    """Write the page of the results."""
    rows = []
    for name in dict.fromkeys(name for one in outcomes for name in one.errors):
        errors = np.array([one.errors[name] for one in outcomes if name in one.errors])
        place, turn, took = np.median(errors, axis=0)
        rows.append(
            [name, len(errors), f'{1e3 * place:.3f}', f'{np.degrees(turn):.4f}', f'{took:.1f}']
        )
    why = {f'{name}: {text}' for one in outcomes for name, text in one.why.items()}
    if not _PEERS.exists():
        why.add('multical, pycolmap: not installed (`make peers NAME=rigs`)')
    study.write_wrapped(
        path,
        [
            '# Rigs of four cameras',
            '',
            'Written by `make peers NAME=rigs`. Four cameras of 1280 x '
            '800 px and '
            '180 deg stand 90 deg apart on a circle of 0.1 m. They photograph a board of 9 x 6 '
            f'corners: {_SEAMS} photographs between two cameras, {_FRAMES - _SEAMS} before one. '
            f'{_NOISE_PX} px of noise, unknown lenses, {len(outcomes)} trials. OpenCV '
            f'{cv2.__version__} is `cv2.calibrateMultiview` with fisheye models; it, multical and '
            "pycolmap (COLMAP's bundle adjustment of a rig, OPENCV_FISHEYE, points "
            'known) start at '
            'our lenses, pycolmap at our start of the poses too.',
            '',
            *study.table(' | trials | place, mm | turn, deg | processor time, s', rows),
            '',
            'Medians of the rms errors of the other three cameras in the first one. The '
            'time of the others is without that of their start. Only ours states standard '
            'errors.',
            *(f'\nLeft out: {one}.' for one in sorted(why)),
            '',
            _within('the transforms', [one.z for one in outcomes]),
            '',
            '## A board for each camera',
            '',
            f'The same cameras, lenses known, see a board each, {_MOVING} photographs; the rig '
            f'turns by up to {np.degrees(_TURN):.0f} deg about each axis. '
            + _within('the transforms, from the motion of the rig,', moving),
            '',
        ],
    )


def _within(what: str, scores: Sequence[list[float]]) -> str:
    z = np.array(scores)
    inside = (np.abs(z) < stats.norm.ppf(0.975)).mean()
    return (
        f'Of the {z.size} numbers of {what} {100 * inside:.1f} % lie within 1.96 of their '
        'standard errors.'
    )


if __name__ == '__main__':
    todo = list(range(int(sys.argv[1]) if len(sys.argv) > 1 else TRIALS))
    write_results(
        study.in_processes('rigs', run_trial, todo, 2),
        study.in_processes('moving rigs', run_moving, todo, 2),
    )
