"""A hand-eye calibration in words and rows."""

from __future__ import annotations

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.pose import Pose, vector_from_rotation
from fisheye_svp_ros.solve.hand_eye import HandEye

HEADER = ('transform', 'x, mm', 'y, mm', 'z, mm', 'rx, deg', 'ry, deg', 'rz, deg')
_LARGE_SHARE = 0.5  # of the squares of all frames: such a pose is wrong
_MIN_FRAMES = 6
_MAX_SCALE = 2.0  # of lengths, either way: more is another unit, or the size of another board
_MIN_MM = 100.0  # such a factor, too large for a mistaken board, is that of mm


def hand_eye_sentence(found: HandEye) -> str:
    """Return how many poses there are, the noise of the robot, and the scale."""
    scale, error = found.scale, found.stderr[-1]
    return (f'{len(found.frame)} poses of the flange; noise of the robot '
            f'{1e3 * found.noise_m:.3f} mm and {np.degrees(found.noise_rad):.4f} deg an axis; '
            f'lengths of the target are {scale:.5f} ± {error:.5f} times those of the robot')


def hand_eye_rows(found: HandEye) -> list[tuple[str, ...]]:
    """Return both transforms as HEADER has them, each with its standard errors below it."""
    return [*_rows('camera in flange', found.camera, found.stderr[:6]),
            *_rows('target in base', found.target, found.stderr[6:12])]


def hand_eye_warnings(found: HandEye) -> list[str]:
    """Return what there is to say against the poses."""
    return [*_unit_warnings(found.scale), *_pose_warnings(found)]


def _unit_warnings(scale: float) -> list[str]:
    """Return that lengths of robot and target are in different units, if it seems so."""
    if 1 / _MAX_SCALE <= scale <= _MAX_SCALE:
        return []
    factor = max(scale, 1 / scale)
    longer = 'the poses' if scale < 1 else 'the target'
    likely = f': {longer} may be in mm' if factor > _MIN_MM else ''
    return [f'lengths of robot and target differ by a factor of {factor:.4g}{likely}; both are '
            'needed in m']


def _pose_warnings(found: HandEye) -> list[str]:
    noise = np.repeat((found.noise_m, found.noise_rad), 3)
    squares = ((found.residual / noise) ** 2).sum(axis=1)
    worst = int(np.argmax(squares))
    if len(squares) < _MIN_FRAMES or squares[worst] < _LARGE_SHARE * squares.sum():
        return []
    off, turn = np.linalg.norm(found.residual[worst].reshape(2, 3), axis=1)
    return [f'the pose of frame {found.frame[worst]} is {1e3 * off:.1f} mm and '
            f'{np.degrees(turn):.2f} deg off the others: correct it, or remove it from the poses']


def _rows(name: str, pose: Pose, stderr: Array) -> list[tuple[str, ...]]:
    turn = np.degrees(vector_from_rotation(pose.rotation))
    values = [*(f'{1e3 * value:.3f}' for value in pose.position),
              *(f'{value:.4f}' for value in turn)]
    errors = [*(f'± {1e3 * value:.3f}' for value in stderr[:3]),
              *(f'± {value:.4f}' for value in np.degrees(stderr[3:]))]
    return [(name, *values), ('', *errors)]
