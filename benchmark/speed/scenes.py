"""What all sides get: the same lenses, points, image points and starts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.optics.curves import kannala_brandt_equivalent
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.scene.observations import (
    Observations,
    Views,
    make_observations,
    views_of,
)
from fisheye_svp_ros.scene.rigs import rig

LANDMARKS = 33
NOISE_PX = 0.3
_SEED = 6
_GOLDEN = np.pi * (3 - np.sqrt(5))


class Scene(NamedTuple):
    """S views of one camera on landmarks (N, 3), m, of a lens; start (S,): near the answer."""

    lens: Lens
    landmarks: Array
    views: Views
    start: Pose


class StereoScene(NamedTuple):
    """V views of a flat board (N, 3), m, its grid (rows, columns), through two equal cameras.

    pose (V,): right camera in the world; rig: left camera in the right one; both are starts near
    the answer.
    """

    lens: Lens
    board: Array
    grid: tuple[int, int]
    spacing: float
    left: Views
    right: Views
    pose: Pose
    rig: Pose


def shift_lens() -> Lens:
    """Return an equidistant lens of 214 degrees with its viewpoint shift; mrcal has it too."""
    return load_lens(lens_path('fish214'))


def svp_lens() -> Lens:
    """Return the Kannala-Brandt lens that an SVP user of fish180 would be given."""
    return kannala_brandt_equivalent(load_lens(lens_path('fish180')))


def points(count: int, widest: float) -> Array:
    """Return points (count, 3), m, in the camera frame, up to an angle off the axis, rad."""
    rng = np.random.default_rng(_SEED)
    number = np.arange(count) + 0.5
    cos = 1 - (1 - np.cos(widest)) * number / count
    sin, turn = np.sqrt(1 - cos * cos), _GOLDEN * number
    direction = np.stack([sin * np.cos(turn), sin * np.sin(turn), cos], axis=-1)
    points: Array = direction * rng.uniform(0.3, 2.0, (count, 1))
    return points


def localization(lens: Lens, views: int, landmarks: int = LANDMARKS) -> Scene:
    """Return views of landmarks 0.3 to 2 m away, up to 65 degrees off the axis, with noise.

    All peers can do that much: OpenCV's fisheye ends below 90 degrees.
    """
    rng = np.random.default_rng(_SEED + 1)
    pose = Pose(
        rotation_from_vector(rng.uniform(-0.1, 0.1, (views, 3))),
        rng.uniform(-0.05, 0.05, (views, 3)),
    )
    return _seen_from(lens, pose, landmarks, rng)


def motion(lens: Lens, views: int) -> Scene:
    """Return views of the same landmarks from a camera that goes round a circle of 0.2 m."""
    turn = 2 * np.pi * np.arange(views) / views
    place = np.stack([np.cos(turn), np.sin(turn), np.sin(2 * turn)], axis=-1)
    pose = Pose(rotation_from_vector(0.1 * place), 0.1 * place)
    return _seen_from(lens, pose, LANDMARKS, np.random.default_rng(_SEED + 3))


def _seen_from(lens: Lens, pose: Pose, landmarks: int, rng: np.random.Generator) -> Scene:
    views = len(pose.position)
    known = points(landmarks, np.radians(65.0))
    uv = project(lens, pose.into_body(known)).uv + rng.normal(0, NOISE_PX, (views, landmarks, 2))
    start = pose.retract(rng.normal(0, 0.02, (views, 6)))
    return Scene(lens, known, views_of(known, uv), start)


def stereo(lens: Lens, views: int = 10, grid: tuple[int, int] = (3, 11)) -> StereoScene:
    """Return views of a flat board, 0.3 m away, through the paper's parallel rig, with noise."""
    rng = np.random.default_rng(_SEED + 2)
    spacing = 0.05
    row, column = (index.ravel() for index in np.indices(grid))
    board = spacing * np.stack([column, row, np.zeros(len(row))], axis=-1)
    pair = rig('parallel')
    middle = np.array([pair.position[0] / 2, 0.0, 0.3])  # ahead of the middle between the cameras
    turn = rotation_from_vector(rng.uniform(-0.4, 0.4, (views, 3)))
    place = middle + rng.uniform(-0.05, 0.05, (views, 3))
    pose = Pose(turn, board.mean(axis=0) - (turn @ place[..., None])[..., 0])
    left, right = (
        project(lens, each.into_body(board)).uv + rng.normal(0, NOISE_PX, (views, len(board), 2))
        for each in (pose.compose(pair), pose)
    )
    return StereoScene(
        lens,
        board,
        grid,
        spacing,
        views_of(board, left),
        views_of(board, right),
        pose.retract(rng.normal(0, 0.01, (views, 6))),
        pair.retract(rng.normal(0, 0.01, 6)),
    )


def on_board(frames: int, landmarks: int, cameras: int) -> tuple[Observations, tuple[str, ...]]:
    """Return what cameras side by side see of a flat board, 0.4 m wide, and their names."""
    rng, lens = np.random.default_rng(1), shift_lens()
    rows = 1 << (landmarks.bit_length() - 1) // 2
    y, x = np.mgrid[:rows, : landmarks // rows]
    board = 0.4 / rows * np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=-1)
    board -= board.mean(axis=0)
    frame, camera, point = np.indices((frames, cameras, landmarks)).reshape(3, -1)
    poses = Pose(
        rotation_from_vector(rng.uniform(-0.5, 0.5, (frames, 3))),
        rng.uniform([-0.2, -0.2, 0.3], [0.2, 0.2, 0.7], (frames, 3)),
    )
    seen = poses.take(frame).transform(board[point]) - camera[:, None] * [0.02, 0.0, 0.0]
    names = tuple(f'camera{i}' for i in range(cameras))
    uv = project(lens, seen).uv + rng.normal(0, 0.2, (len(seen), 2))
    return make_observations(frame, point, uv, board[point], camera=camera, cameras=names), names
