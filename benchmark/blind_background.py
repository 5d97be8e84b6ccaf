"""What real data have of their own: local errors of target, frames and image that have no name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from benchmark.blind_hidden import Rng
from benchmark.blind_scene import Scene, World
from fisheye_svp_ros.arrays import Array

_OUTLYING = 0.01  # at most so many points
_BUMPS = 12


def background(scene: Scene, rng: Rng) -> Callable[[World, float], World]:
    """Draw local errors; what it returns adds them, of an amount, to a world.

    Offsets of single landmarks, a smooth static field over the image and one of each frame, in
    parts that are drawn too.
    """
    parts = rng.dirichlet(np.ones(3))
    offsets = rng.normal(size=scene.points.shape) * parts[0]
    distance = np.median(np.linalg.norm(scene.points - scene.points.mean(axis=0), axis=1))
    static = _field(scene, rng, 1)
    framed = _field(scene, rng, int(scene.frame.max()) + 1)

    def world(world: World, amount: float) -> World:
        moved = replace(world, points=world.points + amount * offsets * distance / scene.lens.fx)
        return moved.mapped(lambda uv: uv + amount * (
            parts[1] * static(uv, np.zeros(len(uv), dtype=np.int64))
            + parts[2] * framed(uv, scene.frame)
        ))

    return world


def _field(scene: Scene, rng: Rng, count: int) -> Callable[[Array, Array], Array]:
    """Draw smooth fields over the image, px: sums of bumps of random places and widths."""
    size = np.array([scene.lens.width, scene.lens.height])
    centres = rng.uniform(size=(count, _BUMPS, 2)) * size
    widths = rng.uniform(0.1, 0.4, (count, _BUMPS)) * size.max()
    heights = rng.normal(size=(count, _BUMPS, 2))

    def field(uv: Array, which: Array) -> Array:
        total = np.zeros_like(uv)
        for bump in range(_BUMPS):
            off = uv - centres[which, bump][:, None]
            near = np.exp(-(off**2).sum(axis=-1) / 2 / widths[which, bump][:, None] ** 2)
            total += near[..., None] * heights[which, bump][:, None]
        return total

    return field


def with_outliers(given: Array, scene: Scene, rng: Rng) -> Array:
    """Return image points (S, N, 2) of which a random few lie 10 to 100 times the noise off."""
    few = rng.random(given.shape[:2]) < rng.uniform(0, _OUTLYING)
    turn = rng.uniform(0, 2 * np.pi, given.shape[:2])
    far = scene.noise * 10 ** rng.uniform(1, 2, given.shape[:2])
    return given + (few * far)[..., None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
