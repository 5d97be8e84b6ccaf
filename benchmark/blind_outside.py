"""Effects that no catalogue holds: they must come out as unexplained, without a name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from benchmark.blind_hidden import Hidden, Rng
from benchmark.blind_scene import Scene, World
from fisheye_svp_ros.arrays import Array


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
    odd = (scene.landmark % 2 - 0.5)[None, :, None]
    centre = np.array([scene.lens.cx, scene.lens.cy])
    return Hidden(1e-5, world=lambda w, a: w.mapped(lambda uv: uv + a * odd * (uv - centre)))


def centre_swing(scene: Scene, rng: Rng) -> Hidden:
    """The principal point swings with time (a stabilised lens)."""
    swing = np.sin(rng.uniform(3, 8) * scene.times + rng.uniform(0, 2 * np.pi))[scene.frame]
    moves = swing[:, None, None] * rng.normal(size=2)
    return Hidden(0.01, world=lambda w, a: w.mapped(lambda uv: uv + a * moves))


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
    lens = scene.lens
    centre, edge = np.array([lens.cx, lens.cy]), lens.width / 2

    def world(world: World, amount: float) -> World:
        return world.mapped(lambda uv: uv + amount * change((uv - centre) / edge))

    return Hidden(0.01, world=world)
