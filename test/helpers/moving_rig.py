"""A rig that moves before boards of the cameras' own, which stand still."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.scene.observations import Observations, make_observations
from helpers.surround import BOARD, CAMERAS, LENS, NOISE, RIG


def moving_rig(
    seed: int,
    frames: int = 16,
    turn: Sequence[float] = (0.35, 0.35, 0.35),
    move: float = 0.08,
    cameras: int = 4,
) -> tuple[Observations, list[Pose]]:
    """Return what the cameras see of a board each, all of one print, and where the boards stand.

    turn (3,), rad, and move, m: of the rig about each axis, at most.
    """
    rng, rows = np.random.default_rng(seed), []
    boards = [
        RIG.take(camera).compose(
            Pose(
                rotation_from_vector(rng.normal(0, 0.2, 3)),
                np.array([0.0, 0.0, rng.uniform(0.5, 0.7)]),
            )
        )
        for camera in range(cameras)
    ]
    for frame in range(frames):
        body = Pose(
            rotation_from_vector(rng.uniform(-1, 1, 3) * turn), rng.uniform(-move, move, 3)
        )
        for camera, board in enumerate(boards):
            place = body.compose(RIG.take(camera)).inverse()
            image = project(LENS, place.transform(board.transform(BOARD)))
            seen = image.valid & ((image.uv > 0) & (image.uv < [1279, 799])).all(axis=1)
            rows += [
                (frame, i, camera, *image.uv[i], *BOARD[i])
                for i in np.flatnonzero(seen)
                if seen.sum() >= 12
            ]
    table = np.array(rows)
    uv = table[:, 3:5] + rng.normal(0, NOISE, (len(table), 2))
    return make_observations(
        table[:, 0], table[:, 1], uv, table[:, 5:], camera=table[:, 2], cameras=CAMERAS[:cameras]
    ), boards
