"""A rig of four cameras around a robot, and what they see of a board at the seams."""

from __future__ import annotations

import numpy as np

from benchmark.studies.boards import surround_rig
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.optics.curves import Gennery, KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.scene.observations import Observations, make_observations

LENS = Lens(
    'around',
    1280,
    800,
    400.0,
    400.0,
    639.5,
    399.5,
    KannalaBrandt(-0.01, 0.002),
    np.radians(95.0),
    Gennery(e0=0.004),
)
CAMERAS = tuple(f'cam{i}' for i in range(4))
RIG = surround_rig(4, 0.1)
_Y, _X = np.mgrid[:6, :9]
BOARD = 0.05 * np.stack([_X.ravel() - 4.0, _Y.ravel() - 2.5, np.zeros(54)], axis=-1)
NOISE = 0.2


def board_pose(azimuth: float, rng: np.random.Generator) -> Pose:
    """Return a board that faces the rig, in the first camera."""
    ahead = np.array([np.sin(azimuth), rng.normal(0, 0.15), np.cos(azimuth)])
    ahead /= np.linalg.norm(ahead)
    right = np.cross([0.0, 1.0, 0.0], ahead)
    right /= np.linalg.norm(right)
    turn = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    return Pose(turn @ rotation_from_vector(rng.normal(0, 0.3, 3)), rng.uniform(0.4, 0.8) * ahead)


def photographs(seed: int, seams: tuple[float, ...], frames: int = 40) -> Observations:
    """Return a board seen at some azimuths, deg, by all cameras that have twelve points of it."""
    rng, rows = np.random.default_rng(seed), []
    for frame in range(frames):
        azimuth = np.radians(seams[frame % len(seams)]) + rng.normal(0, 0.1)
        points = board_pose(azimuth, rng).transform(BOARD)
        for camera in range(4):
            image = project(LENS, RIG.take(camera).inverse().transform(points))
            seen = image.valid & ((image.uv > 0) & (image.uv < [1279, 799])).all(axis=1)
            rows += [
                (frame, i, camera, *image.uv[i], *BOARD[i])
                for i in np.flatnonzero(seen)
                if seen.sum() >= 12
            ]
    table = np.array(rows)
    uv = table[:, 3:5] + rng.normal(0, NOISE, (len(table), 2))
    return make_observations(
        table[:, 0], table[:, 1], uv, table[:, 5:], camera=table[:, 2], cameras=CAMERAS
    )
