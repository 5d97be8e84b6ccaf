"""Stereo pairs rectified: rows are epipolar planes for points at the range of the maps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, rotation_from_vector, vector_from_rotation
from fisheye_svp_ros.rectify.cameras import RectifiedCamera
from fisheye_svp_ros.rectify.maps import RANGE, Rectification


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
            + ', '.join(f'{value:.4g}' for value in -along) + ' m, and rows cannot be aligned')
    axis = np.cross(along, [np.sign(along[0]), 0.0, 0.0])
    if (size := np.linalg.norm(axis)) > 0:
        axis *= np.arccos(min(abs(along[0]) / length, 1.0)) / size
    turn = rotation_from_vector(axis)
    rotations = turn @ half.T, turn @ half
    baseline = float(-(rotations[1] @ rig.position)[0])
    return RectifiedPair(
        Rectification(left, camera, range_m, rotations[0], -baseline / 2),
        Rectification(right, camera, range_m, rotations[1], baseline / 2, baseline), rig)
