"""The lens curves of the package: a new one is one class here and one line in its registry.

A distribution of the user's own adds curves by entry points in the groups
`fisheye_svp_ros.image_heights` and `fisheye_svp_ros.viewpoint_shifts`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.optics import formulas
from fisheye_svp_ros.optics.curve_base import ImageHeight, Trigonometric, ViewpointShift
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.optics.pinhole import BrownConrady, RationalPolynomial
from fisheye_svp_ros.registry import Registry

_SAMPLES = 512


@dataclass(frozen=True)
class Orthographic(Trigonometric):
    """h = f sin(theta)."""

    limit = np.pi / 2
    formula = staticmethod(formulas.orthographic)

    def angle(self, height: Array) -> Array:
        return np.arcsin(np.minimum(height, 1.0))


@dataclass(frozen=True)
class Equidistant(ImageHeight):
    """h = f theta."""

    formula = staticmethod(formulas.equidistant)

    def angle(self, height: Array) -> Array:
        return height

    def with_powers(self, powers: tuple[float, ...]) -> KannalaBrandt | None:
        return KannalaBrandt().with_powers(powers)


@dataclass(frozen=True)
class Equisolid(Trigonometric):
    """h = 2 f sin(theta / 2)."""

    formula = staticmethod(formulas.equisolid)

    def angle(self, height: Array) -> Array:
        return 2 * np.arcsin(np.minimum(height / 2, 1.0))


@dataclass(frozen=True)
class Stereographic(Trigonometric):
    """h = 2 f tan(theta / 2)."""

    formula = staticmethod(formulas.stereographic)

    def angle(self, height: Array) -> Array:
        return 2 * np.arctan(height / 2)


@dataclass(frozen=True)
class Perspective(ImageHeight):
    """h = f tan(theta): a pinhole, and any rectified image."""

    limit = np.pi / 2

    def value_and_slope(self, theta: Array) -> tuple[Array, Array]:
        height = np.tan(theta)
        return height, 1 + height * height

    def angle(self, height: Array) -> Array:
        return np.arctan(height)


@dataclass(frozen=True)
class KannalaBrandt(ImageHeight):
    """h = f (theta + k1 theta^3 + k2 theta^5 + k3 theta^7 + k4 theta^9).

    Source: Kannala and Brandt, PAMI 2006, eq. 6, with the factor f taken out (OpenCV's fisheye).
    """

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    coefficient_names = ('k1', 'k2', 'k3', 'k4')
    formula = staticmethod(formulas.kannala_brandt)

    @property
    def limit(self) -> float:
        # dh/dtheta is a polynomial in theta^2; its first positive root ends the monotone range.
        terms = np.array([9 * self.k4, 7 * self.k3, 5 * self.k2, 3 * self.k1, 1.0])
        # What makes no difference up to pi would only make numbers overflow.
        roots = np.roots(np.where(np.abs(terms) * np.pi ** np.arange(8, -1, -2) < 1e-15, 0, terms))
        real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
        return float(min(np.sqrt(real.min()), np.pi)) if real.size else np.pi

    def columns(self, theta: Array) -> Array:
        z = theta * theta
        return theta[..., None] * z[..., None] ** np.arange(1, 5)

    def with_powers(self, powers: tuple[float, ...]) -> KannalaBrandt | None:
        if len(powers) > len(self.coefficients):
            return None
        more = zip(self.coefficients, (*powers, 0.0, 0.0, 0.0, 0.0), strict=False)
        return KannalaBrandt(*(k + power for k, power in more))


@dataclass(frozen=True)
class Gennery(ViewpointShift):
    """s = s0 + (theta / sin(theta) - 1) (e0 + e1 theta^2 + e2 theta^4), all in m.

    Source: Gennery, IJCV 68(3), 2006 (CAHVORE); the entrance pupil moves this way when s0 = 0.
    """

    s0: float = 0.0
    e0: float = 0.0
    e1: float = 0.0
    e2: float = 0.0
    coefficient_names = ('s0', 'e0', 'e1', 'e2')
    formula = staticmethod(formulas.gennery)

    def columns(self, theta: Array) -> Array:
        growth = 1 / np.sinc(theta / np.pi) - 1
        z = theta * theta
        return np.stack([np.ones_like(theta), growth, growth * z, growth * z * z], axis=-1)


@dataclass(frozen=True)
class FlatPort(ViewpointShift):
    """s = d (1 - cos(theta) / sqrt(n^2 - sin(theta)^2)): a plane window square to the axis.

    d: thickness, m; n: refractive index relative to the medium on both sides.  Snell's law: the
    ray leaves the window parallel to itself, so the camera behind seems to stand s further ahead.
    """

    thickness: float
    refractive_index: float
    coefficient_names = ('thickness', 'refractive_index')
    lengths = ('thickness',)
    limit = np.pi / 2
    formula = staticmethod(formulas.flat_port)

    def columns(self, theta: Array) -> Array:
        cos, n = np.cos(theta), self.refractive_index
        root = np.sqrt(n * n - np.sin(theta) ** 2)
        return np.stack([1 - cos / root, self.thickness * cos * n / root**3], axis=-1)

    @classmethod
    def neutral(cls) -> FlatPort:
        return cls(0.0, 1.5)

    def check(self) -> str:
        index = self.refractive_index
        return '' if index > 1.0 else f'refractive_index is {index}; it must be above 1'


IMAGE_HEIGHTS: Registry[type[ImageHeight]] = Registry(
    'image_heights',
    {
        'orthographic': Orthographic,
        'equidistant': Equidistant,
        'equisolid': Equisolid,
        'stereographic': Stereographic,
        'perspective': Perspective,
        'kannala_brandt': KannalaBrandt,
        'brown_conrady': BrownConrady,
        'rational_polynomial': RationalPolynomial,
    },
    ImageHeight,
)

VIEWPOINT_SHIFTS: Registry[type[ViewpointShift]] = Registry(
    'viewpoint_shifts',
    {
        'gennery': Gennery,
        'flat_port': FlatPort,
    },
    ViewpointShift,
)


def kannala_brandt_equivalent(lens: Lens) -> Lens:
    """Return the SVP Kannala-Brandt lens nearest to the image-height curve of a lens.

    Exact where the lens is Kannala-Brandt or equidistant; otherwise the least-squares fit of the
    five odd powers of theta over the field of view.  Corrections have no place in it.
    """
    curve = lens.image_height
    bare = replace(lens.svp(), tangential=None, image_field=None, corrections={}, target={})
    exact = curve.with_powers(())
    if exact is not None:
        return replace(bare, image_height=exact)
    theta = np.linspace(0.0, lens.max_incidence, _SAMPLES)
    scale, fitted = fit_kannala_brandt(theta, curve.value_and_slope(theta)[0])
    return replace(bare, fx=lens.fx * scale, fy=lens.fy * scale, image_height=fitted)


def fit_kannala_brandt(theta: Array, height: Array) -> tuple[float, KannalaBrandt]:
    """Return the curve and its scale, by least squares, of image heights (N,) at angles (N,), rad.

    The angles ascend; the height is the scale times the curve.
    """
    powers, limit = np.arange(1, 10, 2), theta[-1]
    fitted = np.linalg.lstsq((theta / limit)[:, None] ** powers, height, rcond=None)[0]
    scale, *k = (fitted / limit**powers).tolist()
    return scale, KannalaBrandt(*(value / scale for value in k))
