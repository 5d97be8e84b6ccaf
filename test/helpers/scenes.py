"""Scenes for tests: boards before a moving camera or rig."""

from __future__ import annotations

import numpy as np

from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.pose import Pose, identity, rotation_from_vector
from fisheye_svp_ros.scene.observations import make_observations, views_of


def lens(name='fish214'):
    """Return one of the package's lenses without its shift."""
    return load_lens(lens_path(name)).svp()


def scene(rng, cameras=1, frames=24):
    """Return views and their true poses: three tilted boards, a smooth trajectory, 10 Hz."""
    points, board = [], []
    for number in range(3):
        grid = np.stack(np.meshgrid(np.arange(5), np.arange(4)), axis=-1).reshape(-1, 2) - 2
        flat = np.column_stack([grid * rng.uniform(0.06, 0.12), np.zeros(len(grid))])
        turn = rotation_from_vector(rng.normal(size=3) * 0.4)
        points.append(flat @ turn.T + [0.7 * (number - 1), rng.uniform(-0.3, 0.3), 0.1 * number])
        board += [number] * len(grid)
    t = 0.1 * np.arange(frames)
    phase, rate = rng.uniform(0, 6, (2, 6)), rng.uniform(1, 3, 6)
    path = np.sin(rate * t[:, None] + phase[0]) * [0.25, 0.25, 0.2, 0.2, 0.2, 0.5]
    path[:, 2] -= 0.75
    pose = Pose(rotation_from_vector(path[:, 3:]), path[:, :3])
    rig = identity(cameras)
    rig.position[1:] = [0.15, 0.0, 0.0]
    frame, camera = np.repeat(np.arange(frames), cameras), np.tile(np.arange(cameras), frames)
    place = pose.take(frame).compose(rig.take(camera))
    world = np.concatenate(points)
    views = views_of(world, np.zeros((len(frame), len(world), 2)))
    shape = views.board.shape
    return place, views._replace(
        board=np.broadcast_to(board, shape),
        frame=frame,
        camera=camera,
        t=np.broadcast_to(t[frame][:, None], shape),
    )


def observe(simulated, terms, pose, views, sigma, rng):
    """Return the table that a lens with effects would give, with Gaussian noise."""
    image = ForwardModel(simulated, terms).predict(pose, views)
    uv = image.uv + rng.normal(size=image.uv.shape) * sigma
    view, point = np.nonzero(image.valid)
    return make_observations(
        views.frame[view],
        views.landmark[view, point],
        uv[view, point],
        views.points[view, point],
        camera=views.camera[view],
        board=views.board[view, point],
        t=views.t[view, point],
        cameras=('left', 'right'),
    )
