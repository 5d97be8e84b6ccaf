"""Radial curves of other tools, and the Kannala-Brandt lens nearest to them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.lens_formats.fields import MAX_NUMBER
from fisheye_svp_ros.optics.curve_base import ViewpointShift
from fisheye_svp_ros.optics.curves import KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens, field_of_view

Curve = Callable[[Array], Array]  # image height for unit focal length, of the incidence angle


class Base(NamedTuple):
    """A curve, and the incidence angle, rad, up to which it holds."""

    height: Curve
    limit: float


_GRID = 600
_ANGLE_MARGIN = 1 - 1e-3  # of the angle at which a curve ends
_TOLERANCE = 0.01  # px, of a lens written in a form that knows fewer curves


def kannala_brandt(
    name: str, size: Sequence[float], intrinsics: Sequence[float], k: Sequence[float],
    where: str, shift: ViewpointShift | None = None,
) -> Lens:
    """Build a Kannala-Brandt lens: size (width, height); intrinsics fx, fy, cx, cy.

    Raises LensError, naming `where`, where it is impossible.
    """
    try:
        width, height, fx, fy, cx, cy = map(float, (*size, *intrinsics))
        curve = KannalaBrandt(*map(float, k))
    except (TypeError, ValueError, OverflowError) as cause:
        raise LensError(f'{where}: size, fx, fy, cx, cy or k1 to k4 are incomplete') from cause
    if not all(abs(value) < MAX_NUMBER for value in curve.coefficients):
        raise LensError(f'{where}: k1 to k4 are {curve.coefficients}; no real lens has these')
    if not (width.is_integer() and height.is_integer()):
        raise LensError(f'{where}: the image size is {width} x {height}; whole numbers are needed')
    lens = Lens(name, int(width), int(height), fx, fy, cx, cy, curve, np.nan, shift,
                calibration={'source': where})
    wrong = lens.check()
    if wrong:
        raise LensError(f'{where}: {wrong}')
    return replace(lens, max_incidence=field_of_view(lens))


def fit_curve(
    name: str, size: Sequence[float], intrinsics: Sequence[float], curve: Curve, limit: float,
    where: str, shift: ViewpointShift | None = None,
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
    powers = theta[:, None] ** np.arange(1, 10, 2)
    scale, *rest = np.linalg.lstsq(powers, heights, rcond=None)[0].tolist()
    if not scale > 0:
        raise LensError(f'{where}: no fisheye curve fits the projection')
    worst = float(np.abs(powers @ [scale, *rest] - heights).max() * max(fx, fy))
    lens = kannala_brandt(name, size, (scale * fx, scale * fy, cx, cy),
                          [value / scale for value in rest], where, shift)
    return replace(lens, max_incidence=min(lens.max_incidence, float(theta[-1]))), worst


def nearest_kannala_brandt(lens: Lens) -> Lens:
    """Return a lens as Kannala-Brandt; raise LensError where that is off by a hundredth px."""
    if isinstance(lens.image_height, KannalaBrandt):
        return lens
    value = lens.image_height.value_and_slope
    found, worst = fit_curve(
        lens.name, (lens.width, lens.height), (lens.fx, lens.fy, lens.cx, lens.cy),
        lambda theta: value(theta)[0], lens.max_incidence, lens.name, lens.viewpoint_shift)
    if worst > _TOLERANCE:
        raise LensError(f'lens {lens.name!r}: its curve is {worst:.2g} px from any curve of this '
                        'format; calibrate it as kannala_brandt')
    return found


def coefficients(lens: Lens) -> list[float]:
    """Return k1 to k4 of a Kannala-Brandt lens."""
    return list(lens.image_height.coefficients)


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
