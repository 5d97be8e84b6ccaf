"""Image points of boards by a projection of their own, as data are that no lens explains.

Sound as they are; whoever calls changes focal length, center or camera from frame to frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fisheye_svp_ros.pose import rotation_from_vector
from fisheye_svp_ros.scene.observations import make_observations


@dataclass(frozen=True)
class Camera:
    """A Kannala-Brandt camera: focal length and center, px, coefficients, image size."""

    f: float = 310.0
    cx: float = 640.0
    cy: float = 480.0
    k: tuple[float, ...] = (-0.02, 0.003)
    size: tuple[int, int] = (1280, 960)

    def change(self, **values):
        """Return a camera with other values."""
        return replace(self, **values)

    def project(self, points):
        """Return image points (N, 2) of points (N, 3) in the camera frame."""
        r = np.hypot(points[:, 0], points[:, 1])
        theta = np.arctan2(r, points[:, 2])
        height = theta.copy()
        for i, k in enumerate(self.k):
            height += k * theta ** (2 * i + 3)
        return [self.cx, self.cy] + (self.f * height / np.maximum(r, 1e-12))[:, None] * points[
            :, :2
        ]


def board(columns=9, rows=6, square=0.03):
    """Return the corners (N, 3) of a chessboard, m."""
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    return np.column_stack([square * x.ravel(), square * y.ravel(), np.zeros(x.size)])


def draw_views(rng, points, frames, angle=0.9, near=0.2, far=0.45, tilt=0.5, bend=0.0):
    """Return landmarks (F, N, 3) in the camera frame, middles up to an angle off the axis.

    bend: rms, m, of a bend of the board about one axis, another one in each frame.
    """
    views = []
    middle = points.mean(axis=0)
    bends = np.random.default_rng(frames).normal(size=frames)
    shape = ((points[:, 0] - middle[0]) / np.ptp(points[:, 0])) ** 2
    shape = (shape - shape.mean()) / shape.std()
    for i in range(frames):
        off = angle * np.sqrt((i % frames + 0.5) / frames)
        around = 2.4 * i + rng.uniform(0, 0.5)
        to_axis = rotation_from_vector(off * np.array([-np.sin(around), np.cos(around), 0.0]))
        turn = rotation_from_vector(rng.uniform(-tilt, tilt, 3) * [1, 1, 2])
        place = to_axis @ [0.0, 0.0, rng.uniform(near, far)]
        bent = points - middle + np.outer(shape, [0, 0, bend * bends[i]])
        views.append(bent @ (to_axis @ turn).T + place)
    return np.array(views)


def observe(rng, cameras, views, points, noise=0.05, t=None):
    """Return the table of views (F, N, 3), a camera each, without points outside the image."""
    rows = []
    for frame, (camera, view) in enumerate(zip(cameras, views, strict=True)):
        uv = camera.project(view) + rng.normal(size=(len(view), 2)) * noise
        inside = (uv > 0).all(axis=1) & (uv < np.array(camera.size) - 1).all(axis=1)
        for landmark in np.flatnonzero(inside):
            rows.append((frame, landmark, uv[landmark], points[landmark]))
    frame, landmark, uv, xyz = (np.array(column) for column in zip(*rows, strict=True))
    return make_observations(frame, landmark, uv, xyz, t=None if t is None else t[frame])


def flawed(name, seed=0, frames=16, camera=None, noise=0.05, **views):
    """Return a table and the image size of a kind of data, by name."""
    rng = np.random.default_rng(seed)
    camera, points = camera or Camera(), board()
    if name == 'tiny board':
        points = board(6, 4, 0.02)
    cameras = [_camera_of(name, camera, i, frames, rng) for i in range(frames)]
    if name == 'central':
        views = {'angle': 0.05, 'near': 0.8, 'far': 1.2} | views
    if name == 'tiny board':
        views = {'angle': 0.5, 'near': 0.6, 'far': 0.9} | views
    table = observe(rng, cameras, draw_views(rng, points, frames, **views), points, noise)
    if name == 'v upwards':
        table = replace(table, uv=table.uv * [1, -1] + [0, camera.size[1] - 1])
    return table, cameras[0].size


def _camera_of(name, camera, i, frames, rng):
    """Return the camera of frame i."""
    share = i / (frames - 1)
    other = {'f': 0.97 * camera.f, 'cx': camera.cx + 1280, 'cy': camera.cy + 9}
    wide = {'size': (2560, 960)}
    return {
        'zoom alternates': lambda: camera.change(f=camera.f * (1 + 0.06 * (i % 2))),
        'zoom alternates little': lambda: camera.change(f=camera.f * (1 + 0.02 * (i % 2))),
        'zoom in groups': lambda: camera.change(f=camera.f * (1 + 0.06 * (2 * i >= frames))),
        'zoom drifts': lambda: camera.change(f=camera.f * (1 + 0.06 * share)),
        'autofocus': lambda: camera.change(f=camera.f * (1 + 0.02 * rng.normal())),
        'stabilizer': lambda: camera.change(
            cx=camera.cx + 8 * rng.normal(), cy=camera.cy + 8 * rng.normal()
        ),
        'stabilizer little': lambda: camera.change(
            cx=camera.cx + 3 * rng.normal(), cy=camera.cy + 3 * rng.normal()
        ),
        'two cameras in blocks': lambda: camera.change(
            **(other if 2 * i >= frames else {}), **wide
        ),
        'two cameras interleaved': lambda: camera.change(**(other if i % 2 else {}), **wide),
        'three cameras': lambda: camera.change(
            cx=camera.cx + (0, 25, -30)[i % 3],
            cy=camera.cy + (0, -20, 14)[i % 3],
            f=camera.f * (1, 1.03, 0.97)[i % 3],
        ),
        'two cameras of one kind': lambda: camera.change(
            **({'cx': camera.cx + 11, 'cy': camera.cy - 7, 'f': 1.01 * camera.f} if i % 2 else {})
        ),
    }.get(name, lambda: camera)()
