"""What real boards, frames and lenses have of their own, and what no catalogue holds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from benchmark.studies.independent.adjust import Free
from benchmark.studies.independent.camera import Array
from benchmark.studies.independent.formation import Departure, Field, form, simulated
from benchmark.studies.independent.scene import Scene

Rng = np.random.Generator


class Background(NamedTuple):
    """Departures, outliers as a share of the points, and rms of the parts over the noise."""

    departures: tuple[Departure, ...]
    outliers: float
    parts: dict[str, float]


def smooth(rng: Rng, length: float, dimensions: int = 2, values: int = 2) -> Field:
    """Return a random smooth field of unit variance and this length of correlation."""
    waves = rng.normal(size=(32, dimensions)) / length
    phase = rng.uniform(0, 2 * np.pi, 32)
    mix = rng.normal(size=(32, values)) * np.sqrt(2 / 32)
    return lambda x: np.cos(x @ waves.T + phase) @ mix


def per_frame(scene: Scene, fields: Sequence[Field], amount: float) -> Field:
    """Return the field that is another one in every frame."""

    def field(uv: Array) -> Array:
        moved = np.empty_like(uv)
        for frame in range(scene.frames):
            rows = scene.frame == frame
            moved[rows] = fields[frame](uv[rows])
        return amount * moved

    return field


def board_errors(rng: Rng, scene: Scene) -> Callable[[float], Departure]:
    """Landmarks are off on their own and along with their neighbors, in and out of the plane."""
    target, count = scene.target, len(scene.target.points)
    share = rng.uniform(0.2, 0.8)
    own = rng.normal(size=(count, 3))
    near = np.zeros((count, 3))
    for board in np.unique(target.board):
        on = target.board == board
        size = np.ptp(target.points[on], axis=0).max()
        near[on] = smooth(rng, size * rng.uniform(0.08, 0.25), 3, 3)(target.points[on])
    mixed = np.sqrt(share) * own + np.sqrt(1 - share) * near
    moved = np.einsum('nij,ni->nj', target.axes, mixed)
    return lambda a: Departure(landmarks=a * target.spacing * moved)


def frame_fields(rng: Rng, scene: Scene) -> Callable[[float], Departure]:
    """In every view the picture is stretched and bent a little: affine and quadratic."""
    cameras = 1 + (scene.rig is not None)
    bends = rng.normal(size=(scene.frames * cameras, 5, 2)) * rng.uniform(0.3, 1, (5, 1))
    middle = np.array([scene.lens.width, scene.lens.height]) / 2
    bend = bends[scene.frame * cameras + scene.camera]

    def field(uv: Array) -> Array:
        x, y = ((uv - middle) / middle[1]).T
        return np.einsum('mi,mij->mj', np.c_[x, y, x * x, x * y, y * y], bend)

    return lambda a: Departure(field=lambda uv: a * field(uv))


def static_fields(rng: Rng, scene: Scene) -> Callable[[float], Departure]:
    """Each camera has a smooth image field that no radial curve holds."""
    fields = [smooth(rng, scene.lens.height * rng.uniform(0.06, 0.25)) for _ in range(2)]
    return lambda a: Departure(
        field=lambda uv: a * np.where(scene.camera[:, None] == 0, fields[0](uv), fields[1](uv))
    )


PARTS = {'board': board_errors, 'frame': frame_fields, 'static': static_fields}


def draw_background(rng: Rng, scene: Scene, size: float, free: Free) -> Background:
    """Return a background that leaves an rms of `size` times the noise in each coordinate.

    What free poses and intrinsics take away does not count.  Its variance is shared at random
    among boards, frames and lens; up to size·2 % of the points are outliers besides.
    """
    if not size:
        return Background((), 0.0, {})
    nominal = simulated(scene)
    shares = dict(zip(PARTS, rng.dirichlet(np.full(len(PARTS), 1.5)), strict=True))
    draws = {name: part(rng, scene) for name, part in PARTS.items()}
    amounts = {}
    for name, draw in draws.items():
        step = 1e-3 if name == 'board' else 0.1
        unit = free.size(form(scene, [draw(step)]) - nominal) / step
        amounts[name] = size * scene.noise * np.sqrt(shares[name]) / unit
    departures = [draws[name](amounts[name]) for name in PARTS]
    all_together = free.size(form(scene, departures) - nominal)
    scale = size * scene.noise / all_together
    departures = tuple(draws[name](scale * amounts[name]) for name in PARTS)
    parts = {name: float(scale * size * np.sqrt(share)) for name, share in shares.items()}
    return Background(departures, float(rng.uniform(0, 0.02 * min(size, 1.0))), parts)
