"""A camera that swings before a board, and what a rolling shutter makes of that."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, rotation_from_vector

_TRIES = 500
_STEP = 1e-4  # s, between poses whose difference is the velocity
_EDGE, _SPACING = 8.0, 9.0  # px, from the image's edge and between corners


class Swing(NamedTuple):
    """Poses (P,) of the camera in the board's frame; twist (P, 6), m/s and rad/s, there."""

    poses: Pose
    twist: Array


def swing(lens: Lens, corners: Array, columns: int, t: Array, rng: np.random.Generator) -> Swing:
    """Return where a camera is at times t (P,), s, that sees the corners (N, 3) all the while."""
    for _ in range(_TRIES):
        phase = rng.uniform(0, 2 * np.pi, 7)
        turns = 2 * np.pi * rng.uniform(0.6, 1.2, 7) / t[-1]
        poses = _poses(corners.mean(axis=0), t, phase, turns)
        if _seen(lens, poses.into_body(corners), columns):
            later = _poses(corners.mean(axis=0), t + _STEP, phase, turns)
            return Swing(poses, later.difference(poses) / _STEP)
    raise RuntimeError('no path keeps the board in sight')


def _poses(middle: Array, t: Array, phase: Array, turns: Array) -> Pose:
    wave = np.sin(phase + turns * t[:, None])
    theta, azimuth = 0.65 + 0.45 * wave[:, 0], phase[0] + 2.0 * wave[:, 1]
    distance = 0.17 * np.exp(0.35 * wave[:, 2])
    across = np.stack([-np.sin(azimuth), np.cos(azimuth), 0 * azimuth], axis=-1)
    towards = rotation_from_vector(theta[:, None] * across)
    tilt = rotation_from_vector(np.pad(0.6 * wave[:, 3:5], ((0, 0), (0, 1))))
    roll = rotation_from_vector(np.outer(phase[6] + 0.8 * wave[:, 5], [0.0, 0.0, 1.0]))
    board = towards @ tilt @ roll
    place = distance[:, None] * towards[:, :, 2]
    return Pose(board, place - board @ middle).inverse()


def _seen(lens: Lens, points: Array, columns: int) -> bool:
    image = project(lens, points)
    if not image.valid.all():
        return False
    uv = image.uv
    grid = uv.reshape(len(uv), -1, columns, 2)
    steps = min(np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (1, 2))
    inside = (uv > _EDGE).all() and (uv < (lens.width - _EDGE, lens.height - _EDGE)).all()
    return bool(inside and steps > _SPACING)


def of_rows(lens: Lens, swung: Swing, points: Array, line_time: float) -> Array:
    """Return image points (P, N, 2), px, of points (N, 3) that rows see one after the other."""
    uv = project(lens, swung.poses.into_body(points)).uv
    for _ in range(4):
        time = line_time * (uv[..., 1:] - (lens.height - 1) / 2)
        turn = (
            rotation_from_vector(time * swung.twist[:, None, 3:]) @ (swung.poses.rotation[:, None])
        )
        off = points - swung.poses.position[:, None] - time * swung.twist[:, None, :3]
        uv = project(lens, (np.swapaxes(turn, -1, -2) @ off[..., None])[..., 0]).uv
    return np.asarray(uv)
