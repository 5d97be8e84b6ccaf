"""What a hidden effect is, and what several of them need."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from benchmark.blind_scene import World
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.optics.lens import Lens

Rng = np.random.Generator


def _same_world(world: World, amount: float) -> World:
    return world


def _no_scatter(theta: Array, amount: float, rng: Rng) -> Array | float:
    return 1.0


def _as_seen(uv: Array, amount: float, rng: Rng) -> Array:
    return uv


@dataclass(frozen=True)
class Hidden:
    """One effect with its structure drawn and its amount left open.

    start: an amount that would be small; largest: the largest that can be; lasting: whether other
    frames show the same; world: what really happens for an amount; scatter: factor (S, N, 1 or 2)
    on the noise; recorded: what the table gets, the amount in px; detail: the structure; truth:
    the values of the catalogue's parameters for an amount, where it has the same ones.
    """

    start: float = 1e-3
    largest: float = np.inf
    lasting: bool = True
    world: Callable[[World, float], World] = _same_world
    scatter: Callable[[Array, float, Rng], Array | float] = _no_scatter
    recorded: Callable[[Array, float, Rng], Array] = _as_seen
    detail: str = ''
    truth: Callable[[float], Mapping[str, float]] = field(default=lambda amount: {})

    @property
    def moves(self) -> bool:
        """Whether it moves image points, and not only their scatter or the table."""
        return self.world is not _same_world


def moved(moves: Array) -> Callable[[World, float], World]:
    """Move the landmarks along (N, 3), m for a unit amount."""
    return lambda world, amount: replace(world, points=world.points + amount * moves)


def unit(rng: Rng, size: int) -> Array:
    """Return a random direction."""
    vector = rng.normal(size=size)
    return np.asarray(vector / np.linalg.norm(vector))


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
