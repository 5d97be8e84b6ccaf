"""Random scenes: a target, a camera or a rig that moves, and what is seen in each frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from benchmark.studies.independent.camera import Array, Lens, project

Index = NDArray[np.int64]


class Target(NamedTuple):
    """Landmarks (N, 3), m; of boards also board (N,), its axes (N, 3, 3) and local (N, 2) in ±1.

    Axes are rows: along, down, and into the board; `spacing` is that of neighbors, m.
    """

    kind: str
    points: Array
    board: Index
    axes: Array
    local: Array
    spacing: float
    half: float


@dataclass(frozen=True)
class Track:
    """Where the (left) camera is: centers (F, 3) and rotations camera to world, at times (F,)."""

    times: Array
    centers: Array
    turns: Rotation
    moving: bool

    def pose(self, frame: Index, delay: Array) -> tuple[Array, Rotation]:
        """Return centers (M, 3) and rotations of frames (M,), `delay` (M,) s later."""
        if not self.moving or not np.any(delay):
            return self.centers[frame], self.turns[frame]
        when = self.times[frame] + delay
        return (
            CubicSpline(self.times, self.centers)(when),
            RotationSpline(self.times, self.turns)(when),
        )


@dataclass(frozen=True)
class Scene:
    """All that is to be seen; frame, camera, landmark (M,) say what was."""

    lens: Lens
    fitted: bool
    noise: float
    target: Target
    track: Track
    rig: tuple[Rotation, Array] | None
    held: NDArray[np.bool_]
    frame: Index
    camera: Index
    landmark: Index

    @property
    def frames(self) -> int:
        """Number of frames, held-out ones included."""
        return len(self.held)


def in_camera(scene: Scene, points: Array, delay: Array, flex: Array | None = None) -> Array:
    """Return points (M, 3) of the world in the frames of the cameras that observe them.

    `flex` (F, 6) turns (rad) and moves (m) the right camera in each frame.
    """
    centers, turns = scene.track.pose(scene.frame, delay)
    local = turns.inv().apply(points - centers)
    if scene.rig is not None:
        right = scene.camera == 1
        turned = scene.rig[0].apply(local[right]) + scene.rig[1]
        if flex is not None:
            twist = flex[scene.frame[right]]
            turned = Rotation.from_rotvec(twist[:, :3]).apply(turned) + twist[:, 3:]
        local[right] = turned
    return local


def draw_board(rng: np.random.Generator) -> Target:
    """Return one flat board with its origin at the center, facing -z."""
    columns, rows = rng.integers(8, 13), rng.integers(6, 10)
    spacing = float(np.round(rng.uniform(0.02, 0.09), 4))
    local = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1).reshape(-1, 2)
    plane = (local - local.mean(0)) * spacing
    half = float(plane.max())
    count = len(local)
    return Target(
        'board',
        np.c_[plane, np.zeros(count)],
        np.zeros(count, np.int64),
        np.broadcast_to(np.eye(3), (count, 3, 3)),
        plane / half,
        spacing,
        half,
    )


def draw_cube(rng: np.random.Generator) -> Target:
    """Return boards on five inner faces of a box, or on three outer faces of a cube."""
    inside, n = rng.random() < 0.5, int(rng.integers(5, 8))
    half = float(rng.uniform(0.4, 1.0) if inside else rng.uniform(0.12, 0.4))
    grid = np.linspace(-0.8, 0.8, n)
    local = np.stack(np.meshgrid(grid, grid), -1).reshape(-1, 2)
    into = np.array([[0, 0, 1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], float)
    if not inside:
        into = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]], float)
    points, axes = [], []
    for normal in into:
        along = np.cross([0, 1, 0], normal) if abs(normal[1]) < 0.5 else np.array([1.0, 0, 0])
        frame = np.stack([along, np.cross(normal, along), normal])
        # Inner faces lie ahead along their normal; those of a solid cube face the other way.
        center = normal * half if inside else -normal * half
        points.append(center + half * local @ frame[:2])
        axes.append(np.broadcast_to(frame, (len(local), 3, 3)))
    board = np.repeat(np.arange(len(into)), len(local))
    return Target(
        'inner cube' if inside else 'outer cube',
        np.concatenate(points),
        board,
        np.concatenate(axes),
        np.tile(local / 0.8, (len(into), 1)),
        1.6 * half / (n - 1),
        half,
    )


def draw_world(rng: np.random.Generator) -> Target:
    """Return landmarks all around, 0.5 to 3 m away, without boards."""
    count = int(rng.integers(80, 180))
    towards = rng.normal(size=(count, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    points = np.round(towards * np.exp(rng.uniform(np.log(0.5), np.log(3), count))[:, None], 4)
    return Target(
        'world',
        points,
        np.full(count, -1),
        np.broadcast_to(np.eye(3), (count, 3, 3)),
        np.zeros((count, 2)),
        0.3,
        1.0,
    )


TARGETS = {'board': draw_board, 'cube': draw_cube, 'world': draw_world}


def _view(
    rng: np.random.Generator, target: Target, lens: Lens, calm: float
) -> tuple[Array, Rotation]:
    """Return one random camera center and rotation to world that sees the target."""
    half = target.half
    if target.kind == 'board':
        tilt = Rotation.from_rotvec([*rng.uniform(-0.75, 0.75, 2), 0])
        distance = 2 * half * np.exp(rng.uniform(np.log(0.3), np.log(1.2)))
        center = -distance * tilt.apply([0, 0, 1])
        aim = Rotation.align_vectors([-center / distance], [[0, 0, 1]])[0]
        off = 0.5 * lens.theta_max * rng.normal(0, 0.6, 2).clip(-1, 1)
    elif target.kind == 'inner cube':
        center = half * rng.uniform(-0.4, 0.4, 3)
        aim, off = Rotation.identity(), rng.uniform(-0.6, 0.6, 2)
    elif target.kind == 'outer cube':
        towards = -np.ones(3) + rng.uniform(-0.5, 0.5, 3)
        towards /= np.linalg.norm(towards)
        center = half * np.exp(rng.uniform(np.log(2.0), np.log(4.0))) * towards
        aim = Rotation.align_vectors([-towards], [[0, 0, 1]])[0]
        off = 0.5 * lens.theta_max * rng.normal(0, 0.6, 2).clip(-1, 1)
    else:
        center = rng.uniform(-0.25, 0.25, 3)
        aim = Rotation.identity() if calm < 1 else Rotation.random(random_state=rng)
        off = rng.uniform(-1, 1, 2)
    roll = Rotation.from_rotvec([0, 0, calm * rng.uniform(-np.pi, np.pi)])
    return center, aim * Rotation.from_rotvec([*off, 0]) * roll


def draw_track(
    rng: np.random.Generator, target: Target, lens: Lens, frames: int, moving: bool
) -> Track:
    """Return stills seconds apart, or a video along smooth curves, every fifth frame at random."""
    views = [
        _view(rng, target, lens, 0.15 if moving else 1.0)
        for _ in range(frames if not moving else frames // 5 + 3)
    ]
    centers = np.array([center for center, _ in views])
    turns = Rotation.concatenate([turn for _, turn in views])
    if not moving:
        times = np.cumsum(rng.uniform(2, 6, frames))
        return Track(times, centers, turns, moving)
    knots = np.arange(len(views)) * rng.uniform(0.8, 1.6)
    times = np.linspace(0.3 * knots[1], knots[-1] - 0.3 * knots[1], frames)
    return Track(
        times, CubicSpline(knots, centers)(times), RotationSpline(knots, turns)(times), moving
    )


def visible(lens: Lens, local: Array, facing: Array) -> NDArray[np.bool_]:
    """Return which points (M, 3) in the camera frame are seen; `facing` is the cosine (M,)."""
    theta = np.arctan2(np.hypot(local[:, 0], local[:, 1]), local[:, 2])
    uv = project(lens, local)
    inside = (uv > 4).all(1) & (uv < np.array([lens.width, lens.height]) - 5).all(1)
    near = np.linalg.norm(local, axis=1) > 0.05
    return inside & near & (theta < 0.98 * lens.theta_max) & (facing > 0.2)


def draw_scene(
    rng: np.random.Generator,
    lens: Lens,
    kind: str,
    *,
    fitted: bool,
    stereo: bool,
    moving: bool,
    noise: float,
) -> Scene | None:
    """Return a scene of 12 to 40 frames and a third more, held out; None if little is seen."""
    target = TARGETS[kind](rng)
    wanted = int(rng.integers(16, 53))
    track = draw_track(rng, target, lens, wanted, moving)
    rig = None
    if stereo:
        turn = Rotation.from_rotvec(rng.normal(0, 0.05, 3))
        rig = (turn, np.array([-rng.uniform(0.08, 0.2), *rng.normal(0, 0.005, 2)]))
    count, cameras = len(target.points), 2 if stereo else 1
    index = np.indices((wanted, cameras, count)).reshape(3, -1)
    scene = Scene(lens, fitted, noise, target, track, rig, np.zeros(wanted, bool), *index)
    local = in_camera(scene, target.points[index[2]], np.zeros(index.shape[1]))
    sight = target.points[index[2]] - track.centers[index[0]]
    cosine = np.einsum('ij,ij->i', sight, target.axes[index[2], 2])
    facing = cosine / np.linalg.norm(sight, axis=1) if kind != 'world' else np.ones(len(local))
    return _keep_seen(rng, scene, visible(lens, local, facing))


def _keep_seen(rng: np.random.Generator, scene: Scene, seen: NDArray[np.bool_]) -> Scene | None:
    """Drop views of fewer than 16 points and frames without a view, then hold out a quarter."""
    cameras = 1 + (scene.rig is not None)
    view = scene.frame * cameras + scene.camera
    seen &= (np.bincount(view, seen, scene.frames * cameras) >= 16)[view]
    views = np.bincount(np.unique(view[seen]) // cameras, minlength=scene.frames)
    good = views == cameras
    seen &= good[scene.frame]
    count = int(good.sum())
    if count < 16 or not 900 <= seen.sum() <= 4500:
        return None
    new, track = np.cumsum(good) - 1, scene.track
    kept = Track(track.times[good], track.centers[good], track.turns[good], track.moving)
    held = np.arange(count) % 4 == rng.integers(4)
    return Scene(
        scene.lens,
        scene.fitted,
        scene.noise,
        scene.target,
        kept,
        scene.rig,
        held,
        new[scene.frame[seen]],
        scene.camera[seen],
        scene.landmark[seen],
    )
