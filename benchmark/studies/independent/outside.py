"""Ways to depart from a simulation that are in no catalogue."""

from __future__ import annotations

import numpy as np

from benchmark.studies.independent.background import per_frame, smooth
from benchmark.studies.independent.camera import Array
from benchmark.studies.independent.effects import Effect, Form, Rng, center_of, image_radius
from benchmark.studies.independent.formation import Departure
from benchmark.studies.independent.scene import Scene


def ripple(rng: Rng, scene: Scene) -> Form:
    """A static wave over the picture with a period of a tenth of its width."""
    phi, start = rng.uniform(0, 2 * np.pi, 2)
    wave = 2 * np.pi / (scene.lens.width / 10) * np.array([np.cos(phi), np.sin(phi)])
    turn = rng.uniform(0, 2 * np.pi)
    along = np.array([np.cos(turn), np.sin(turn)])
    return lambda a: Departure(field=lambda uv: a * np.sin(uv @ wave + start)[:, None] * along)


def dent(rng: Rng, scene: Scene) -> Form:
    """A local dent of the lens: rays are bent towards one place, or away from it."""
    radius, middle = image_radius(scene), center_of(scene)
    width = radius * rng.uniform(0.12, 0.25)
    angle, away = rng.uniform(0, 2 * np.pi), radius * rng.uniform(0.15, 0.45)
    place, sign = middle + away * np.array([np.cos(angle), np.sin(angle)]), rng.choice([-1, 1])

    def field(uv: Array) -> Array:
        arm = (uv - place) / width
        return sign * arm * np.exp(-0.5 * (arm**2).sum(1))[:, None]

    return lambda a: Departure(field=lambda uv: a * field(uv))


def wobble(rng: Rng, scene: Scene) -> Form:
    """Every frame has a smooth random image field of its own, as hot air makes it."""
    length = scene.lens.height * rng.uniform(0.15, 0.4)
    fields = [smooth(rng, length) for _ in range(scene.frames)]
    return lambda a: Departure(field=per_frame(scene, fields, a))


def walk(rng: Rng, scene: Scene) -> Form:
    """The detector errs by a random walk over the landmarks, the same in every picture."""
    steps = np.cumsum(rng.normal(size=(len(scene.target.points), 2)), axis=0)
    bias = (steps - steps.mean(0)) / steps.std()
    return lambda a: Departure(field=lambda uv: a * bias[scene.landmark])


def trefoil(rng: Rng, scene: Scene) -> Form:
    """A pinched element: three-fold astigmatism."""
    middle, radius, phi = center_of(scene), image_radius(scene), rng.uniform(0, 2 * np.pi)

    def field(uv: Array) -> Array:
        q = ((uv - middle) / radius) @ np.array([1, 1j])
        bent = np.conj(q) ** 2 * np.abs(q) * np.exp(1j * phi)
        return np.c_[bent.real, bent.imag]

    return lambda a: Departure(field=lambda uv: a * field(uv))


def heavy_tails(rng: Rng, scene: Scene) -> Form:
    """Noise after Student with 3 degrees of freedom, of the same standard deviation."""
    return lambda size: Departure(
        noise=lambda r, count: r.standard_t(3, size=(count, 2)) / np.sqrt(3)
    )


def blurred_frames(rng: Rng, scene: Scene) -> Form:
    """Noise is stronger in some frames than in others."""
    level = np.exp(0.7 * rng.normal(size=scene.frames))
    return lambda size: Departure(spread=level[scene.frame] ** size)


def two_colors(rng: Rng, scene: Scene) -> Form:
    """Every other landmark shines in another color, which the lens magnifies more."""
    odd = (np.arange(len(scene.target.points)) % 2 - 0.5)[scene.landmark]
    return lambda a: Departure(focal=1 + a * odd[:, None] * np.ones(2))


def stabilizer(rng: Rng, scene: Scene) -> Form:
    """The principal point swings with time, as a stabilizer moves the sensor."""
    times = scene.track.times - scene.track.times[0]
    swing = np.sin(rng.uniform(3, 8) * times + rng.uniform(0, 2 * np.pi))[scene.frame]
    towards = rng.normal(size=2)
    return lambda a: Departure(center=a * swing[:, None] * towards)


OUTSIDE: dict[str, Effect] = {
    'ripple': Effect('lens', 'px', 5.0, ripple),
    'dent': Effect('lens', 'px', 20.0, dent),
    'wobble': Effect('frame', 'px', 5.0, wobble),
    'walk': Effect('target', 'px', 5.0, walk),
    'trefoil': Effect('lens', 'px', 20.0, trefoil),
    'two_colors': Effect('target', '1', 0.05, two_colors),
    'stabilizer': Effect('frame', 'px', 25.0, stabilizer),
    'heavy_tails': Effect('noise', '1', 1.0, heavy_tails, direct=True),
    'blurred_frames': Effect('noise', '1', 1.0, blurred_frames, direct=True),
}
