"""Images as other tools model them, and the Kannala-Brandt lens nearest to one.

A base height g(theta) (tan theta, theta, Mei's, ...) is stretched by polynomials of its square and
moved sideways: Brown and Conrady's p1, p2, numbered as OpenCV does, and thin prisms.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Effect, Scene
from fisheye_svp_ros.effects.forward import project_corrected
from fisheye_svp_ros.effects.image_effects import DecenteringEffect, SensorTiltEffect, SkewEffect
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.lens_formats.fields import MAX_NUMBER
from fisheye_svp_ros.optics.curve_base import ImageHeight, ViewpointShift
from fisheye_svp_ros.optics.curves import KannalaBrandt, Perspective, fit_kannala_brandt
from fisheye_svp_ros.optics.lens import Lens, field_of_view
from fisheye_svp_ros.optics.pinhole import BrownConrady, RationalPolynomial, TangentialDistortion
from fisheye_svp_ros.pose import identity
from fisheye_svp_ros.scene.observations import views_of

HeightFormula = Callable[[Array], Array]  # image height over f of the incidence angle

# In OpenCV's order; a thin prism and a tilt come last
_PRISM, _TILT = ('s1', 's2', 's3', 's4'), ('tau_x', 'tau_y')
OPENCV = ('k1', 'k2', 'p1', 'p2', 'k3', 'k4', 'k5', 'k6', *_PRISM, *_TILT)
# What programs call a distortion, without case and separators
_NAMES = {
    'equidistant': 'equidistant fisheye fisheye4 opencvfisheye kannalabrandt kannalabrandt4 '
    'kannalabrandt8 kb kb4 kb8 equi',
    'plumb_bob': 'plumbbob radtan radtan4 radtan5 radialtangential brown brownconrady '
    'opencvstandard standard',
    'rational_polynomial': 'rationalpolynomial rational radtan8',
}
# Of coefficients; with a thin prism 12, with a tilt 14
_COUNTS = {'plumb_bob': (0, 4, 5), 'rational_polynomial': (4, 5, 8, 12, 14)}
_LENGTHS = (5, 8, 12, 14)  # that OpenCV takes
_RTABMAP_FISHEYE = 6  # coefficients
_MODEL_OF = {name: model for model, names in _NAMES.items() for name in names.split()}
STATED_MODELS = tuple(_NAMES)  # as sensor_msgs/CameraInfo calls them
RADIAL_TERMS = 4  # radial coefficients that Kannala-Brandt has
_PINHOLE_TERMS, _PRISM_TERMS = 3, 2  # above and below the line, and of a prism, of OpenCV
_GRID, _STEPS = 600, 40  # angles of a curve; angles and azimuths of an image
_ANGLE_MARGIN = 1 - 1e-3  # of the angle at which a curve ends
_TOLERANCE = 0.01  # px, of a lens written in a form that knows fewer curves


class Base(NamedTuple):
    """A curve, and the incidence angle, rad, up to which it holds."""

    height: HeightFormula
    limit: float


def omnidirectional(xi: float) -> Base:
    """Return Mei's heights (Mei and Rives, ICRA 2007); xi 0 is a pinhole."""

    def height(theta: Array) -> Array:
        return np.asarray(np.sin(theta) / (np.cos(theta) + xi))

    return Base(height, float(np.arccos(-xi if xi <= 1 else -1 / xi)) * _ANGLE_MARGIN)


def double_sphere(xi: float, alpha: float) -> Base:
    """Return the double sphere's heights (Usenko, Demmel, Cremers, 3DV 2018)."""

    def height(theta: Array) -> Array:
        z = np.cos(theta) + xi
        return np.asarray(np.sin(theta) / (alpha * np.hypot(np.sin(theta), z) + (1 - alpha) * z))

    return Base(height, np.pi * _ANGLE_MARGIN)


def unified_heights(alpha: float, beta: float) -> Base:
    """Return the heights of the extended unified model (Khomutenko et al., RA-L 2016)."""

    def height(theta: Array) -> Array:
        sin, cos = np.sin(theta), np.cos(theta)
        return np.asarray(sin / (alpha * np.sqrt(beta * sin**2 + cos**2) + (1 - alpha) * cos))

    return Base(height, np.pi * _ANGLE_MARGIN)


def field_of_view_model(omega: float) -> Base:
    """Return the heights of the FOV model (Devernay and Faugeras, MVA 2001); omega in rad."""

    def height(theta: Array) -> Array:
        return np.asarray(np.arctan(2 * np.tan(theta) * np.tan(omega / 2)) / omega)

    return PERSPECTIVE if not omega else Base(height, np.pi / 2 * _ANGLE_MARGIN)


def division(k: float) -> Base:
    """Return the heights of the division model (Fitzgibbon, CVPR 2001), of one coefficient."""

    def height(theta: Array) -> Array:
        slope = np.tan(theta)
        return np.asarray(2 * slope / (1 + np.sqrt(1 - 4 * k * slope**2)))

    return Base(height, np.pi / 2 * _ANGLE_MARGIN)


EQUIDISTANT = Base(np.asarray, np.pi)
EQUISOLID = Base(lambda theta: np.asarray(2 * np.sin(theta / 2)), np.pi * _ANGLE_MARGIN)
PERSPECTIVE = Base(np.tan, np.pi / 2 * (1 - 1e-6))


@dataclass(frozen=True)
class Distortion:
    """A base height, and what it is distorted by; coefficients of powers of its square.

    stretch, below: above and below the line of a ratio; tangential: p1, p2; growth: of these two;
    prism: along u, along v; late: what moves sideways starts from the stretched image; tilt: of
    the sensor, rad, as OpenCV has it, which only a lens of OpenCV's own model holds.
    """

    base: Base
    stretch: Sequence[float] = ()
    below: Sequence[float] = ()
    tangential: Sequence[float] = (0.0, 0.0)
    growth: Sequence[float] = ()
    prism: tuple[Sequence[float], Sequence[float]] = ((), ())
    late: bool = False
    tilt: tuple[float, float] = (0.0, 0.0)

    @property
    def is_kannala_brandt(self) -> bool:
        """Whether Kannala-Brandt has the same radial curve."""
        return (
            self.base is EQUIDISTANT
            and not any(self.below)
            and not any(self.stretch[RADIAL_TERMS:])
        )

    @property
    def sideways(self) -> bool:
        """Whether image points move otherwise than along the radius."""
        return any(self.tangential) or any(map(any, self.prism)) or any(self.tilt)

    @property
    def is_opencv(self) -> bool:
        """Whether OpenCV's pinhole models hold all of it."""
        beyond = [part[_PINHOLE_TERMS:] for part in (self.stretch, self.below)]
        beyond += [part[_PRISM_TERMS:] for part in self.prism]
        is_bent = any(map(any, beyond)) or any(self.growth) or (self.late and self.sideways)
        return self.base is PERSPECTIVE and not is_bent

    def height(self, theta: Array) -> Array:
        """Return the image height for unit focal length, of incidence angles, rad."""
        height = self.base.height(theta)
        above, below = (
            1 + _polynomial(coefficients, height * height)
            for coefficients in (self.stretch, self.below)
        )
        return np.asarray(height * (above / below))

    def image_points(self, theta: Array, azimuth: Array) -> Array:
        """Return image points (..., 2) for unit focal length."""
        around = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)
        stretched = self.height(theta)[..., None] * around
        plane = stretched if self.late else self.base.height(theta)[..., None] * around
        x, y = np.moveaxis(plane, -1, 0)
        z, (p1, p2) = x * x + y * y, self.tangential
        along_u, along_v = (_polynomial(coefficients, z) for coefficients in self.prism)
        grown = 1 + _polynomial(self.growth, z)
        return np.asarray(
            stretched
            + np.stack(
                [
                    (2 * p1 * x * y + p2 * (z + 2 * x * x)) * grown + along_u,
                    (p1 * (z + 2 * y * y) + 2 * p2 * x * y) * grown + along_v,
                ],
                axis=-1,
            )
        )


def _polynomial(coefficients: Sequence[float], z: Array) -> Array:
    """Return c1 z + c2 z^2 + ..."""
    return np.asarray(sum((c * z**i for i, c in enumerate(coefficients, start=1)), 0.0 * z))


def brown(base: Base, values: Mapping[str, float]) -> Distortion:
    """Return the distortion of coefficients by their names in OpenCV, see `OPENCV`.

    k4 to k6 stand below the line, as in OpenCV's rational model.
    """
    k1, k2, k3, *below = (values.get(f'k{i}', 0.0) for i in range(1, 7))
    p1, p2, s1, s2, s3, s4, tau_x, tau_y = (
        values.get(name, 0.0) for name in ('p1', 'p2', *_PRISM, *_TILT)
    )
    return Distortion(
        base, (k1, k2, k3), below, (p1, p2), (), ((s1, s2), (s3, s4)), tilt=(tau_x, tau_y)
    )


def opencv_distortion(d: Sequence[float], base: Base = PERSPECTIVE) -> Distortion:
    """Return the distortion of coefficients in OpenCV's order, by default of a pinhole."""
    return brown(base, dict(zip(OPENCV, d, strict=False)))


def stated_model(name: str) -> str | None:
    """Return the one of STATED_MODELS that a name in any notation means; None for another."""
    return _MODEL_OF.get(re.sub('[^a-z0-9]', '', name.lower()))


def stated_distortion(model: str, d: Sequence[float], where: str) -> Distortion:
    """Return the distortion of one of STATED_MODELS and its coefficients, in OpenCV's order.

    Raises LensError, naming `where`, for another number of coefficients than the model has.
    """
    if model == 'equidistant':
        # RTAB-Map has two zeros where p1 and p2 of a plumb_bob stand.
        k = (*d[:2], *d[4:]) if len(d) == _RTABMAP_FISHEYE and not any(d[2:4]) else d
        if len(k) < RADIAL_TERMS or any(k[RADIAL_TERMS:]):
            raise LensError(f'{where}: {model} has {len(d)} coefficients; k1 to k4 are needed')
        return Distortion(EQUIDISTANT, k[:RADIAL_TERMS])
    counts = _COUNTS[model]
    # A model may be stated without distortion, and carry zeros.
    if len(d) not in counts and any(d[counts[-1] :] or d):
        lengths = ' or '.join(str(count) for count in counts if count)
        raise LensError(f'{where}: {model} has {len(d)} coefficients; {lengths} are needed')
    return opencv_distortion(d)


def nearest_lens(
    name: str,
    size: Sequence[float],
    intrinsics: Sequence[float],
    distortion: Distortion,
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
        lens, worst = kannala_brandt_lens(name, size, (fx, fy, cx, cy), k, where), 0.0
    elif distortion.is_opencv:
        lens, worst = _opencv_lens(name, size, (fx, fy, cx, cy), distortion, where), 0.0
    elif any(distortion.tilt):
        raise LensError(f'{where}: a tilted sensor; it is known of pinhole models alone')
    else:
        lens, worst = fit_curve(
            name, size, (fx, fy, cx, cy), distortion.height, distortion.base.limit, where
        )
    if distortion.sideways and not distortion.is_opencv:
        lens, worst = _fit_corrections(lens, (fx, fy), distortion, worst)
    if skew:
        shear = SkewEffect().to_dict(np.array([skew / fx]))
        lens = replace(lens, corrections={**lens.corrections, SkewEffect.name: shear})
    return lens, worst


def _opencv_lens(
    name: str,
    size: Sequence[float],
    intrinsics: Sequence[float],
    distortion: Distortion,
    where: str,
) -> Lens:
    """Return the lens of a pinhole model of OpenCV; raise LensError where it is none."""
    above, below = distortion.stretch, distortion.below
    curve: ImageHeight = RationalPolynomial(*_pad(above), *_pad(below))
    if not any(below):
        curve = BrownConrady(*above) if any(above) else Perspective()
    bare = kannala_brandt_lens(name, size, intrinsics, [0.0] * RADIAL_TERMS, where)
    lens = replace(bare, image_height=curve)
    if distortion.sideways:
        along_u, along_v = (_pad(part, _PRISM_TERMS) for part in distortion.prism)
        values = (*distortion.tangential, *along_u, *along_v, *distortion.tilt)
        tangential = TangentialDistortion(*values)
        lens = replace(lens, tangential=tangential)
    if wrong := lens.check():
        raise LensError(f'{where}: {wrong}')
    return replace(lens, max_incidence=field_of_view(lens))


def _pad(coefficients: Sequence[float], count: int = _PINHOLE_TERMS) -> tuple[float, ...]:
    return (*coefficients, *[0.0] * count)[:count]


def camera_matrix(lens: Lens) -> Array:
    """Return the camera matrix (3, 3) of a lens, px, with its skew."""
    entry = lens.corrections.get(SkewEffect.name)
    skew = 0.0 if entry is None else SkewEffect.from_dict(entry, lens.name)[1][0] * lens.fx
    return np.array([[lens.fx, skew, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]])


def _fit_corrections(
    lens: Lens, focal: tuple[float, float], distortion: Distortion, worst: float
) -> tuple[Lens, float]:
    """Return a lens of the right curve with the corrections that move points sideways.

    focal: of the distorted image, px; worst: deviation of the curve, px.
    """
    theta, azimuth = np.meshgrid(
        np.linspace(0, lens.max_incidence, _STEPS)[1:], np.linspace(0, 2 * np.pi, _STEPS)
    )
    uv = distortion.image_points(theta, azimuth) * focal + (lens.cx, lens.cy)
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
    ideal = project_corrected(lens, points).uv
    scene = Scene(views_of(points[None], uv[None]), lens, identity(1), ideal[None])
    columns = np.concatenate([effect.columns(scene) for effect in effects], axis=-1)[0]
    solution = np.linalg.lstsq(
        columns.reshape(len(points) * 2, -1), (uv - ideal).ravel(), rcond=None
    )
    parts = np.split(solution[0], range(2, 2 * len(effects), 2))
    lens = replace(
        lens,
        corrections={
            effect.name: effect.to_dict(part) for effect, part in zip(effects, parts, strict=True)
        },
    )
    return lens, float(np.abs(project_corrected(lens, points).uv - uv).max())


def kannala_brandt_lens(
    name: str,
    size: Sequence[float],
    intrinsics: Sequence[float],
    k: Sequence[float],
    where: str,
    shift: ViewpointShift | None = None,
) -> Lens:
    """Build a lens: size (width, height); intrinsics fx, fy, cx, cy; raise LensError for none."""
    try:
        width, height, fx, fy, cx, cy = map(float, (*size, *intrinsics))
        curve = KannalaBrandt(*map(float, k))
    except (TypeError, ValueError, OverflowError) as cause:
        raise LensError(f'{where}: size, fx, fy, cx, cy or k1 to k4 are incomplete') from cause
    if not all(abs(value) < MAX_NUMBER for value in curve.coefficients):
        raise LensError(f'{where}: k1 to k4 are {curve.coefficients}; no real lens has these')
    if not (width.is_integer() and height.is_integer()):
        raise LensError(f'{where}: the image size is {width} x {height}; whole numbers are needed')
    lens = Lens(
        name,
        int(width),
        int(height),
        fx,
        fy,
        cx,
        cy,
        curve,
        np.nan,
        shift,
        calibration={'source': where},
    )
    wrong = lens.check()
    if wrong:
        raise LensError(f'{where}: {wrong}')
    return replace(lens, max_incidence=field_of_view(lens))


def fit_curve(
    name: str,
    size: Sequence[float],
    intrinsics: Sequence[float],
    curve: HeightFormula,
    limit: float,
    where: str,
    shift: ViewpointShift | None = None,
) -> tuple[Lens, float]:
    """Return the Kannala-Brandt lens nearest to a radial curve, and its worst deviation, px.

    limit: angle, rad, up to which the curve grows; no further than the image's corner is fitted.
    """
    try:
        width, height, fx, fy, cx, cy = map(float, (*size, *intrinsics))
    except (TypeError, ValueError, OverflowError) as cause:
        raise LensError(f'{where}: size, fx, fy, cx or cy are incomplete') from cause
    if not (np.isfinite([width, height, cx, cy, limit]).all() and 0 < min(fx, fy) < np.inf):
        raise LensError(f'{where}: image size or intrinsics are no valid numbers')
    corner = np.hypot(max(cx, width - cx) / fx, max(cy, height - cy) / fy)
    theta = np.linspace(0.0, limit, _GRID)[1:]
    heights = curve(theta)
    grows = np.concatenate([[True], np.diff(heights) > 0]) & np.isfinite(heights)
    inside = np.logical_and.accumulate(grows) & (heights <= corner)
    if inside.sum() < 20:
        raise LensError(f'{where}: the projection does not grow with the incidence angle')
    # Denser to the end, so that the worst deviation is near the least that there can be
    theta = theta[inside][-1] * np.sin(np.linspace(0.0, np.pi / 2, _GRID)[1:])
    heights = curve(theta)
    scale, fitted = fit_kannala_brandt(theta, heights)
    if not scale > 0:
        raise LensError(f'{where}: no fisheye curve fits the projection')
    off = scale * fitted.value_and_slope(theta)[0] - heights
    worst = float(np.abs(off).max() * max(fx, fy))
    lens = kannala_brandt_lens(
        name,
        size,
        (scale * fx, scale * fy, cx, cy),
        fitted.coefficients,
        where,
        shift,
    )
    return replace(lens, max_incidence=min(lens.max_incidence, float(theta[-1]))), worst


def nearest_kannala_brandt(lens: Lens) -> Lens:
    """Return a lens as Kannala-Brandt; raise LensError where that is off by a hundredth px."""
    if isinstance(lens.image_height, KannalaBrandt):
        return lens
    value = lens.image_height.value_and_slope
    fitted, worst = fit_curve(
        lens.name,
        (lens.width, lens.height),
        (lens.fx, lens.fy, lens.cx, lens.cy),
        lambda theta: value(theta)[0],
        lens.max_incidence,
        lens.name,
        lens.viewpoint_shift,
    )
    if worst > _TOLERANCE:
        raise LensError(
            f'lens {lens.name!r}: its curve is {worst:.2g} px from any curve of this '
            'format; calibrate it as kannala_brandt'
        )
    return fitted


def coefficients(lens: Lens) -> list[float]:
    """Return k1 to k4 of a Kannala-Brandt lens."""
    return list(lens.image_height.coefficients)


def opencv_coefficients(lens: Lens) -> list[float]:
    """Return those of a pinhole lens in OpenCV's order: 5, 8, with a prism 12, with a tilt 14."""
    curve, sideways = lens.image_height, lens.tangential or TangentialDistortion()
    radial = dict(zip(curve.coefficient_names, curve.coefficients, strict=True))
    values = [{**radial, **sideways.values}.get(name, 0.0) for name in OPENCV]
    needed = max((i + 1 for i, value in enumerate(values) if value), default=0)
    return values[: next(count for count in _LENGTHS if count >= needed)]
