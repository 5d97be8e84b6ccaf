"""Boards, lenses, image errors and windows that studies draw from chance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.optics.curves import Gennery, KannalaBrandt
from fisheye_svp_ros.optics.image_field import ImageField
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.scene.observations import Landmarks, Observations, make_observations
from fisheye_svp_ros.simulate.render import Print
from fisheye_svp_ros.simulate.simulation import simulate

WIDTH, HEIGHT = 1280, 800
FEW, FRAMES = (5, 9), (14, 19)  # photographs of a set: least number, and one more than the most
_WAVES, _LENGTHS = 4, (560.0, 1260.0)  # of each axis; px
_PITCH = 25.0  # px, of the spline that stands for the true warp

Rng = np.random.Generator
Seen = tuple[Index, Array]  # landmarks (N,) and their image points (N, 2)


def unit(rng: Rng, size: int) -> Array:
    """Return a random direction."""
    vector = rng.normal(size=size)
    return np.asarray(vector / np.linalg.norm(vector))


def surround_rig(count: int, radius: float) -> Pose:
    """Return cameras (count,) that look outward from a circle about y, m, in the first of them."""
    azimuth = 2 * np.pi * np.arange(count) / count
    turns = azimuth[:, None] * np.array([0.0, 1.0, 0.0])
    places = np.stack([np.sin(azimuth), np.zeros(count), np.cos(azimuth) - 1], axis=-1)
    return Pose(rotation_from_vector(turns), radius * places)


def directions(theta: Array | float, azimuth: Array | float) -> Array:
    """Return unit vectors (..., 3) at angles from z and about it, rad."""
    sin = np.sin(theta)
    return np.stack(
        np.broadcast_arrays(sin * np.cos(azimuth), sin * np.sin(azimuth), np.cos(theta)), axis=-1
    )


def facing(ahead: Array) -> Array:
    """Return the axes (3, 3), as columns, of a board whose normal points along a unit vector."""
    right = np.cross([0.0, 1.0, 0.0], ahead)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(ahead, right), ahead], axis=1)


def grid(columns: int, rows: int, spacing: float) -> Array:
    """Return the points (N, 3), m, of a flat board about its middle, row by row."""
    y, x = np.mgrid[:rows, :columns]
    flat = spacing * np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=-1)
    return np.asarray(flat - flat.mean(axis=0))


def as_table(seen: Sequence[Seen], points: Array, source: str = '') -> Observations:
    """Return what was seen of points (L, 3) in each frame as a table."""
    frame = np.repeat(np.arange(len(seen)), [len(ids) for ids, _ in seen])
    ids, uv = (np.concatenate(parts) for parts in zip(*seen, strict=True))
    return make_observations(frame, ids, uv, points[ids], source=source)


def draw_fields(
    lens: Lens, rng: Rng, count: int, bumps: int, widths: tuple[float, float]
) -> Callable[[Array, Index], Array]:
    """Draw smooth fields over the image of 1 px or so, of bumps; widths: over the image's.

    A field takes image points (F, N, 2) and the number (F,) of the field of each frame.
    """
    size = np.array([lens.width, lens.height])
    centers = rng.uniform(size=(count, bumps, 2)) * size
    width = rng.uniform(*widths, (count, bumps)) * size.max()
    heights = rng.normal(size=(count, bumps, 2))

    def field(uv: Array, which: Index) -> Array:
        off = uv[:, :, None] - centers[which][:, None]
        near = np.exp(-(off**2).sum(axis=-1) / 2 / width[which][:, None] ** 2)
        return np.asarray(np.einsum('fnb,fbd->fnd', near, heights[which]))

    return field


def angle_behind_window(
    radius: Array,
    z: Array,
    thickness: float,
    glass: float,
    distance: float = 0.0,
    medium: float = 1.0,
    origin: Callable[[Array], Array | float] = lambda angle: 0.0,
) -> Array:
    """Return the angles (...) of rays to points at a radius and z, m, through a pane across z.

    By bisection; glass, medium: refractive indices; origin: where rays of an angle start, m.
    """
    low, high = np.zeros_like(z), np.full_like(z, np.pi / 2)
    for _ in range(60):
        angle = (low + high) / 2
        inside, beyond = (np.arcsin(np.sin(angle) / index) for index in (glass, medium))
        reached = (
            (distance - origin(angle)) * np.tan(angle)
            + thickness * np.tan(inside)
            + (z - distance - thickness) * np.tan(beyond)
        )
        low, high = np.where(reached < radius, angle, low), np.where(reached < radius, high, angle)
    return np.asarray(angle)


def draw_waves(rng: Rng, length: float, size: float) -> Callable[[Array], Array]:
    """Draw a smooth field: of image points (N, 2), px, of six waves of a length and size, px."""
    waves, phase = rng.uniform(-1, 1, (6, 2)) / length, rng.uniform(0, 2 * np.pi, 6)
    heights = size * rng.normal(size=(6, 2))
    return lambda uv: np.asarray(np.cos(uv @ waves.T + phase) @ heights)


def photographed(
    lens: Lens, printed: Print, points: Array, poses: Pose, noise: float, rng: Rng
) -> Observations:
    """Return what a lens sees of a board whose corners are at points (L, 3), not as printed."""
    seen = simulate(
        ForwardModel(lens), Landmarks(np.arange(len(points)), points), poses, noise, rng
    )
    return replace(seen, xyz=printed.corners[seen.landmark], sigma=np.full(len(seen), np.nan))


def draw_lens(rng: Rng) -> Lens:
    """Draw a lens; in one of three the viewpoint stands still."""
    k = rng.normal(0, [0.02, 0.008, 0.002, 0.0004])
    shift = (
        0.0
        if rng.random() < 1 / 3
        else rng.choice([-1, 1], p=[0.2, 0.8]) * abs(rng.normal(0, 3e-3))
    )
    focal, (x, y) = rng.uniform(280, 380), rng.normal(0, 8, 2)
    lens = Lens(
        'truth',
        WIDTH,
        HEIGHT,
        focal,
        focal,
        WIDTH / 2 + x,
        HEIGHT / 2 + y,
        KannalaBrandt(*k),
        np.radians(rng.uniform(65, 92)),
    )
    if lens.image_height.limit < 1.1 * lens.max_incidence:
        return draw_lens(rng)
    return lens.with_shift(Gennery(0.0, shift, shift * rng.normal(0, 0.15)))


def image_points(lens: Lens, points: Array) -> tuple[Array, Array]:
    """Return image points (N, 2), px, and incidence angles (N,) of points (N, 3) by iteration."""
    e0, e1 = lens.viewpoint_shift.e0, lens.viewpoint_shift.e1  # type: ignore[union-attr]
    radius = np.hypot(*points[:, :2].T)
    theta = np.arctan2(radius, points[:, 2])
    for _ in range(60):
        shift = (theta / np.sin(theta) - 1) * (e0 + e1 * theta**2)
        theta = np.arctan2(radius, points[:, 2] - shift)
    k = lens.parameters
    height = lens.fx * sum((k[f'k{i}'] if i else 1.0) * theta ** (2 * i + 1) for i in range(5))
    return [lens.cx, lens.cy] + (height / radius)[:, None] * points[:, :2], theta


class BoardErrors(NamedTuple):
    """Whether a board is bent, and whether its landmarks are off."""

    bent: bool
    off: bool


def draw_set(
    seed: int,
    frames: tuple[int, int] = FEW,
    warp: Callable[[Array], Array] | None = None,
    errors: BoardErrors | None = None,
) -> tuple[Observations, Lens]:
    """Draw photographs of a board that may be bent, and the lens that took them.

    warp: displacements (N, 2), px, of image points (N, 2); errors: of the board, through a lens
    whose viewpoint stands still; None for landmarks that are off, a bend and a shift by chance.
    """
    rng = np.random.default_rng(seed)
    lens, count, noise = draw_lens(rng), int(rng.integers(*frames)), rng.uniform(0.03, 0.2)
    if errors is not None:
        lens = lens.with_shift(Gennery(0.0, 0.0))
    columns, rows = int(rng.integers(7, 11)), int(rng.integers(6, 9))
    flat = grid(columns, rows, rng.uniform(0.02, 0.035))
    u, v = flat[:, :2].T / flat.max()
    bend, may_bend = rng.normal(0, 4e-4, 3), rng.random() < 0.7
    offsets = rng.normal(0, 2.5e-5, flat.shape)
    bent, off = (may_bend, True) if errors is None else errors
    bend, true = bend * bent, flat + offsets * off
    true[:, 2] += bend @ [u * u, u * v, v * v]
    seen: list[Seen] = []
    while len(seen) < count:
        turned = rotation_from_vector(np.append(rng.uniform(-0.8, 0.8, 2), rng.uniform(-0.6, 0.6)))
        angle, azimuth = rng.uniform(0, 0.75 * lens.max_incidence), rng.uniform(0, 2 * np.pi)
        toward = rotation_from_vector(angle * np.array([-np.sin(azimuth), np.cos(azimuth), 0.0]))
        board = toward @ turned
        distance = np.exp(rng.uniform(np.log(0.08), np.log(0.35)))
        there = true @ board.T + distance * directions(angle, azimuth)
        uv, theta = image_points(lens, there)
        away = np.linalg.norm(there, axis=1)
        kept = (
            (theta < lens.max_incidence)
            & (uv > 3).all(axis=1)
            & (uv < [WIDTH - 4, HEIGHT - 4]).all(axis=1)
            & (away > 0.04)
            & (np.abs(there @ board[:, 2]) > 0.2 * away)
        )
        if kept.sum() >= 25:
            moved = uv[kept] if warp is None else uv[kept] + warp(uv[kept])
            seen.append((np.flatnonzero(kept), moved + rng.normal(0, noise, moved.shape)))
    return as_table(seen, flat, f'set {seed}'), lens


def draw_warp(rng: Rng, size: float) -> Callable[[Array], Array]:
    """Return a sum of waves in all directions, of so many px, rms of the 2-D displacement."""
    way = rng.uniform(0, 2 * np.pi, (2, _WAVES))
    number = 2 * np.pi / rng.uniform(*_LENGTHS, (2, _WAVES))
    wave = number[..., None] * np.stack([np.cos(way), np.sin(way)], axis=-1)
    phase = rng.uniform(0, 2 * np.pi, (2, _WAVES))

    def warp(uv: Array) -> Array:
        waves = np.sin(np.einsum('akj,...j->...ak', wave, uv) + phase).sum(axis=-1)
        return np.asarray(size / np.sqrt(_WAVES) * waves)

    return warp


def draw_warped_set(
    number: int, frames: tuple[int, int] = FRAMES
) -> tuple[Observations, Lens, float]:
    """Draw photographs, the lens that took them and the rms of its warp, px; 0 for even ones."""
    seed, warped = divmod(number, 2)
    rng = np.random.default_rng(10_000 + seed)
    size = float(np.exp(rng.uniform(*np.log([0.05, 0.4])))) * warped
    warp = draw_warp(rng, size)
    table, bare = draw_set(seed, frames, warp)
    low, pitch = np.full(2, -4 * _PITCH), np.full(2, _PITCH)
    shape = (int(HEIGHT / _PITCH) + 9, int(WIDTH / _PITCH) + 9, 2)
    nodes = ImageField(low, pitch, np.zeros(shape)).nodes
    field = ImageField.interpolate(low, pitch, warp(nodes))
    return table, replace(bare, image_field=field), size


def joined(tables: Sequence[Observations]) -> Observations:
    """Return tables of the same cameras as one."""
    names = ('frame', 'landmark', 'uv', 'xyz', 'camera', 'board', 't', 'sigma')
    return replace(
        tables[0],
        **{name: np.concatenate([getattr(one, name) for one in tables]) for name in names},
    )
