"""What no catalogue holds: effects that must come out without a name, and what real data have.

Real data have local errors of target, frames and image of their own, which have no name.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from benchmark.studies.blind_scene import Hidden, Scene, World, centre_of, imaged
from benchmark.studies.boards import Rng, draw_fields
from fisheye_svp_ros.arrays import Array

_OUTLYING = 0.01  # at most so many points
_BUMPS = 12


def ripple(scene: Scene, rng: Rng) -> Hidden:
    """The lens is pinched in three places: radial, with the cosine of three times the azimuth."""
    phase = rng.uniform(0, 2 * np.pi)

    def change(m: Array) -> Array:
        radius = np.linalg.norm(m, axis=-1, keepdims=True)
        azimuth = np.arctan2(m[..., 1:], m[..., :1])
        return np.asarray(m * radius * np.cos(3 * azimuth + phase))

    return _warped(scene, change)


def wave(scene: Scene, rng: Rng) -> Hidden:
    """The sensor, or a cover on it, is wavy over a fraction of the image."""
    waves = rng.uniform(5.0, 9.0) * np.array([[1.0, 0.3], [-0.4, 1.0]])
    phase = rng.uniform(0, 2 * np.pi, 2)
    return _warped(scene, lambda m: np.sin(m @ waves.T + phase))


def outliers(scene: Scene, rng: Rng) -> Hidden:
    """A few coordinates scatter five times as much."""

    def scatter(theta: Array, amount: float, rng: Rng) -> Array:
        return np.where(rng.random((*theta.shape, 2)) < amount**2 / 24, 5.0, 1.0)

    return Hidden(0.5, scatter=scatter)


def wobble(scene: Scene, rng: Rng) -> Hidden:
    """A group of landmarks swings while the camera looks."""
    middle = scene.points[rng.integers(len(scene.points))]
    near = np.argsort(np.linalg.norm(scene.points - middle, axis=1))[: len(scene.points) // 6]
    swing = np.sin(rng.uniform(4, 12) * scene.times + rng.uniform(0, 2 * np.pi))[scene.frame]
    moves = np.zeros((len(swing), *scene.points.shape))
    moves[:, near] = swing[:, None, None] * rng.normal(size=3)
    return Hidden(1e-4, world=lambda w, a: replace(w, points=w.points + a * moves))


def colour(scene: Scene, rng: Rng) -> Hidden:
    """Every other landmark shines in another colour, which the lens magnifies more."""
    odd, centre = (scene.landmark % 2 - 0.5)[None, :, None], centre_of(scene.lens)
    return Hidden(1e-5, world=imaged(lambda uv, a: uv + a * odd * (uv - centre)))


def centre_swing(scene: Scene, rng: Rng) -> Hidden:
    """The principal point swings with time (a stabilised lens)."""
    swing = np.sin(rng.uniform(3, 8) * scene.times + rng.uniform(0, 2 * np.pi))[scene.frame]
    moves = swing[:, None, None] * rng.normal(size=2)
    return Hidden(0.01, world=imaged(lambda uv, a: uv + a * moves))


# Each with the variables of which the report should name one.
OUTSIDE: dict[str, tuple[Callable[[Scene, Rng], Hidden], frozenset[str]]] = {
    'ripple': (ripple, frozenset({'image'})),
    'wave': (wave, frozenset({'image', 'neighbour_correlation'})),
    'outliers': (outliers, frozenset({'outliers'})),
    'wobble': (wobble, frozenset({'frame', 'time', 'landmark'})),
    'colour': (colour, frozenset({'landmark'})),
    'centre_swing': (centre_swing, frozenset({'frame', 'time'})),
}


def _warped(scene: Scene, change: Callable[[Array], Array]) -> Hidden:
    centre, edge = centre_of(scene.lens), scene.lens.width / 2
    return Hidden(0.01, world=imaged(lambda uv, a: uv + a * change((uv - centre) / edge)))


def background(scene: Scene, rng: Rng) -> Callable[[World, float], World]:
    """Draw local errors; what it returns adds them, of an amount, to a world.

    Offsets of single landmarks, a smooth static field over the image and one of each frame, in
    parts that are drawn too.
    """
    parts = rng.dirichlet(np.ones(3))
    offsets = rng.normal(size=scene.points.shape) * parts[0]
    distance = np.median(np.linalg.norm(scene.points - scene.points.mean(axis=0), axis=1))
    static, framed = (
        draw_fields(scene.lens, rng, count, _BUMPS, (0.1, 0.4))
        for count in (1, int(scene.frame.max()) + 1)
    )

    def world(world: World, amount: float) -> World:
        moved = replace(world, points=world.points + amount * offsets * distance / scene.lens.fx)
        return moved.mapped(
            lambda uv: (
                uv
                + amount
                * (
                    parts[1] * static(uv, np.zeros(len(uv), dtype=np.int64))
                    + parts[2] * framed(uv, scene.frame)
                )
            )
        )

    return world


def with_outliers(given: Array, scene: Scene, rng: Rng) -> Array:
    """Return image points (S, N, 2) of which a random few lie 10 to 100 times the noise off."""
    few = rng.random(given.shape[:2]) < rng.uniform(0, _OUTLYING)
    turn = rng.uniform(0, 2 * np.pi, given.shape[:2])
    far = scene.noise * 10 ** rng.uniform(1, 2, given.shape[:2])
    return given + (few * far)[..., None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
