"""Messages to arrays: the one place that reads the fields of a ROS message; knows no ROS.

Messages come as rclpy or a bag reader made them: only attributes count.  Point clouds become
structured arrays, stamps whole nanoseconds.  Everything here raises ObservationError, in one line
that names the topic and the field, for what cannot be used.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.io.tag_maps import are_of_tags
from fisheye_svp_ros.pose import Pose, rotation_from_quaternion
from fisheye_svp_ros.scene.observations import Landmarks

Points = NDArray[np.void]

LANDMARKS = np.dtype([('landmark', '<u4'), ('x', '<f8'), ('y', '<f8'), ('z', '<f8')])
IMAGE_POINTS = np.dtype([('landmark', '<u4'), ('u', '<f8'), ('v', '<f8')])
RESIDUALS = np.dtype(
    [*IMAGE_POINTS.descr, ('du', '<f8'), ('dv', '<f8'), ('theta', '<f8'), ('range', '<f8')]
)

MAX_VALUE = 1e12  # m or px; squares and products of anything larger are soon no numbers
_MAX_POINT_BYTES = 1 << 16  # bytes of a point
_MOST_FIELDS = 100

# sensor_msgs/PointField: datatype numbers.
DATATYPES = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 8: 'f8'}
_NUMBER_KINDS = {'u': ('iu', 'a whole number'), 'f': ('f', 'a floating-point number')}
_NS = 10**9


def structured_array(layout: np.dtype[np.void], landmark: Index, *columns: Array) -> Points:
    """Return an array (N,) of `layout` from ids (N,) and its other fields, each (N,)."""
    points = np.empty(len(landmark), dtype=layout)
    for name, values in zip(layout.names or (), (landmark, *columns), strict=True):
        points[name] = values
    return points


def unpack(cloud: Any, layout: np.dtype[np.void], what: str) -> Points:
    """Return the points (N,) of a PointCloud2 as `layout`, whatever their order and widths.

    what: topic or file, for the error.  Raises ObservationError where a field is missing, of the
    wrong kind, not finite, or where a landmark stands twice.
    """
    return _unpack(cloud, layout, what, strict=True)[0]


def unpack_usable(cloud: Any, layout: np.dtype[np.void], what: str) -> tuple[Points, int, str]:
    """Return the usable points of a PointCloud2, as `unpack` does.

    Also how many others hold a value that cannot be used, and the reason.
    Raises ObservationError where none of several points is usable.
    """
    raw = _raw_points(cloud, what)
    usable, reason = np.ones(raw.shape, dtype=bool), ''
    for name in layout.names or ():
        _check_field(raw.dtype, layout, name, what)
        good = _representable(raw[name], layout[name])
        if np.count_nonzero(good) < good.size and not reason:
            bad = int(np.argmin(good))
            reason = (
                f'{what}: field {name!r} of point {bad} is {raw[name][bad]}; leave out '
                f'points without a value, or beyond {MAX_VALUE:g}'
            )
        usable &= good
    if reason and not usable.any():
        raise ObservationError(reason)
    raw = raw[usable] if reason else raw
    points = np.empty(raw.shape, dtype=layout)
    for name in layout.names or ():
        points[name] = raw[name]
    if len(set(points['landmark'].tolist())) < len(points):
        ids, counts = np.unique(points['landmark'], return_counts=True)
        raise ObservationError(f'{what}: landmark {ids[counts > 1][0]} is listed twice')
    return points, len(usable) - len(points), reason


def _check_field(given: np.dtype[Any], layout: np.dtype[np.void], name: str, what: str) -> None:
    """Raise ObservationError where a field is missing, or of the wrong kind."""
    if name not in (given.names or ()):
        needed = ', '.join(layout.names or ())
        raise ObservationError(f'{what}: field {name!r} is missing; needed are {needed}')
    kinds, kind = _NUMBER_KINDS[layout[name].kind]
    if given[name].kind not in kinds:
        raise ObservationError(f'{what}: field {name!r} is {given[name]}; {kind} is needed')


def _representable(values: NDArray[Any], kind: np.dtype[Any]) -> NDArray[np.bool_]:
    if kind.kind == 'f':
        return np.asarray(np.abs(values) <= MAX_VALUE)  # not so for NaN
    if values.dtype == kind:
        return np.ones(values.shape, dtype=bool)
    return np.asarray((values >= 0) & (values <= np.iinfo(kind).max))


def _raw_points(cloud: Any, what: str) -> Points:
    step, count = int(cloud.point_step), int(cloud.width) * int(cloud.height)
    if step > _MAX_POINT_BYTES or len(cloud.fields) > _MOST_FIELDS:
        raise ObservationError(
            f'{what}: {len(cloud.fields)} fields in a point of {step} bytes; at most '
            f'{_MOST_FIELDS} in {_MAX_POINT_BYTES} are read'
        )
    fields = tuple((f.name, int(f.offset), int(f.datatype), int(f.count)) for f in cloud.fields)
    layout = _layout(fields, step, bool(cloud.is_bigendian), what)
    data, row_step = cloud.data, int(cloud.row_step)
    if row_step > step * cloud.width and len(data) == row_step * cloud.height > 0:
        rows = np.frombuffer(data, np.uint8).reshape(cloud.height, row_step)
        data = rows[:, : step * cloud.width].tobytes()  # without the padding of the rows
    if len(data) != step * count:
        raise ObservationError(
            f'{what}: {len(cloud.data)} bytes of data do not hold {count} points of {step} bytes'
        )
    return np.frombuffer(data, dtype=layout) if count else np.empty(0, dtype=layout)


@lru_cache(maxsize=64)
def _layout(
    fields: tuple[tuple[str, int, int, int], ...], step: int, big: bool, what: str
) -> np.dtype[np.void]:
    """Return the layout of one point; fields: name, offset, datatype and count."""
    names, formats, offsets = [], [], []
    for name, offset, datatype, count in fields:
        size = np.dtype(DATATYPES.get(datatype, 'V0')).itemsize
        if not size or count != 1 or offset + size > step or name in names:
            raise ObservationError(
                f'{what}: field {name!r} has an impossible type, count or offset'
            )
        names.append(name)
        formats.append(('>' if big else '<') + DATATYPES[datatype])
        offsets.append(offset)
    return np.dtype(
        {'names': names, 'formats': formats, 'offsets': offsets, 'itemsize': max(step, 1)}
    )


class LandmarkSet(NamedTuple):
    """Landmarks and the frame_id of the world they stand in; others cannot be used: the reason.

    of_tags: whether they are corners and middles of tags, numbered as those of a map of tags.
    """

    landmarks: Landmarks
    frame: str
    rejected: int = 0
    reason: str = ''
    of_tags: bool = False


class ImagePoints(NamedTuple):
    """landmark (N,); uv (N, 2), px; frame: the camera's frame_id; rejected: as in LandmarkSet.

    tag (N,): that each belongs to, None where landmarks belong to none; doubtful_tags: how many
    tags the detector itself doubts, which are left out; xyz (N, 3), m: where the landmarks are,
    once that is known.
    """

    landmark: Index
    uv: Array
    frame: str
    rejected: int = 0
    reason: str = ''
    tag: Index | None = None
    doubtful_tags: int = 0
    xyz: Array = np.zeros((0, 3))

    def take(self, kept: Mask) -> ImagePoints:
        """Return some of the points (N,), whose landmarks are not looked up yet."""
        tag = None if self.tag is None else self.tag[kept]
        return self._replace(landmark=self.landmark[kept], uv=self.uv[kept], tag=tag)


class FramedPose(NamedTuple):
    """A pose, and the frame_id it is given in."""

    pose: Pose
    frame: str


class CameraModel(NamedTuple):
    """A CameraInfo: size: width, height, px; intrinsics: fx, fy, cx, cy, skew, px; d as it is."""

    model: str
    size: tuple[int, int]
    intrinsics: tuple[float, float, float, float, float]
    d: tuple[float, ...]


class FramedCamera(NamedTuple):
    """The model of a camera, and its frame_id."""

    model: CameraModel
    frame: str


class FramedRig(NamedTuple):
    """The pose of the left camera in the right one, and their frame_ids."""

    pose: Pose
    left: str
    right: str


class ResultStatus(NamedTuple):
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


def read_landmarks(message: Any, topic: str = 'landmarks', strict: bool = True) -> LandmarkSet:
    """Return the landmarks of a PointCloud2; at least one; strict: as for image points."""
    points, rejected, reason = _unpack(message, LANDMARKS, topic, strict)
    if not len(points):
        raise ObservationError(f'{topic}: no landmark in it; at least one is needed')
    landmarks = Landmarks(points['landmark'].astype(np.int64), columns(points, 'xyz'))
    frame, of_tags = str(message.header.frame_id), are_of_tags(landmarks.ids)
    return LandmarkSet(landmarks, frame, rejected, reason, of_tags)


def read_image_points(
    message: Any, topic: str = 'image_points', strict: bool = True
) -> ImagePoints:
    """Return the image points of a PointCloud2; strict: refuse it for one that is no number."""
    points, rejected, reason = _unpack(message, IMAGE_POINTS, topic, strict)
    landmark = points['landmark'].astype(np.int64)
    frame, uv = str(message.header.frame_id), columns(points, 'uv')
    return ImagePoints(landmark, uv, frame, rejected, reason)


def _unpack(
    message: Any, layout: np.dtype[np.void], topic: str, strict: bool
) -> tuple[Points, int, str]:
    points, rejected, reason = unpack_usable(message, layout, topic)
    if strict and rejected:
        raise ObservationError(reason)
    return points, rejected, reason


def read_residuals(message: Any, topic: str = 'residuals') -> Points:
    """Return the residuals (N,) of a PointCloud2 as clouds.RESIDUALS."""
    return unpack(message, RESIDUALS, topic)


def columns(points: Points, names: Sequence[str]) -> Array:
    """Return fields of a cloud (N,) as an array (N, len(names))."""
    return np.stack([points[name] for name in names], axis=-1)


def read_pose(message: Any, topic: str = 'true_pose') -> Pose:
    """Return the pose of a PoseStamped."""
    return _decode_pose(message.pose.position, message.pose.orientation, topic)


def read_framed_pose(message: Any, topic: str = 'true_pose') -> FramedPose:
    """Return the pose of a PoseStamped, and its frame_id."""
    return FramedPose(read_pose(message, topic), str(message.header.frame_id))


def read_transform(message: Any, topic: str = 'rig') -> Pose:
    """Return the pose of a TransformStamped's child in its frame."""
    return _decode_pose(message.transform.translation, message.transform.rotation, topic)


def read_framed_rig(message: Any, topic: str = 'rig') -> FramedRig:
    """Return the rig of a TransformStamped: its child is the left camera."""
    pose = read_transform(message, topic)
    return FramedRig(pose, str(message.child_frame_id), str(message.header.frame_id))


def read_camera_info(
    message: Any, topic: str = 'camera_info', rectified: bool = False
) -> CameraModel:
    """Return the model of a CameraInfo, of the image as it is sent: a part, binned.

    rectified: that of the rectified image, from P, which has no distortion.  The part comes first,
    as in image_geometry, then the binning: that averages pixels, whose centers are at whole
    numbers, so that cx comes to (cx + 0.5) / 2 - 0.5.  image_geometry leaves out the halves.
    """
    name = 'p' if rectified else 'k'
    matrix = np.array([float(value) for value in getattr(message, name)]).reshape(3, -1)
    d = () if rectified else tuple(float(value) for value in message.d)
    if not matrix[0, 0]:
        raise ObservationError(
            f'{topic}: {name} is 0, as of a camera that is not '
            + ('rectified; set detections_rectified:=false' if rectified else 'calibrated')
        )
    if not (np.abs([*matrix.ravel(), *d]) <= MAX_VALUE).all():  # not so for NaN
        raise ObservationError(
            f'{topic}: {name} or d holds a value that is not a finite number, or beyond '
            f'{MAX_VALUE:g}'
        )
    roi, width, height = message.roi, int(message.width), int(message.height)
    bins = max(int(message.binning_x), 1), max(int(message.binning_y), 1)
    low = int(roi.x_offset), int(roi.y_offset)
    part = int(roi.width) or width, int(roi.height) or height
    if low[0] + part[0] > width or low[1] + part[1] > height:
        raise ObservationError(
            f'{topic}: roi {part[0]}x{part[1]} at ({low[0]}, {low[1]}) is not in the image of '
            f'{width}x{height} px; width and height are those of the whole image'
        )
    matrix[:2, 2] += 0.5 - np.array(low)
    matrix[:2] /= np.array(bins, dtype=float)[:, None]
    matrix[:2, 2] -= 0.5
    fx, fy, cx, cy, skew = (
        float(matrix[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2), (0, 1))
    )
    return CameraModel(
        '' if rectified else str(message.distortion_model),
        (part[0] // bins[0], part[1] // bins[1]),
        (fx, fy, cx, cy, skew),
        d,
    )


def read_framed_camera(
    message: Any, topic: str = 'camera_info', rectified: bool = False
) -> FramedCamera:
    """Return the model of a CameraInfo, see `read_camera_info`, and its frame_id."""
    return FramedCamera(read_camera_info(message, topic, rectified), str(message.header.frame_id))


def are_different_frames(one: str, other: str) -> bool:
    """Say whether two frame_ids name different frames; an empty one may be any."""
    return bool(one and other) and one.lstrip('/') != other.lstrip('/')


def statuses(message: Any) -> list[ResultStatus]:
    """Return the statuses of a DiagnosticArray."""
    return [  # the level is a byte: rclpy gives bytes, a bag reader a number
        ResultStatus(
            status.level[0] if isinstance(status.level, bytes) else int(status.level),
            str(status.message),
            {pair.key: pair.value for pair in status.values},
        )
        for status in message.status
    ]


def read_key_values(message: Any, topic: str = 'scenario') -> dict[str, str]:
    """Return the key/values of a DiagnosticArray's only status."""
    states = statuses(message)
    if len(states) != 1:
        raise ObservationError(f'{topic}: {len(states)} statuses in it; one is needed')
    return states[0].values


def _decode_pose(position: Any, orientation: Any, topic: str) -> Pose:
    place = np.array([position.x, position.y, position.z], dtype=float)
    quaternion = np.array([orientation.x, orientation.y, orientation.z, orientation.w])
    if not (np.isfinite(place).all() and np.isfinite(quaternion).all()):
        raise ObservationError(f'{topic}: the pose holds a value that is not a finite number')
    if np.abs(place).max() > MAX_VALUE:
        raise ObservationError(f'{topic}: the position is beyond {MAX_VALUE:g} m')
    if np.abs(quaternion).max() > 2 or abs(np.linalg.norm(quaternion) - 1) > 1e-3:
        raise ObservationError(f'{topic}: the orientation is not a unit quaternion')
    return Pose(rotation_from_quaternion(quaternion), place)
