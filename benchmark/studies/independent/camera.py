"""A fisheye lens and the image of a point, after section 2 of the design."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
# Entrance points of rays (M, 3), m, from their incidence angles and azimuths (M,).
Pupil = Callable[[Array, Array], Array]

# Unit image height g(θ) and its slope; h = f·g.
HEIGHTS: dict[str, tuple[Callable[[Array], Array], Callable[[Array], Array]]] = {
    'orthographic': (np.sin, np.cos),
    'equidistant': (lambda t: 1.0 * t, np.ones_like),
    'equisolid': (lambda t: 2 * np.sin(t / 2), lambda t: np.cos(t / 2)),
    'stereographic': (lambda t: 2 * np.tan(t / 2), lambda t: np.cos(t / 2) ** -2),
    'kannala_brandt': (lambda t: 1.0 * t, np.ones_like),
}
TINY = 1e-12


@dataclass(frozen=True)
class Lens:
    """Image-height model with intrinsics in px; `k` is that of kannala_brandt, else empty."""

    model: str
    fx: float
    fy: float
    cx: float
    cy: float
    k: tuple[float, ...]
    width: int
    height: int
    theta_max: float

    def unit_height(self, theta: Array) -> Array:
        """Return h/f of incidence angles (M,), rad."""
        powers = sum(k * theta ** (2 * i + 3) for i, k in enumerate(self.k))
        return HEIGHTS[self.model][0](theta) + powers

    def slope(self, theta: Array) -> Array:
        """Return d(h/f)/dθ of incidence angles (M,), rad."""
        powers = sum((2 * i + 3) * k * theta ** (2 * i + 2) for i, k in enumerate(self.k))
        return HEIGHTS[self.model][1](theta) + powers


def incidence(points: Array, pupil: Pupil | None = None) -> tuple[Array, Array]:
    """Return incidence angle and azimuth (M,) of points (M, 3) in the camera frame.

    With a pupil that moves, r·cosθ − (Z − s(θ))·sinθ = 0 is solved by fixed-point steps, which
    shrink by about |s'|/range each.
    """
    theta, azimuth = _angles(points)
    if pupil is None:
        return theta, azimuth
    for _ in range(60):
        before = theta
        theta, azimuth = _angles(points - pupil(theta, azimuth))
        if np.abs(theta - before).max(initial=0.0) < 1e-14:
            break
    return theta, azimuth


def _angles(points: Array) -> tuple[Array, Array]:
    x, y, z = points.T
    return np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)


def behind_window(points: Array, thickness: float, index: float) -> tuple[Array, Array]:
    """Return incidence angle and azimuth (M,) of points seen through a plane window in air.

    The ray of angle θ covers r = (Z − T)·tanθ + T·tanθ', n·sinθ' = sinθ, on its way; the window of
    thickness T is normal to the axis.  Solved by Newton's method in q = sinθ.
    """
    theta, azimuth = _angles(points)
    r, z = np.hypot(points[:, 0], points[:, 1]), points[:, 2]
    q = np.sin(theta)
    for _ in range(50):
        air, glass = np.sqrt(1 - q * q), np.sqrt(index**2 - q * q)
        missing = r - (z - thickness) * q / air - thickness * q / glass
        slope = (z - thickness) / air**3 + thickness * index**2 / glass**3
        q = np.clip(q + missing / slope, 0.0, 1 - 1e-9)
    return np.arcsin(q), azimuth


def image_points(lens: Lens, theta: Array, azimuth: Array) -> Array:
    """Return the image points (M, 2), px, of rays."""
    g = lens.unit_height(theta)
    return np.stack(
        [lens.cx + lens.fx * g * np.cos(azimuth), lens.cy + lens.fy * g * np.sin(azimuth)], axis=1
    )


def project(lens: Lens, points: Array) -> Array:
    """Return the image points (M, 2), px, of points (M, 3) in the camera frame, as SVP has it."""
    return image_points(lens, *incidence(points))


def point_jacobian(lens: Lens, points: Array) -> Array:
    """Return d(u, v)/d(X, Y, Z), (M, 2, 3), px/m, of `project`."""
    x, y, z = points.T
    r = np.maximum(np.hypot(x, y), TINY)
    square = r * r + z * z
    theta = np.arctan2(r, z)
    g, slope = lens.unit_height(theta), lens.slope(theta)
    c, s = x / r, y / r
    radial = slope * z / square
    across = g / r
    rows = np.empty((len(points), 2, 3))
    rows[:, 0, 0] = radial * c * c + across * s * s
    rows[:, 0, 1] = rows[:, 1, 0] = (radial - across) * c * s
    rows[:, 1, 1] = radial * s * s + across * c * c
    rows[:, 0, 2] = -slope * r / square * c
    rows[:, 1, 2] = -slope * r / square * s
    return rows * np.array([lens.fx, lens.fy])[:, None]


def intrinsic_jacobian(lens: Lens, points: Array) -> Array:
    """Return d(u, v)/d(fx, fy, cx, cy, k…), (M, 2, 4 + len(k)), of `project`."""
    theta, azimuth = incidence(points)
    g, c, s = lens.unit_height(theta), np.cos(azimuth), np.sin(azimuth)
    rows = np.zeros((len(points), 2, 4 + len(lens.k)))
    rows[:, 0, 0], rows[:, 1, 1] = g * c, g * s
    rows[:, 0, 2] = rows[:, 1, 3] = 1.0
    for i in range(len(lens.k)):
        power = theta ** (2 * i + 3)
        rows[:, 0, 4 + i], rows[:, 1, 4 + i] = lens.fx * power * c, lens.fy * power * s
    return rows


def _draw_k(rng: np.random.Generator, theta_max: float) -> tuple[float, ...]:
    """Return k1…k4 at random, or as a fit to another image height has them."""
    other = str(rng.choice(list(HEIGHTS)))
    if other == 'kannala_brandt' or rng.random() < 0.4:
        return tuple(rng.normal(0, [0.03, 0.01, 0.003, 0.0005]).tolist())
    theta = np.linspace(0.02, theta_max, 80)
    powers = theta[:, None] ** np.array([3, 5, 7, 9])
    k = np.linalg.lstsq(powers, HEIGHTS[other][0](theta) - theta, rcond=None)[0]
    return tuple((k + rng.normal(0, [3e-3, 1e-3, 3e-4, 5e-5])).tolist())


def draw_lens(rng: np.random.Generator, model: str, widest: float) -> Lens:
    """Return a random lens of a model, with at most `widest` rad of incidence angle."""
    width, height = [(1280, 800), (1024, 1024), (1536, 1536), (1920, 1200), (640, 480)][
        rng.integers(5)
    ]
    limit = {'orthographic': 1.25, 'stereographic': 1.75}.get(model, 1.85)
    while True:
        theta_max = rng.uniform(1.05, min(widest, limit))
        k = _draw_k(rng, theta_max) if model == 'kannala_brandt' else ()
        lens = Lens(model, 1.0, 1.0, 0.0, 0.0, k, width, height, theta_max)
        if lens.slope(np.linspace(0, 1.08 * theta_max, 60)).min() > 0.2:
            break
    radius = rng.uniform(0.42, 0.62) * min(width, height)
    f = round(float(radius / lens.unit_height(np.array(theta_max))), 2)
    cx, cy = np.round((np.array([width, height]) - 1) / 2 + rng.uniform(-9, 9, 2), 2)
    return Lens(model, f, f, float(cx), float(cy), k, width, height, theta_max)
