"""Image points of a scene from which the world departs in one way or several."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmark.studies.independent.camera import (
    Array,
    Pupil,
    behind_window,
    image_points,
    incidence,
    project,
)
from benchmark.studies.independent.scene import Scene, in_camera

Field = Callable[[Array], Array]
RIM = np.linspace(0, 2 * np.pi, 40, endpoint=False)


@dataclass(frozen=True)
class Departure:
    """Where the world departs from the simulation; what is None is as simulated.

    landmarks (N, 3): displacement, m.  flex (F, 6): twist of the right camera, rad and m.
    delay: s per observation, from image points (M, 2) and camera.  pupil: entrance of rays, m.
    window: thickness, m, and index.  profile: px added to h(θ).  focal (M, 2): factors of fx, fy.
    center (M, 2): px.  field: px added at image points (M, 2).  dot: radius of dots, m.
    lock: px added by the detector at image points.  spread: factor of the noise (M,).
    lattice: step of the written coordinates, px.  swaps (K, 2): rows that change landmarks.
    noise: draws noise of unit spread (M, 2).
    """

    landmarks: Array | None = None
    flex: Array | None = None
    delay: Callable[[Array], Array] | None = None
    pupil: Pupil | None = None
    window: tuple[float, float] | None = None
    profile: Callable[[Array], Array] | None = None
    focal: Array | None = None
    center: Array | None = None
    field: Field | None = None
    dot: float = 0.0
    lock: Field | None = None
    spread: Array | None = None
    lattice: float = 0.0
    swaps: Array | None = None
    noise: Callable[[np.random.Generator, int], Array] | None = None


def form(scene: Scene, departures: Sequence[Departure]) -> Array:
    """Return the image points (M, 2), px, without noise."""
    radius = max((d.dot for d in departures), default=0.0)
    world = scene.target.points[scene.landmark]
    world = world + sum(d.landmarks[scene.landmark] for d in departures if d.landmarks is not None)
    uv = _dots(scene, world, radius, departures) if radius else _points(scene, world, departures)
    for departure in departures:
        if departure.lock is not None:
            uv = uv + departure.lock(uv)
    return uv


def _points(scene: Scene, world: Array, departures: Sequence[Departure]) -> Array:
    flexes = [d.flex for d in departures if d.flex is not None]
    flex = np.sum(flexes, axis=0) if flexes else None
    delays = [d.delay for d in departures if d.delay is not None]
    uv = _lens(scene, in_camera(scene, world, np.zeros(len(world)), flex), departures)
    # A row's time depends on the row, which depends on the time.
    for _ in range(4 if delays else 0):
        delay = np.sum([draw(uv) for draw in delays], axis=0)
        uv = _lens(scene, in_camera(scene, world, delay, flex), departures)
    return uv


def _lens(scene: Scene, points: Array, departures: Sequence[Departure]) -> Array:
    windows = [d.window for d in departures if d.window is not None]
    pupils = [d.pupil for d in departures if d.pupil is not None]
    pupil = (lambda t, a: sum(p(t, a) for p in pupils)) if pupils else None
    if windows:
        theta, azimuth = behind_window(points, *windows[0])
    else:
        theta, azimuth = incidence(points, pupil)
    lens = scene.lens
    uv = image_points(lens, theta, azimuth) - [lens.cx, lens.cy]
    for d in departures:
        if d.profile is not None:
            uv += d.profile(theta)[:, None] * np.c_[np.cos(azimuth), np.sin(azimuth)]
        if d.focal is not None:
            uv *= d.focal
    for d in departures:
        if d.center is not None:
            uv += d.center
    uv += [lens.cx, lens.cy]
    return uv + sum(d.field(uv) for d in departures if d.field is not None)


def _dots(scene: Scene, world: Array, radius: float, departures: Sequence[Departure]) -> Array:
    """Return the centroids of the images of dots in the planes of their boards."""
    axes = scene.target.axes[scene.landmark]
    rim = np.stack(
        [
            _points(
                scene,
                world + radius * (np.cos(a) * axes[:, 0] + np.sin(a) * axes[:, 1]),
                departures,
            )
            for a in RIM
        ]
    )
    start = rim.mean(0)
    a, b = rim - start, np.roll(rim, -1, axis=0) - start
    cross = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return start + ((a + b) * cross[..., None]).sum(0) / (3 * cross.sum(0))[:, None]


def simulated(scene: Scene) -> Array:
    """Return the image points (M, 2) of the simulation: no departure at all."""
    world = scene.target.points[scene.landmark]
    return project(scene.lens, in_camera(scene, world, np.zeros(len(world))))


def observed(
    rng: np.random.Generator, scene: Scene, departures: Sequence[Departure], outliers: float
) -> tuple[Array, Scene]:
    """Return observed image points (M, 2), and the scene with the landmarks as they are named.

    Noise, outliers (a share `outliers` of the points), rounding and swapped names come last.
    """
    uv = form(scene, departures)
    count = len(uv)
    draws = [d.noise for d in departures if d.noise is not None]
    noise = draws[0](rng, count) if draws else rng.normal(size=(count, 2))
    spread = np.prod([d.spread for d in departures if d.spread is not None], axis=0)
    uv = uv + scene.noise * noise * np.broadcast_to(spread, count)[:, None]
    gross = rng.choice(count, round(outliers * count), replace=False)
    length = np.maximum(8 * scene.noise, np.exp(rng.uniform(np.log(3), np.log(30), len(gross))))
    towards = rng.uniform(0, 2 * np.pi, len(gross))
    uv[gross] += length[:, None] * np.c_[np.cos(towards), np.sin(towards)]
    for d in departures:
        if d.lattice:
            uv = np.round(uv / d.lattice) * d.lattice
    landmark = scene.landmark.copy()
    for d in departures:
        if d.swaps is not None:
            landmark[d.swaps[:, 0]], landmark[d.swaps[:, 1]] = (
                landmark[d.swaps[:, 1]],
                landmark[d.swaps[:, 0]],
            )
    return uv, replace(scene, landmark=landmark)
