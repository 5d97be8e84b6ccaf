"""Random scenes for blind tests, what a camera really sees in them, and what may hide there.

The forward chain here is its own: poses at the instant of every point, exact geometry.  From the
package come the lens as it is handed over and its projection, rigid transforms and the table.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np

from benchmark.studies.boards import Rng, directions, facing
from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.optics.curves import Gennery, KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, identity, rotation_from_vector
from fisheye_svp_ros.scene.observations import Observations, make_observations

FRAMES = 30
NEAREST, FARTHEST = 0.25, 2.5  # m
_LENSES = ('fish180', 'fish214', 'kannala_brandt')
_NOISE = (0.05, 0.1, 0.2, 0.4)  # px
_EDGE = 0.04  # rad inside the edge of the field: a hidden effect throws no point out of it
_STEP = 0.1  # s between frames


@dataclass(frozen=True)
class Needs:
    """What a scene must have for an effect to show."""

    boards: bool = False
    stereo: bool = False
    fixed_intrinsics: bool = False
    window: bool = False

    def joined(self, other: Needs) -> Needs:
        """Return what both need."""
        return Needs(*(getattr(self, f.name) or getattr(other, f.name) for f in fields(self)))


class Trajectory(NamedTuple):
    """A smooth motion: sums of sines for place (m) and turn (rad), K waves of 6 components."""

    amplitude: Array
    frequency: Array
    phase: Array

    def at(self, t: Array) -> Pose:
        """Return the poses (...) of the rig's body in the world at instants (...), s."""
        waves = self.amplitude * np.sin(self.frequency * t[..., None, None] + self.phase)
        q = waves.sum(axis=-2)
        return Pose(rotation_from_vector(q[..., 3:]), q[..., :3])


@dataclass(frozen=True)
class Scene:
    """A scene of F frames, C cameras, N landmarks; views (S = F C) by frame, then camera.

    free: whether the intrinsics are; noise: px; stated: whether the table tells it; held_out (F,):
    frames that are not handed over at first; rig (C,): cameras in the body; seen (S, N).
    """

    lens: Lens
    free: bool
    noise: float
    stated: bool
    points: Array
    board: Index
    landmark: Index
    times: Array
    held_out: Mask
    trajectory: Trajectory
    rig: Pose
    seen: Mask

    @property
    def cameras(self) -> int:
        return len(self.rig.position)

    @property
    def frame(self) -> Index:
        """The frame (S,) of each view."""
        return np.repeat(np.arange(len(self.times)), self.cameras)

    @property
    def camera(self) -> Index:
        """The camera (S,) of each view."""
        return np.tile(np.arange(self.cameras), len(self.times))

    def world(self) -> World:
        """Return the world in which the lens and the table tell the truth."""
        return World(
            self.trajectory,
            self.rig.take(self.camera),
            self.times[self.frame],
            np.broadcast_to(self.points, (len(self.frame), *self.points.shape)),
            self.lens,
        )

    def table(self, uv: Array, held_out: bool = False) -> Observations:
        """Return image points (S, N, 2) as they are handed over: one of the two sets of frames."""
        chosen = self.seen & (self.held_out[self.frame] == held_out)[:, None]
        view, slot = np.nonzero(chosen)
        return make_observations(
            self.frame[view],
            self.landmark[slot],
            uv[view, slot],
            self.points[slot],
            camera=self.camera[view],
            board=self.board[slot],
            t=self.times[self.frame[view]],
            sigma=np.full(len(view), self.noise) if self.stated else None,
            cameras=('left', 'right') if self.cameras == 2 else ('',),
            source='blind',
        )


@dataclass(frozen=True)
class World:
    """What really happens; a hidden effect replaces one part.

    rig, times (S,): camera in the body and instant of each view; points (S, N, 3): where the
    landmarks are; optics: points in the camera to image points; mappings of image points;
    readout: s from the first row to the last; dots (N, K, 3): rims about the landmarks, m.
    """

    trajectory: Trajectory
    rig: Pose
    times: Array
    points: Array
    lens: Lens
    optics: Callable[[Lens, Array], Array] = lambda lens, points: project(lens, points).uv
    mappings: tuple[Callable[[Array], Array], ...] = ()
    readout: float = 0.0
    dots: Array | None = None

    def mapped(self, mapping: Callable[[Array], Array]) -> World:
        """Return the world with one more mapping of the image."""
        return replace(self, mappings=(*self.mappings, mapping))

    def image(self) -> Array:
        """Return the image points (S, N, 2), px, without noise; NaN for none."""
        if self.dots is None:
            return self._seen(self.points)
        rims = self.points[:, :, None] + self.dots
        corners = self._seen(rims.reshape(len(rims), -1, 3)).reshape(*rims.shape[:3], 2)
        return _area_centroid(corners)

    @property
    def places(self) -> Array:
        """Where the landmarks (S, N, 3) are in the cameras."""
        return self.in_camera(self.points, self.times[:, None])

    @property
    def angles(self) -> Array:
        """Incidence angles (S, N), rad."""
        places = self.places
        return np.asarray(np.arctan2(np.linalg.norm(places[..., :2], axis=-1), places[..., 2]))

    def in_camera(self, points: Array, t: Array) -> Array:
        """Return points (S, N, 3) in the cameras at instants (S, N) or (S, 1)."""
        body = self.trajectory.at(t)
        offset = (points - body.position)[..., None, :] @ body.rotation
        return (offset[..., 0, :] - self.rig.position[:, None]) @ self.rig.rotation

    def _seen(self, points: Array) -> Array:
        t = self.times[:, None]
        uv = self.optics(self.lens, self.in_camera(points, t))
        for _ in range(3 if self.readout else 0):
            t = self.times[:, None] + self.readout * (uv[..., 1] / self.lens.height - 0.5)
            uv = self.optics(self.lens, self.in_camera(points, t))
        for mapping in self.mappings:
            uv = mapping(uv)
        return uv


def _area_centroid(corners: Array) -> Array:
    """Centroids (S, N, 2) of polygons (S, N, K, 2), by the shoelace formula."""
    middle = corners.mean(axis=-2, keepdims=True)
    x, y = np.moveaxis(corners - middle, -1, 0)
    after_x, after_y = np.roll(x, -1, axis=-1), np.roll(y, -1, axis=-1)
    cross = x * after_y - after_x * y
    moments = np.stack([((x + after_x) * cross).sum(-1), ((y + after_y) * cross).sum(-1)], -1)
    return np.asarray(middle[..., 0, :] + moments / (3 * cross.sum(axis=-1))[..., None])


def draw_scene(rng: Rng, needs: Needs, held_out: bool = False, landmarks: int = 54) -> Scene:
    """Draw a scene that has what is needed, with frames in between to hold out if asked for.

    About 3000 numbers: a camera sees nearly all landmarks, two cameras half of them each.
    """
    while True:
        lens, free = _draw_lens(rng, needs)
        stereo = needs.stereo or rng.random() < 0.15
        boards = needs.boards or rng.random() < 0.5
        points, board = _boards(rng, landmarks) if boards else _cloud(rng, landmarks, lens)
        frames = FRAMES * 3 // 2 if held_out else FRAMES
        step = _STEP * FRAMES / frames
        times = np.cumsum(rng.uniform(0.8, 1.2, frames) * step)
        apart = np.arange(frames) % 3 == 1 if held_out else np.zeros(frames, dtype=bool)
        scene = Scene(
            lens,
            free,
            float(rng.choice(_NOISE)),
            bool(rng.integers(2)),
            points,
            board,
            np.sort(rng.choice(1000, len(points), replace=False)),
            times,
            apart,
            _draw_trajectory(rng),
            _draw_rig(rng, stereo),
            np.ones((frames * (1 + stereo), len(points)), dtype=bool),
        )
        seen = _visible(scene)
        if seen.mean() > 0.8:
            keep = 0.5 if stereo else 0.95
            seen &= rng.random(seen.shape) < keep
            if seen.sum(axis=1).min() >= 12:
                return replace(scene, seen=seen)


def _visible(scene: Scene) -> Mask:
    world = scene.world()
    distance, theta = np.linalg.norm(world.places, axis=-1), world.angles
    uv = world.image()
    size = np.array([scene.lens.width, scene.lens.height])
    inside = np.isfinite(uv).all(axis=-1) & (uv > 2).all(axis=-1) & (uv < size - 3).all(axis=-1)
    near = (distance > NEAREST) & (distance < FARTHEST)
    return np.asarray(inside & near & (theta < scene.lens.max_incidence - _EDGE))


def _draw_lens(rng: Rng, needs: Needs) -> tuple[Lens, bool]:
    """Return a lens and whether its intrinsics are free."""
    names = list(_LENSES)
    if needs.fixed_intrinsics:
        names.remove('kannala_brandt')
    if needs.window:
        names.remove('fish214')
    name = str(rng.choice(names))
    if name != 'kannala_brandt':
        lens = load_lens(lens_path(name))
        free = not needs.fixed_intrinsics and bool(rng.integers(2))
        return (lens.svp() if rng.integers(2) else lens), free
    f, k = rng.uniform(280, 420), rng.normal(size=4) * (0.03, 0.01, 0.004, 0.001)
    edge = rng.uniform(1.3, 1.5)
    curve = KannalaBrandt(*k)
    if curve.limit < edge + 0.2:
        return _draw_lens(rng, needs)
    size = int(2 * f * curve.value_and_slope(np.array(edge))[0]) + 20
    cx, cy = size / 2 + rng.uniform(-8, 8, 2)
    shift = Gennery(0.0, *(rng.normal(size=2) * (0.008, 0.003))) if rng.integers(2) else None
    return Lens(name, size, size, f, f, cx, cy, curve, edge, shift), True


def _draw_trajectory(rng: Rng) -> Trajectory:
    size = np.array([0.16, 0.16, 0.2, 0.3, 0.3, 0.7]) * rng.uniform(0.7, 1.2)
    share = rng.dirichlet(np.ones(3), size=6).T
    return Trajectory(
        share * size, rng.uniform(0.7, 2.5, (3, 6)), rng.uniform(0, 2 * np.pi, (3, 6))
    )


def _draw_rig(rng: Rng, stereo: bool) -> Pose:
    rig = identity(1 + stereo)
    if stereo:
        rig.position[1] = np.array([0.15, 0.0, 0.0]) + 0.005 * rng.normal(size=3)
        turn = np.array([0.0, -rng.uniform(-0.15, 0.15), 0.0]) + 0.01 * rng.normal(size=3)
        rig.rotation[1] = rotation_from_vector(turn)
    return rig


def _boards(rng: Rng, count: int) -> tuple[Array, Index]:
    """Return the points of three or four flat boards about the axis, and their labels."""
    boards = int(rng.integers(3, 5))
    across = 4 if boards == 4 else 5
    down = int(np.ceil(count / boards / across))
    grid = np.stack(np.meshgrid(np.arange(across), np.arange(down)), axis=-1).reshape(-1, 2)
    grid = (grid - grid.mean(axis=0)) / (across - 1)
    points, first = [], rng.uniform(0, 2 * np.pi)
    for number in range(boards):
        azimuth = first + 2 * np.pi * (number + rng.uniform(-0.25, 0.25)) / boards
        theta = rng.uniform(0.2, 0.95)
        gaze = directions(theta, azimuth)
        distance = np.exp(rng.uniform(np.log(0.5), np.log(1.9)))
        width = distance * rng.uniform(0.4, 0.9)
        # Facing the camera, then tilted.
        axes = facing(gaze) @ rotation_from_vector(rng.uniform(-0.6, 0.6, 3))
        points.append(distance * gaze + width * grid @ axes[:, :2].T)
    return np.concatenate(points), np.repeat(np.arange(boards), len(grid))


def _cloud(rng: Rng, count: int, lens: Lens) -> tuple[Array, Index]:
    """Return points all about the camera, on one rigid structure."""
    edge = np.cos(min(lens.max_incidence - 0.35, 1.35))
    cos, azimuth = rng.uniform(edge, 1.0, count), rng.uniform(0, 2 * np.pi, count)
    gaze = directions(np.arccos(cos), azimuth)
    distance = np.exp(rng.uniform(np.log(0.5), np.log(2.2), count))
    return gaze * distance[:, None], np.zeros(count, dtype=np.int64)


@dataclass(frozen=True)
class Hidden:
    """One effect with its structure drawn and its amount left open.

    start: an amount that would be small; largest: the largest that can be; lasting: whether other
    frames show the same; world: what really happens for an amount, where image points move;
    scatter: factor (S, N, 1 or 2) on the noise; recorded: what the table gets, the amount in px;
    detail: the structure; truth: the values of the catalogue's parameters for an amount, where
    it has the same ones.
    """

    start: float = 1e-3
    largest: float = np.inf
    lasting: bool = True
    world: Callable[[World, float], World] | None = None
    scatter: Callable[[Array, float, Rng], Array | float] | None = None
    recorded: Callable[[Array, float, Rng], Array] | None = None
    detail: str = ''
    truth: Callable[[float], Mapping[str, float]] = lambda amount: {}


def imaged(change: Callable[[Array, float], Array]) -> Callable[[World, float], World]:
    """Move image points, px: the change takes them and the amount, and returns where they are."""
    return lambda world, amount: world.mapped(lambda uv: change(uv, amount))


def moved(moves: Array) -> Callable[[World, float], World]:
    """Move the landmarks along (N, 3), m for a unit amount."""
    return lambda world, amount: replace(world, points=world.points + amount * moves)


def centre_of(lens: Lens) -> Array:
    """Return the principal point, px."""
    return np.array([lens.cx, lens.cy])


def focal_of(lens: Lens) -> Array:
    """Return the focal lengths along u and v, px."""
    return np.array([lens.fx, lens.fy])


def plane_of(points: Array) -> tuple[Array, Array]:
    """Return the centre and the axes (3, 3; rows, the normal last) of flat points."""
    centre = points.mean(axis=0)
    return centre, np.linalg.svd(points - centre)[2]
