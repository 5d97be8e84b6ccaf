"""Two lenses of one camera: by what angles the points differ that they see in the same places.

Where a lens has its camera frame is a convention, and taken out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.forward import back_project_corrected
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, identity
from fisheye_svp_ros.solve.ray_errors import RANGES, motion_of, points_at, without_motion

_CELLS = 40  # over the longer side of the image
_FEWEST = 10  # image points
_MAX_ITERATIONS, _TOLERANCE = 20, 1e-12


class LensComparison(NamedTuple):
    """Angles (R, G), rad, between what two lenses see in image points uv (G, 2), px, at R ranges.

    theta (G,), rad: incidence angle in the first; motion: the camera frame of the second in that
    of the first, by which both fit best.
    """

    uv: Array
    theta: Array
    angle: Array
    motion: Pose


def compare_lenses(one: Lens, other: Lens, ranges: Sequence[float] = RANGES) -> LensComparison:
    """Compare lenses over the image, at ranges, m, after the best motion of the camera frame.

    Raises LensError for images of two sizes, and where hardly a point has a ray in both lenses.
    """
    if (one.width, one.height) != (other.width, other.height):
        raise LensError(
            f'images of {one.name!r} are {one.width}x{one.height} px, those of {other.name!r} '
            f'{other.width}x{other.height} px; lenses of one image size are compared'
        )
    uv = _image_grid(one)
    rays = [back_project_corrected(lens, uv) for lens in (one, other)]
    seen = rays[0].valid & rays[1].valid
    if seen.sum() < _FEWEST:
        raise LensError(
            f'{one.name!r} and {other.name!r} have rays of {seen.sum()} common image points; '
            'lenses of one camera are compared'
        )
    (origin, direction), other_rays = (
        (one_lens.origin[seen], one_lens.direction[seen]) for one_lens in rays
    )
    points, motion = points_at(origin, direction, ranges), identity()
    for _ in range(_MAX_ITERATIONS):
        step = motion_of(points, points - _move(motion, *other_rays, ranges))
        motion = identity().retract(step).compose(motion)
        if np.abs(step).max() < _TOLERANCE:
            break
    change = _move(motion, *other_rays, ranges) - points
    angle = np.linalg.norm(without_motion(points, change), axis=-1)
    return LensComparison(uv[seen], rays[0].theta[seen], angle, motion)


def _image_grid(lens: Lens) -> Array:
    """Return the middles (G, 2), px, of cells all over the image."""
    cell = max(lens.width, lens.height) / _CELLS
    u, v = (
        (np.arange(count) + 0.5) * size / count - 0.5
        for size in (lens.width, lens.height)
        for count in [max(1, round(size / cell))]
    )
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)


def _move(motion: Pose, origin: Array, direction: Array, ranges: Sequence[float]) -> Array:
    """Return the points (R, G, 3), m, of rays in another frame, at ranges from its origin."""
    return points_at(motion.transform(origin), direction @ motion.rotation.T, ranges)
