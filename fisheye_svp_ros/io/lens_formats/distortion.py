"""Images that other tools stretch and move sideways, and the lens nearest to one.

A base height g(theta) (tan theta, theta, Mei's, ...) is stretched by polynomials of its square and
moved sideways: Brown and Conrady's p1, p2, numbered as OpenCV does, and thin prisms.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Effect, Scene
from fisheye_svp_ros.effects.forward import project
from fisheye_svp_ros.effects.image_effects import DecenteringEffect, SensorTiltEffect, SkewEffect
from fisheye_svp_ros.io.lens_formats import radial
from fisheye_svp_ros.io.lens_formats.radial import Base
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import identity
from fisheye_svp_ros.scene.observations import views_of

OPENCV = ('k1', 'k2', 'p1', 'p2', 'k3', 'k4', 'k5', 'k6')  # in its order
_STEPS = 40
RADIAL_TERMS = 4  # radial coefficients that Kannala-Brandt has


@dataclass(frozen=True)
class Distortion:
    """A base height, and what it is distorted by; coefficients of powers of its square.

    stretch, below: above and below the line of a ratio; tangential: p1, p2; growth: of these two;
    prism: along u, along v; late: what moves sideways starts from the stretched image.
    """

    base: Base
    stretch: Sequence[float] = ()
    below: Sequence[float] = ()
    tangential: Sequence[float] = (0.0, 0.0)
    growth: Sequence[float] = ()
    prism: tuple[Sequence[float], Sequence[float]] = ((), ())
    late: bool = False

    @property
    def is_kannala_brandt(self) -> bool:
        """Whether Kannala-Brandt has the same radial curve."""
        return self.base is radial.EQUIDISTANT and not any(self.below) and not any(
            self.stretch[RADIAL_TERMS:])

    @property
    def sideways(self) -> bool:
        """Whether image points move otherwise than along the radius."""
        return any(self.tangential) or any(map(any, self.prism))

    def height(self, theta: Array) -> Array:
        """Return the image height for unit focal length, of incidence angles, rad."""
        height = self.base.height(theta)
        return np.asarray(height * self._stretch(height * height))

    def project(self, theta: Array, azimuth: Array) -> Array:
        """Return image points (..., 2) for unit focal length."""
        around = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)
        stretched = self.height(theta)[..., None] * around
        plane = stretched if self.late else self.base.height(theta)[..., None] * around
        x, y = np.moveaxis(plane, -1, 0)
        z, (p1, p2) = x * x + y * y, self.tangential
        along_u, along_v = (_powers(coefficients, z) for coefficients in self.prism)
        grown = 1 + _powers(self.growth, z)
        return np.asarray(stretched + np.stack([
            (2 * p1 * x * y + p2 * (z + 2 * x * x)) * grown + along_u,
            (p1 * (z + 2 * y * y) + 2 * p2 * x * y) * grown + along_v], axis=-1))

    def _stretch(self, z: Array) -> Array:
        return np.asarray((1 + _powers(self.stretch, z)) / (1 + _powers(self.below, z)))


def _powers(coefficients: Sequence[float], z: Array) -> Array:
    """Return c1 z + c2 z^2 + ..."""
    return np.asarray(sum((c * z**i for i, c in enumerate(coefficients, start=1)), 0.0 * z))


def brown(base: Base, values: Mapping[str, float]) -> Distortion:
    """Return the distortion of coefficients by their names in OpenCV: k1 to k6, p1, p2.

    k4 to k6 stand below the line, as in OpenCV's rational model.
    """
    k1, k2, k3, *below = (values.get(f'k{i}', 0.0) for i in range(1, 7))
    return Distortion(base, (k1, k2, k3), below, (values.get('p1', 0.0), values.get('p2', 0.0)))


def nearest_lens(
    name: str, size: Sequence[float], intrinsics: Sequence[float], distortion: Distortion,
    where: str,
) -> tuple[Lens, float]:
    """Return the lens nearest to a distorted image, and its worst deviation, px; 0: none.

    size: width, height; intrinsics: fx, fy, cx, cy and, where there is one, the skew, px: u grows
    with v by so much as v grows by the focal length.
    Raises LensError, naming `where`, where there is none.
    """
    fx, fy, cx, cy, skew = (*intrinsics, 0.0)[:5]
    if distortion.is_kannala_brandt:
        k = (*distortion.stretch, *[0.0] * RADIAL_TERMS)[:RADIAL_TERMS]
        lens, worst = radial.kannala_brandt(name, size, (fx, fy, cx, cy), k, where), 0.0
    else:
        lens, worst = radial.fit_curve(name, size, (fx, fy, cx, cy), distortion.height,
                                    distortion.base.limit, where)
    if distortion.sideways:
        lens, worst = _fit_corrections(lens, (fx, fy), distortion, worst)
    if skew:
        shear = SkewEffect().to_dict(np.array([skew / fx]))
        lens = replace(lens, corrections={**lens.corrections, SkewEffect.name: shear})
    return lens, worst


def skew_of(lens: Lens) -> float:
    """Return the skew of a lens, px: element 0, 1 of a camera matrix."""
    entry = lens.corrections.get(SkewEffect.name)
    if entry is None:
        return 0.0
    return float(SkewEffect.from_dict(entry, lens.name)[1][0]) * lens.fx


def _fit_corrections(
    lens: Lens, focal: tuple[float, float], distortion: Distortion, worst: float
) -> tuple[Lens, float]:
    """Return a lens of the right curve with the corrections that move points sideways.

    focal: of the distorted image, px; worst: deviation of the curve, px.
    """
    theta, azimuth = np.meshgrid(np.linspace(0, lens.max_incidence, _STEPS)[1:],
                                 np.linspace(0, 2 * np.pi, _STEPS))
    uv = distortion.project(theta, azimuth) * focal + (lens.cx, lens.cy)
    sin = np.sin(theta)
    points = np.stack([sin * np.cos(azimuth), sin * np.sin(azimuth), np.cos(theta)], axis=-1)
    inside = ((uv >= 0) & (uv < (lens.width, lens.height))).all(axis=-1)
    if not inside.any():
        return lens, worst
    points, uv = points[inside], uv[inside]
    effects: list[Effect] = [DecenteringEffect()]
    if any(map(any, distortion.prism)):
        # A thin prism is both: (r^2, 0) = (3 x^2 + y^2, 2 x y) - 2 (x^2, x y).
        effects.append(SensorTiltEffect())
    ideal = project(lens, points).uv
    scene = Scene(views_of(points[None], uv[None]), lens, identity(1), ideal[None])
    columns = np.concatenate([effect.columns(scene) for effect in effects], axis=-1)[0]
    found = np.linalg.lstsq(columns.reshape(len(points) * 2, -1), (uv - ideal).ravel(), rcond=None)
    parts = np.split(found[0], range(2, 2 * len(effects), 2))
    lens = replace(lens, corrections={
        effect.name: effect.to_dict(part) for effect, part in zip(effects, parts, strict=True)})
    return lens, float(np.abs(project(lens, points).uv - uv).max())
