"""Calibration targets and the poses from which a camera looks at them."""

import numpy as np

from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.scene.observations import Landmarks


def plane():
    """Return a board of 9 x 7 landmarks, 30 mm apart."""
    x, y = np.meshgrid(np.arange(9), np.arange(7))
    points = 0.03 * np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=-1)
    return Landmarks(np.arange(len(points)), points)


def cube():
    """Return 60 landmarks scattered over a cube of 0.3 m."""
    points = np.random.default_rng(0).uniform(-0.15, 0.15, (60, 3))
    return Landmarks(np.arange(len(points)), points)


def poses_around(landmarks, frames, rng, *, widest, distance=(0.25, 0.8), tilt=40.0):
    """Return poses (frames,) of a camera that sees the target at up to `widest` rad of incidence.

    distance: m; tilt: how far the target may turn away from the camera about x and y, degrees.
    """
    incidence = widest * np.sqrt(rng.uniform(size=frames))
    azimuth = rng.uniform(0, 2 * np.pi, frames)
    gaze = np.stack(
        [
            np.sin(incidence) * np.cos(azimuth),
            np.sin(incidence) * np.sin(azimuth),
            np.cos(incidence),
        ],
        axis=-1,
    )
    x = np.cross([0.1, 1.0, 0.3], gaze)
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    facing = np.stack([x, np.cross(gaze, x), gaze], axis=-1)
    spin, turn = np.zeros((2, frames, 3))
    spin[:, 2] = rng.uniform(-np.pi, np.pi, frames)
    turn[:, :2] = np.radians(tilt) * rng.uniform(-1, 1, (frames, 2))
    rotation = facing @ rotation_from_vector(spin) @ rotation_from_vector(turn)
    target = Pose(rotation, rng.uniform(*distance, (frames, 1)) * gaze)
    centerd = Pose(np.broadcast_to(np.eye(3), (frames, 3, 3)), -landmarks.points.mean(axis=0))
    return target.compose(centerd).inverse()
