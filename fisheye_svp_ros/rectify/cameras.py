"""Rectified cameras: ideal ones with a single viewpoint, to which photographs are mapped.

With x = (u - cx) / f and y = (v - cy) / f a pixel stands for the direction

pinhole:         (x, y, 1)
cylindrical:     (sin x, y, cos x)                      azimuth x about the camera's y axis
equirectangular: (sin x cos y, sin y, cos x cos y)      azimuth x, elevation y
fisheye:         equidistant, at an incidence angle of hypot(x, y)

The rectified cameras of a stereo pair have x and y exchanged in the second and third: the axis is
the baseline then, and each row is an epipolar plane.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.optics.lens import Lens

PROJECTIONS = ('pinhole', 'cylindrical', 'equirectangular', 'fisheye')
_STRAIGHT_FIELD = np.radians(90.0)  # where u is a tangent and the user names none
_MAX_SIZE = 32_000  # px, of an image that cv2.remap takes
# Widest field of view, deg, and what is beyond it
_WIDEST = {'pinhole': 175.0, 'cylindrical': 360.0, 'equirectangular': 360.0, 'fisheye': 360.0}
_WIDEST_STEREO = {'pinhole': 175.0, 'cylindrical': 175.0, 'equirectangular': 180.0}
STEREO_PROJECTIONS = tuple(_WIDEST_STEREO)


@dataclass(frozen=True)
class RectifiedCamera:
    """An ideal camera: projection; width, height, f, cx, cy, px; pixels are square.

    along_baseline: whether the axis of a cylinder or sphere is x, as in a stereo pair, or y.
    """

    projection: str
    width: int
    height: int
    f: float
    cx: float
    cy: float
    along_baseline: bool = False

    @property
    def k(self) -> Array:
        """The camera matrix (3, 3), px."""
        return np.array([[self.f, 0.0, self.cx], [0.0, self.f, self.cy], [0.0, 0.0, 1.0]])

    @property
    def field_of_view(self) -> float:
        """The field of view over the width of the image, rad."""
        half = self.width / 2 / self.f
        return float(
            2 * (np.arctan(half) if _is_straight(self.projection, self.along_baseline) else half)
        )

    def directions(self, u: Array, v: Array) -> Array:
        """Return unit vectors (..., 3) of pixels u, v, px, that broadcast together.

        A pixel that stands for no direction, past the pole of a sphere for example, gets -z.
        """
        x, y = (u - self.cx) / self.f, (v - self.cy) / self.f
        if self.along_baseline:
            second, first, third = self._directions(y, x)
        else:
            first, second, third = self._directions(x, y)
        return np.stack(np.broadcast_arrays(first, second, third), axis=-1)

    def _directions(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        if self.projection == 'pinhole':
            scale = 1 / np.sqrt(1 + x * x + y * y)
            return x * scale, y * scale, scale
        if self.projection == 'cylindrical':
            scale = np.where(np.abs(x) <= np.pi, 1 / np.sqrt(1 + y * y), np.nan)
            parts = np.sin(x) * scale, y * scale, np.cos(x) * scale
        elif self.projection == 'equirectangular':
            across = np.where((np.abs(x) <= np.pi) & (np.abs(y) <= np.pi / 2), np.cos(y), np.nan)
            parts = np.sin(x) * across, np.sin(y) + 0 * across, np.cos(x) * across
        else:
            theta = np.hypot(x, y)
            theta = np.where(theta <= np.pi, theta, np.nan)
            scale = np.sinc(theta / np.pi)
            parts = x * scale, y * scale, np.cos(theta)
        return np.nan_to_num(parts[0]), np.nan_to_num(parts[1]), np.nan_to_num(parts[2], nan=-1.0)

    def project(self, directions: Array) -> Array:
        """Return the pixels (..., 2), px, of directions (..., 3) of any length; NaN for none."""
        x, y, z = np.moveaxis(directions, -1, 0)
        if self.along_baseline:
            x, y = y, x
        with np.errstate(divide='ignore', invalid='ignore'):
            if self.projection == 'pinhole':
                ahead = np.where(z > 0, z, np.nan)
                a, b = x / ahead, y / ahead
            elif self.projection == 'fisheye':
                r = np.hypot(x, y)
                scale = np.where(r > 0, np.arctan2(r, z) / r, 1 / z)
                a, b = x * scale, y * scale
            else:
                across = np.hypot(x, z)
                a = np.arctan2(x, z)
                b = y / across if self.projection == 'cylindrical' else np.arctan2(y, across)
        if self.along_baseline:
            a, b = b, a
        return np.stack([self.cx + self.f * a, self.cy + self.f * b], axis=-1)


def rectified_camera(
    projection: str, size: tuple[int, int], field_of_view: float, along_baseline: bool = False
) -> RectifiedCamera:
    """Return the camera of a size (width, height), px, and a field of view, rad, over its width.

    Raises ParameterError for a projection that is unknown, or cannot hold the field of view.
    """
    widest = _widest_field(projection, along_baseline)
    width, height = size
    if not (0 < width <= _MAX_SIZE and 0 < height <= _MAX_SIZE):
        raise ParameterError(f'size is {width}x{height}; 1 to {_MAX_SIZE} px are needed')
    degrees = np.degrees(field_of_view)
    if not 0 < degrees <= widest + 1e-9:
        raise ParameterError(
            f'field of view is {degrees:.6g} deg; above 0 and at most {widest:g} '
            f'are needed ({projection})'
        )
    camera = RectifiedCamera(
        projection,
        width,
        height,
        1.0,
        (width - 1) / 2,
        (height - 1) / 2,
        along_baseline and projection != 'pinhole',
    )
    half = field_of_view / 2
    straight = _is_straight(projection, along_baseline)
    return replace(camera, f=float(width / 2 / (np.tan(half) if straight else half)))


def camera_for(
    lenses: Sequence[Lens],
    projection: str,
    size: tuple[int, int] | None = None,
    field_of_view: float | None = None,
    along_baseline: bool = False,
) -> RectifiedCamera:
    """Return the rectified camera of a lens, or of both lenses of a pair, as `rectified_camera`.

    size: by default that of the first lens; field_of_view: by default 90 degrees of a pinhole and
    of a cylinder along the baseline, otherwise what the lenses see over the width of their images.
    """
    if field_of_view is None:
        widest = np.radians(_widest_field(projection, along_baseline))
        most = _STRAIGHT_FIELD if _is_straight(projection, along_baseline) else widest
        field_of_view = min(float(most), *map(_field_over_width, lenses))
    return rectified_camera(
        projection, size or (lenses[0].width, lenses[0].height), field_of_view, along_baseline
    )


def _field_over_width(lens: Lens) -> float:
    """Return the field of view over the width of the image, rad, to both sides alike."""
    across = min(lens.cx + 0.5, lens.width - 0.5 - lens.cx) / lens.fx
    seen = float(lens.image_height.angle(np.asarray(max(across, 0.0))))
    return float(2 * min(seen, lens.max_incidence, lens.calibrated_angle or np.inf))


def _widest_field(projection: str, along_baseline: bool) -> float:
    widest = _WIDEST_STEREO if along_baseline else _WIDEST
    if projection not in widest:
        reason = 'has no straight epipolar rows' if projection in _WIDEST else 'is unknown'
        raise ParameterError(
            f'projection {projection!r} {reason}; choose from ' + ', '.join(widest)
        )
    return widest[projection]


def _is_straight(projection: str, along_baseline: bool) -> bool:
    """Say whether u is a tangent rather than an angle."""
    return projection == 'pinhole' or (projection == 'cylindrical' and along_baseline)
