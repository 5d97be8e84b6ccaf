"""A board that sags by its own weight, before a camera at rest."""

import numpy as np

from fisheye_svp_ros.effects.forward import project_corrected
from fisheye_svp_ros.pose import rotation_from_vector
from fisheye_svp_ros.scene.observations import make_observations
from helpers.water import AIR

FREE = ('fx', 'fy', 'cx', 'cy', 'k1', 'k2')


def photographs(seed, sag, bend=0.0, frames=16, noise=0.05, turn_while_read=0.0):
    """Return a board of 0.8 m, held at two edges before a camera at rest.

    sag: of its middle, m, by its own weight; bend: that stays; turn_while_read, rad: of the camera
    about each axis from the first to the last row of an image, another one in every frame.
    """
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(9) - 4.0, np.arange(6) - 2.5)
    board = 0.1 * np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=-1)
    middle = 1 - (board[:, 0] / 0.4) ** 2
    shown = []
    while len(shown) < frames:
        angle, azimuth = rng.uniform(0, 0.7), rng.uniform(0, 2 * np.pi)
        way = [np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)]
        turn = rotation_from_vector(rng.normal(size=3) * [0.5, 0.5, 0.3])
        off = (bend + sag * turn[1, 2]) * middle  # gravity is along y
        bent = board + np.outer(off, [0.0, 0.0, 1.0])
        points = bent @ turn.T + np.exp(rng.uniform(-0.7, 0.4)) * np.array(way)
        image = project_corrected(AIR, points)
        if turn_while_read:
            row = image.uv[:, 1:] / AIR.height - 0.5
            points = points + np.cross(row * rng.normal(0, turn_while_read, 3), points)
            image = project_corrected(AIR, points)
        seen = np.flatnonzero(
            image.valid
            & (image.uv > 0).all(axis=1)
            & (image.uv < [AIR.width, AIR.height]).all(axis=1)
        )
        if len(seen) > 0.8 * len(board):
            uv = image.uv[seen] + noise * rng.normal(size=(len(seen), 2))
            shown.append((np.full(len(seen), len(shown)), seen, uv, board[seen]))
    return make_observations(*map(np.concatenate, zip(*shown, strict=True)))
