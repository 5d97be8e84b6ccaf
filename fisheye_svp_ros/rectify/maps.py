"""Maps for cv2.remap: where each pixel of a rectified image lies in the photograph.

A pixel's ray starts at the lens's origin.  Where it is `range` away from the center of the
sphere (the origin itself, or the middle of a baseline), its point goes through the projection of
the lens, with the viewpoint shift and all corrections: for points at that range the rectified
image is that of a camera with a single viewpoint, exactly.  Elsewhere the shift leaves an error.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import GeometryError, LensError, ParameterError
from fisheye_svp_ros.optics import camera
from fisheye_svp_ros.optics.camera import Image, unique_range
from fisheye_svp_ros.optics.curves import kannala_brandt_equivalent
from fisheye_svp_ros.optics.lens import Lens, curve_limit
from fisheye_svp_ros.pose import Pose, rotation_from_vector, vector_from_rotation
from fisheye_svp_ros.rectify.cameras import RectifiedCamera
from fisheye_svp_ros.solve.lens_checks import ExtrapolatedPoints, extrapolated_points

RANGE = 2.0  # m, where the user names none
MAX_RANGE = 1e6  # m, as far as any range
_OUTSIDE_PX = -16.0  # px: further out than the widest interpolation of cv2.remap reaches
_PIXEL_TYPES = ('uint8', 'uint16', 'int16', 'float32', 'float64')  # of cv2.remap
_BLOCK = 20_000  # points at once, whose arrays stay in a processor's cache

Map = NDArray[np.float32]
_SAMPLES = 60  # along the longer side of the image
_MOST_STEPS = 50
_TOLERANCE = 1e-7  # px


class Maps(NamedTuple):
    """u, v (H, W), px, of the photograph, for cv2.remap; mask (H, W): a ray reaches the pixel.

    Where none does, u and v lie outside the photograph.
    """

    u: Map
    v: Map
    mask: Mask


@dataclass(frozen=True)
class Rectification:
    """A lens and the rectified camera to which its photographs are mapped at a range, m.

    rotation (3, 3): from the frame of the lens to the rectified one; offset: of the lens
    from the center of the sphere of that range, along the rectified x axis, m; baseline: m, to the
    left camera (of the right one of a pair).
    Raises ParameterError for a range at which the lens has no image.
    """

    lens: Lens
    camera: RectifiedCamera
    range: float = RANGE
    rotation: Array = field(default_factory=lambda: np.eye(3))
    offset: float = 0.0
    baseline: float = 0.0

    def __post_init__(self) -> None:
        _check_range(self.lens, self.range, self.min_range)

    def __repr__(self) -> str:
        camera = self.camera
        return (
            f'Rectification({self.lens.name!r} to {camera.projection} '
            f'{camera.width}x{camera.height} px, at {self.range:g} m)'
        )

    @property
    def min_range(self) -> float:
        """The range, m, beyond which every point has at most one image."""
        return unique_range(self.lens) + abs(self.offset)

    @property
    def k(self) -> Array:
        """The camera matrix (3, 3) of the rectified camera, px."""
        return self.camera.k

    @property
    def p(self) -> Array:
        """The projection matrix (3, 4), px and px m; that of a right camera has -f baseline."""
        p = np.column_stack([self.k, np.zeros(3)])
        p[0, 3] = -self.camera.f * self.baseline + 0.0
        return p

    @cached_property
    def maps(self) -> Maps:
        """The maps of the whole rectified image."""
        width, height = self.camera.width, self.camera.height
        image = np.empty((2, height, width), np.float32)
        mask = np.empty((height, width), np.bool_)
        columns, rows = np.arange(width, dtype=float), np.arange(height, dtype=float)[:, None]
        step = max(_BLOCK // width, 1)
        for start in range(0, height, step):
            part = slice(start, start + step)
            uv, seen = self.image_points(self.camera.directions(columns, rows[part]), self.range)
            uv[~seen] = _OUTSIDE_PX
            image[:, part] = np.moveaxis(uv, -1, 0)
            mask[part] = (
                (uv[..., 0] >= 0)
                & (uv[..., 0] <= self.lens.width - 1)
                & (uv[..., 1] >= 0)
                & (uv[..., 1] <= self.lens.height - 1)
            )
        return Maps(image[0], image[1], mask)

    @cached_property
    def extrapolated_points(self) -> ExtrapolatedPoints | None:
        """Which of its pixels lie where nothing is known of the lens; None where none does."""
        u, v = (part[self.maps.mask].astype(float) for part in self.maps[:2])
        return extrapolated_points(self.lens, np.column_stack([u, v]))

    def remap(self, pixels: NDArray[Any], interpolation: int = cv2.INTER_LINEAR) -> NDArray[Any]:
        """Return the rectified image of a photograph (H, W) or (H, W, C); 0 where no ray reaches.

        Raises ParameterError for a photograph of another size than that of the lens, or for pixels
        of another type than uint8, uint16, int16, float32 or float64.
        """
        if (
            not isinstance(pixels, np.ndarray)
            or pixels.ndim not in (2, 3)
            or (pixels.dtype not in _PIXEL_TYPES)
        ):
            given = (
                f'{pixels.dtype} {pixels.shape}'
                if isinstance(pixels, np.ndarray)
                else type(pixels).__name__
            )
            raise ParameterError(
                f'the image is {given}; an array (H, W) or (H, W, C) of '
                f'{", ".join(_PIXEL_TYPES)} is needed'
            )
        height, width = pixels.shape[:2]
        if (width, height) != (self.lens.width, self.lens.height):
            raise ParameterError(
                f'the image is {width}x{height} px, lens {self.lens.name!r} is for '
                f'{self.lens.width}x{self.lens.height} px; give the lens of this camera at this '
                'size'
            )
        rectified = cv2.remap(pixels, self.maps.u, self.maps.v, interpolation)
        return np.asarray(rectified)

    def image_points(self, directions: Array, range_m: float) -> Image:
        """Project points at a range in rectified directions (..., 3) through the lens."""
        return self.project(self.scene_points(directions, range_m))

    def scene_points(self, directions: Array, range_m: float) -> Array:
        """Return points (..., 3), m, in the frame of the lens, at a range in rectified directions.

        The range is the distance from the center of the sphere.
        """
        return meet_sphere(np.zeros(3), directions, self._center, range_m) @ self.rotation

    @cached_property
    def project(self) -> Callable[[Array], Image]:
        """The projection of points (..., 3), m, in the frame of the lens, with its corrections."""
        model = self._model
        return partial(camera.project, model.lens) if model.is_lens_only else model.project

    def rectified_points(self, uv: Array) -> Array:
        """Return rectified pixels (..., 2) of image points (..., 2), px, where the maps have them.

        NaN where the lens has no ray.
        """
        rays = self._model.back_project(uv.reshape(1, -1, 2)).reshape(uv.shape[:-1])
        turn = self.rotation.T
        places = meet_sphere(rays.origin @ turn, rays.direction @ turn, self._center, self.range)
        return self.camera.project(places)

    @cached_property
    def _model(self) -> ForwardModel:
        return _scene_model(self.lens)

    @property
    def _center(self) -> Array:
        return np.array([-self.offset, 0.0, 0.0])


def _scene_model(lens: Lens) -> ForwardModel:
    """Return the model of a scene: without corrections of a target, rows exposed together."""
    return ForwardModel(replace(lens, target={})).without_motion()


def _check_range(lens: Lens, range_m: float, nearest: float) -> None:
    if not range_m > nearest:
        raise ParameterError(
            f'range is {range_m:g} m; lens {lens.name!r} needs more than {nearest:.3g} m'
        )


def meet_sphere(origin: Array, direction: Array, center: Array, radius: float) -> Array:
    """Return where rays (..., 3) from inside a sphere leave it; direction: unit; m."""
    radius = min(radius, MAX_RANGE)
    apart = origin - center
    if not apart.any():
        return np.asarray(origin + radius * direction)
    toward = np.sum(apart * direction, axis=-1)
    reach = np.sqrt(toward**2 + radius**2 - np.sum(apart * apart, axis=-1)) - toward
    return np.asarray(origin + reach[..., None] * direction)


@dataclass(frozen=True)
class RectifiedPair:
    """Both sides of a stereo pair; rig: the left camera in the right one."""

    left: Rectification
    right: Rectification
    rig: Pose

    @property
    def baseline(self) -> float:
        """From the left camera to the right one along the rectified x axis, m."""
        return self.right.baseline

    def depth(self, left: Array, right: Array) -> Array:
        """Return the distance (...), m, from the baseline of points at pixels (..., 2) of both.

        Of a pinhole camera in a row through cy it is z.
        """
        slopes = []
        for side, uv in ((self.left, left), (self.right, right)):
            x, y, z = np.moveaxis(side.camera.directions(uv[..., 0], uv[..., 1]), -1, 0)
            slopes.append(x / np.hypot(y, z))
        with np.errstate(divide='ignore'):
            return np.asarray(self.baseline / (slopes[0] - slopes[1]))


def rectify_pair(
    left: Lens, right: Lens, rig: Pose, camera: RectifiedCamera, range_m: float = RANGE
) -> RectifiedPair:
    """Turn both cameras, each by half of what it takes, until their x axes lie along the baseline.

    rig: the left camera in the right one; range_m: from the middle of the baseline.  The rotations
    are those of cv2.stereoRectify and cv2.fisheye.stereoRectify.
    Raises GeometryError for a rig without a baseline along x.
    """
    length = float(np.linalg.norm(rig.position))
    half = rotation_from_vector(-0.5 * vector_from_rotation(rig.rotation))  # right, turned to left
    along = half @ rig.position
    if not length > 0 or abs(along[0]) < 0.5 * length:
        raise GeometryError(
            'the cameras of the rig have no usable baseline: it is '
            + ', '.join(f'{value:.4g}' for value in -along)
            + ' m, and rows cannot be aligned'
        )
    axis = np.cross(along, [np.sign(along[0]), 0.0, 0.0])
    if (size := np.linalg.norm(axis)) > 0:
        axis *= np.arccos(min(abs(along[0]) / length, 1.0)) / size
    turn = rotation_from_vector(axis)
    rotations = turn @ half.T, turn @ half
    baseline = float(-(rotations[1] @ rig.position)[0])
    return RectifiedPair(
        Rectification(left, camera, range_m, rotations[0], -baseline / 2),
        Rectification(right, camera, range_m, rotations[1], baseline / 2, baseline),
        rig,
    )


def svp_equivalent(lens: Lens) -> Lens:
    """Return the Kannala-Brandt lens that an SVP user would be given, extended curves included."""
    return kannala_brandt_equivalent(ForwardModel(lens).lens)


def nearest_svp_lens(lens: Lens, range_m: float) -> tuple[Lens, float]:
    """Return the Kannala-Brandt lens nearest to a lens at a range, m, and its worst error, px.

    Nearest in the least squares of image points, all over the image; range: from the origin of the
    camera.  What the lens has of corrections and a port is in it as far as it can be.
    Raises ParameterError for a range at which the lens has no image, LensError where no such lens
    comes near.
    """
    _check_range(lens, range_m, unique_range(lens))
    step = max(lens.width, lens.height) / _SAMPLES
    uv = np.stack(
        np.meshgrid(np.arange(0.0, lens.width, step), np.arange(0.0, lens.height, step)), axis=-1
    ).reshape(-1, 2)
    rays = _scene_model(lens).back_project(uv[None]).reshape((len(uv),))
    uv, origin, direction = uv[rays.valid], rays.origin[rays.valid], rays.direction[rays.valid]
    points = meet_sphere(origin, direction, np.zeros(3), range_m)
    square = lens.fx == lens.fy and not lens.corrections and lens.is_bare
    names = (*(('f',) if square else ('fx', 'fy')), 'cx', 'cy', 'k1', 'k2', 'k3', 'k4')
    found = _fit_parameters(svp_equivalent(lens), names, points, uv)
    reach = float(np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2]).max())
    off = np.linalg.norm(camera.project(found, points, limited=False).uv - uv, axis=-1)
    if reach > curve_limit(found):
        raise LensError(
            f'lens {lens.name!r}: no Kannala-Brandt curve grows to the edge of its '
            'image at this range; lower its max_incidence_deg'
        )
    return replace(found, max_incidence=reach), float(off.max())


def _fit_parameters(start: Lens, names: tuple[str, ...], points: Array, uv: Array) -> Lens:
    """Return the lens with some parameters fitted to image points (N, 2) of points (N, 3)."""
    lens = start
    for _ in range(_MOST_STEPS):
        image = camera.project_with_jacobian(lens, points, limited=False)
        columns = camera.lens_columns(lens, image, names).reshape(-1, len(names))
        size = np.linalg.norm(columns, axis=0)
        residual = (uv - image.uv).ravel()
        change = np.linalg.lstsq(columns / size, residual, rcond=None)[0]
        moved = columns @ (change / size)
        values = [lens.fx if name == 'f' else lens.parameters[name] for name in names]
        lens = lens.with_parameters(names, values + change / size)
        if np.abs(moved).max() < _TOLERANCE:
            break
    return lens
