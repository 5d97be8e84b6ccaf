"""Rigs of four cameras all around: `python -m benchmark.rigs [TRIALS]`, `make rigs`.

Cameras of 180 degrees, 90 degrees apart, see a board between two of them and before each.  Each
trial is calibrated by ours (lenses, then rig) and by OpenCV 5's `calibrateMultiview`, which starts
at our lenses: without a start it refuses these views.  Writes docs/results/rigs.md.
"""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path
from time import process_time
from typing import NamedTuple

import cv2
import numpy as np
from scipy import stats

from benchmark.workers import in_processes
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.optics.curves import KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.scene.observations import Observations, make_observations
from fisheye_svp_ros.scene.rigs import surround_rig
from fisheye_svp_ros.solve.lens_calibration import calibrate
from fisheye_svp_ros.solve.rig_calibration import calibrate_rig
from fisheye_svp_ros.study.lens_trust import assess_lens, with_covariance

TRIALS = 60
_DOC = Path(__file__).parents[1] / 'docs' / 'results' / 'rigs.md'
_LENS = Lens('around', 1280, 800, 400.0, 400.0, 639.5, 399.5, KannalaBrandt(-0.01, 0.002),
             np.radians(90.0))
_CAMERAS = tuple(f'cam{i}' for i in range(4))
_RIG = surround_rig(4, 0.1)
_SEAMS, _FRAMES, _NOISE_PX = 32, 64, 0.2  # photographs between two cameras, all, px
_Y, _X = np.mgrid[:6, :9]
_BOARD = 0.05 * np.stack([_X.ravel() - 4.0, _Y.ravel() - 2.5, np.zeros(54)], axis=-1)


class Outcome(NamedTuple):
    """What came of a trial.

    z (18,): errors of three cameras over their standard errors; ours, opencv: rms errors of place,
    m, and turn, rad; seconds: of both.
    """

    z: list[float]
    ours: tuple[float, float]
    opencv: tuple[float, float]
    seconds: tuple[float, float]


def draw_points(seed: int) -> Array:
    """Return image points (C, F, 54, 2), px, NaN where a camera does not see the whole board."""
    rng = np.random.default_rng(seed)
    uv = np.full((4, _FRAMES, len(_BOARD), 2), np.nan)
    for frame in range(_FRAMES):
        azimuth = np.pi / 2 * (frame % 4) + (np.pi / 4 if frame < _SEAMS else 0.0)
        azimuth += rng.normal(0, 0.1 if frame < _SEAMS else 0.4)
        ahead = np.array([np.sin(azimuth), rng.normal(0, 0.2), np.cos(azimuth)])
        ahead /= np.linalg.norm(ahead)
        right = np.cross([0.0, 1.0, 0.0], ahead)
        right /= np.linalg.norm(right)
        turn = np.stack([right, np.cross(ahead, right), ahead], axis=1)
        turn = turn @ rotation_from_vector(rng.normal(0, 0.4, 3))
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
        frame, landmark, np.asarray(uv[camera, frame, landmark]), _BOARD[landmark], camera=camera,
        cameras=_CAMERAS, source='surround')


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
    between = process_time()
    theirs = _opencv(uv, list(lenses.values()))
    end = process_time()
    off = np.stack([rig.rig.take(i).difference(_RIG.take(i)) for i in range(1, 4)])
    stderr = np.sqrt(np.diagonal(rig.covariance, axis1=1, axis2=2))
    other = np.stack([theirs.take(i).difference(_RIG.take(i)) for i in range(1, 4)])
    return Outcome((off / stderr).ravel().tolist(), _sizes(off), _sizes(other),
                   (between - start, end - between))


def _sizes(off: Array) -> tuple[float, float]:
    place, turn = np.sqrt((off.reshape(3, 2, 3) ** 2).sum(axis=-1).mean(axis=0)).tolist()
    return place, turn


def _opencv(uv: Array, lenses: Sequence[Lens]) -> Pose:
    """Return the cameras in the first one by `cv2.calibrateMultiview`, started at lenses."""
    seen = np.isfinite(uv[..., 0]).all(axis=-1)
    used = np.flatnonzero(seen.any(axis=0))
    points = [[uv[camera, frame].astype(np.float32) if seen[camera, frame]
               else np.empty((0, 2), np.float32) for frame in used] for camera in range(4)]
    k = [np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]]) for lens in lenses]
    d = [np.array([[lens.parameters[f'k{i}']] for i in range(1, 5)]) for lens in lenses]
    *_, turns, places = cv2.calibrateMultiview(  # type: ignore[attr-defined,unused-ignore]
        [_BOARD.astype(np.float32)] * len(used), points, [(_LENS.width, _LENS.height)] * 4,
        seen[:, used].astype(np.uint8), np.full((4, 1), cv2.CALIB_MODEL_FISHEYE, np.uint8),
        k, d, None, None, flags=cv2.CALIB_USE_INTRINSIC_GUESS,
        flagsForIntrinsics=np.full((4, 1), cv2.CALIB_FIX_SKEW, np.int32))
    rotation = np.stack([cv2.Rodrigues(one)[0] for one in turns]).astype(float)
    return Pose(rotation, np.array(places, dtype=float).reshape(4, 3)).inverse()


def write_results(outcomes: Sequence[Outcome], path: Path = _DOC) -> None:
    """Write the page of the results."""
    z = np.array([one.z for one in outcomes])
    inside = (np.abs(z) < stats.norm.ppf(0.975)).mean()
    lines = [
        '# Rigs of four cameras', '',
        'Written by `python -m benchmark.rigs` (`make rigs`). Four cameras of 1280 x 800 px and '
        '180 deg stand 90 deg apart on a circle of 0.1 m. They photograph a board of 9 x 6 '
        f'corners: {_SEAMS} photographs between two cameras, {_FRAMES - _SEAMS} before one. '
        f'{_NOISE_PX} px of noise, unknown lenses, {len(outcomes)} trials. OpenCV '
        f'{cv2.__version__} is `cv2.calibrateMultiview` with fisheye models. It starts at our '
        'lenses, since it refuses these views without a start.', '',
        '| | place, mm | turn, deg | processor time, s |', '|---|---|---|---|',
    ]
    for name, errors, which in (('ours', [one.ours for one in outcomes], 0),
                                ('OpenCV', [one.opencv for one in outcomes], 1)):
        place, turn = np.median(np.array(errors), axis=0)
        took = np.median([one.seconds[which] for one in outcomes])
        lines.append(f'| {name} | {1e3 * place:.3f} | {np.degrees(turn):.4f} | {took:.1f} |')
    lines += ['', 'Medians of the rms errors of the other three cameras in the first one. OpenCV '
              'states no standard errors.', '',
              f'Of the {z.size} numbers of the transforms, {100 * inside:.1f} % lie within 1.96 '
              'of their standard errors. That is more than 95 %, since the errors of the lenses '
              'count every shape of the target that the data admit.', '']
    write_text(path, '\n'.join(textwrap.fill(line, 100, break_on_hyphens=False)
                               for line in lines))


if __name__ == '__main__':
    todo = list(range(int(sys.argv[1]) if len(sys.argv) > 1 else TRIALS))
    write_results(in_processes('rigs', run_trial, todo, 2))
