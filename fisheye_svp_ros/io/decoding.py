"""Messages to arrays: the one place that reads the fields of a ROS message.

Messages come as rclpy or a bag reader made them: only attributes count.
Stamps are whole nanoseconds.  Everything here raises ObservationError, in one line that names the
topic and the field, for what cannot be used.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.io.clouds import IMAGE_POINTS, LANDMARKS, MAX_VALUE, RESIDUALS, Points, unpack
from fisheye_svp_ros.pose import Pose, rotation_from_quaternion
from fisheye_svp_ros.scene.landmarks import Landmarks

_NS = 10**9


class LandmarkSet(NamedTuple):
    """Landmarks and the frame_id of the world they stand in."""

    landmarks: Landmarks
    frame: str


class ImagePoints(NamedTuple):
    """landmark (N,); uv (N, 2), px; frame: the camera's frame_id."""

    landmark: Index
    uv: Array
    frame: str


class CameraModel(NamedTuple):
    """A CameraInfo: size: width, height, px; intrinsics: fx, fy, cx, cy, skew, px; d as it is."""

    model: str
    size: tuple[int, int]
    intrinsics: tuple[float, float, float, float, float]
    d: tuple[float, ...]


class Status(NamedTuple):
    """One status of a DiagnosticArray; level: 0 for OK."""

    level: int
    text: str
    values: dict[str, str]


def stamp_of(message: Any, topic: str = 'header') -> int:
    """Return the stamp of a message with a header, ns."""
    stamp = message.header.stamp
    return nanoseconds(int(stamp.sec), int(stamp.nanosec), topic)


def nanoseconds(sec: int, nanosec: int, topic: str = 'header') -> int:
    """Return a builtin_interfaces/Time in ns, from 1970 up."""
    if sec < 0 or not 0 <= nanosec < _NS:
        raise ObservationError(f'{topic}: the stamp {sec} s {nanosec} ns is not a time')
    return sec * _NS + nanosec


def read_landmarks(message: Any, topic: str = 'landmarks') -> LandmarkSet:
    """Return the landmarks of a PointCloud2; at least one."""
    points = unpack(message, LANDMARKS, topic)
    if not len(points):
        raise ObservationError(f'{topic}: no landmark in it; at least one is needed')
    landmarks = Landmarks(points['landmark'].astype(np.int64), columns(points, 'xyz'))
    return LandmarkSet(landmarks, str(message.header.frame_id))


def read_image_points(message: Any, topic: str = 'image_points') -> ImagePoints:
    """Return the image points of a PointCloud2."""
    points = unpack(message, IMAGE_POINTS, topic)
    landmark = points['landmark'].astype(np.int64)
    return ImagePoints(landmark, columns(points, 'uv'), str(message.header.frame_id))


def read_residuals(message: Any, topic: str = 'residuals') -> Points:
    """Return the residuals (N,) of a PointCloud2 as clouds.RESIDUALS."""
    return unpack(message, RESIDUALS, topic)


def columns(points: Points, names: Sequence[str]) -> Array:
    """Return fields of a cloud (N,) as an array (N, len(names))."""
    return np.stack([points[name] for name in names], axis=-1)


def read_pose(message: Any, topic: str = 'true_pose') -> Pose:
    """Return the pose of a PoseStamped."""
    return _pose(message.pose.position, message.pose.orientation, topic)


def read_transform(message: Any, topic: str = 'rig') -> Pose:
    """Return the pose of a TransformStamped's child in its frame."""
    return _pose(message.transform.translation, message.transform.rotation, topic)


def read_camera_info(message: Any, topic: str = 'camera_info') -> CameraModel:
    """Return the model of a CameraInfo: of the whole, raw image."""
    k, d = [float(value) for value in message.k], tuple(float(value) for value in message.d)
    if not k[0]:
        raise ObservationError(f'{topic}: k is 0, as of a camera that is not calibrated')
    if not (np.abs([*k, *d]) <= MAX_VALUE).all():  # not so for NaN
        raise ObservationError(f'{topic}: k or d holds a value that is not a finite number, or '
                               f'beyond {MAX_VALUE:g}')
    size, roi = (int(message.width), int(message.height)), message.roi
    part = roi.x_offset or roi.y_offset or (roi.width or size[0], roi.height or size[1]) != size
    if part or max(message.binning_x, message.binning_y) > 1:
        raise ObservationError(f'{topic}: of a part of the image, or binned; whole images are '
                               'needed')
    return CameraModel(str(message.distortion_model), size, (k[0], k[4], k[2], k[5], k[1]), d)


def statuses(message: Any) -> list[Status]:
    """Return the statuses of a DiagnosticArray."""
    return [  # the level is a byte: rclpy gives bytes, a bag reader a number
        Status(one.level[0] if isinstance(one.level, bytes) else int(one.level), str(one.message),
               {pair.key: pair.value for pair in one.values})
        for one in message.status
    ]


def read_key_values(message: Any, topic: str = 'scenario') -> dict[str, str]:
    """Return the key/values of a DiagnosticArray's only status."""
    found = statuses(message)
    if len(found) != 1:
        raise ObservationError(f'{topic}: {len(found)} statuses in it; one is needed')
    return found[0].values


def _pose(position: Any, orientation: Any, topic: str) -> Pose:
    place = np.array([position.x, position.y, position.z], dtype=float)
    quaternion = np.array([orientation.x, orientation.y, orientation.z, orientation.w])
    if not (np.isfinite(place).all() and np.isfinite(quaternion).all()):
        raise ObservationError(f'{topic}: the pose holds a value that is not a finite number')
    if np.abs(place).max() > MAX_VALUE:
        raise ObservationError(f'{topic}: the position is beyond {MAX_VALUE:g} m')
    if np.abs(quaternion).max() > 2 or abs(np.linalg.norm(quaternion) - 1) > 1e-3:
        raise ObservationError(f'{topic}: the orientation is not a unit quaternion')
    return Pose(rotation_from_quaternion(quaternion), place)
