"""Arrays to ROS messages, and what RViz and Foxglove draw; `io.decoding` reads them.

Stamps are whole nanoseconds.  What is drawn is in the world frame.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import (
    Point,
    PoseStamped,
    PoseWithCovarianceStamped,
    Quaternion,
    TransformStamped,
    Vector3,
    Vector3Stamped,
)
from geometry_msgs.msg import Pose as PoseMessage
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, Image, PointCloud2, PointField
from std_msgs.msg import ColorRGBA, Float64, Header
from visualization_msgs.msg import Marker, MarkerArray

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.io.decoding import (
    DATATYPES,
    IMAGE_POINTS,
    LANDMARKS,
    Points,
    structured_array,
)
from fisheye_svp_ros.io.tag_maps import TagMap
from fisheye_svp_ros.optics.camera import incidence
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, quaternion_from_rotation
from fisheye_svp_ros.rectify.maps import Rectification, svp_equivalent
from fisheye_svp_ros.scene.observations import Landmarks

_NS = 10**9
_NUMBERS = {code: number for number, code in DATATYPES.items()}
_CAMERA_SIZE = 0.1  # m, of the viewing axis that is drawn
_HALF_BASE = 0.4 * _CAMERA_SIZE


class Segments(NamedTuple):
    """Lines or balls to draw: points (N, 3), m (pairs for lines); color r, g, b, a; size, m."""

    name: str
    points: Array
    color: tuple[float, float, float, float]
    size: float
    lines: bool = True


def header(stamp: int, frame: str = '') -> Any:
    """Return std_msgs/Header."""
    sec, nanosec = divmod(stamp, _NS)
    return Header(stamp=Time(sec=sec, nanosec=nanosec), frame_id=frame)


def cloud_message(points: Points, stamp: int, frame: str) -> Any:
    """Return sensor_msgs/PointCloud2 of a structured array (N,)."""
    fields = []
    for name in points.dtype.names or ():
        kind, offset = points.dtype.fields[name][:2]  # type: ignore[index]
        number = _NUMBERS[kind.str[1:]]
        fields.append(PointField(name=name, offset=offset, datatype=number, count=1))
    step = points.dtype.itemsize
    message = PointCloud2(header=header(stamp, frame), height=1, width=len(points), fields=fields)
    message.is_bigendian, message.is_dense = False, True
    message.point_step, message.row_step = step, step * len(points)
    message.data = array('B', points.tobytes())
    return message


def landmarks_message(landmarks: Landmarks, stamp: int, frame: str) -> Any:
    """Return landmarks as PointCloud2: landmark, x, y, z (m)."""
    points = structured_array(LANDMARKS, landmarks.ids, *landmarks.points.T)
    return cloud_message(points, stamp, frame)


def image_points_message(landmark: Index, uv: Array, stamp: int, frame: str) -> Any:
    """Return image points as PointCloud2: landmark, u, v (px)."""
    return cloud_message(structured_array(IMAGE_POINTS, landmark, *uv.T), stamp, frame)


def image_message(pixels: NDArray[Any], stamp: int, frame: str, encoding: str = '') -> Any:
    """Return sensor_msgs/Image; without an encoding mono8 of (H, W) or bgr8 of (H, W, 3)."""
    height, width, *colored = pixels.shape
    return Image(
        header=header(stamp, frame),
        height=height,
        width=width,
        encoding=encoding or ('bgr8' if colored else 'mono8'),
        is_bigendian=0,
        step=pixels.strides[0],
        data=array('B', pixels.tobytes()),
    )


def camera_info_message(lens: Lens, stamp: int, frame: str) -> Any:
    """Return CameraInfo as an SVP user has it: `equidistant` (Kannala-Brandt), k1 to k4."""
    svp = svp_equivalent(lens)
    k = [svp.fx, 0.0, svp.cx, 0.0, svp.fy, svp.cy, 0.0, 0.0, 1.0]
    message = CameraInfo(header=header(stamp, frame), width=lens.width, height=lens.height)
    message.distortion_model = 'equidistant'
    message.d = list(svp.image_height.coefficients)
    message.k = k
    message.r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    message.p = [*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0]
    return message


def rectified_info_message(side: Rectification, stamp: int, frame: str) -> Any:
    """Return CameraInfo of a rectified pinhole camera: no distortion; P has the baseline."""
    message = CameraInfo(
        header=header(stamp, frame),
        width=side.camera.width,
        height=side.camera.height,
        distortion_model='plumb_bob',
    )
    message.d = [0.0] * 5
    message.k = side.k.ravel().tolist()
    message.r = np.eye(3).ravel().tolist()
    message.p = side.p.ravel().tolist()
    return message


def pose_message(pose: Pose, stamp: int, frame: str) -> Any:
    """Return PoseStamped of one pose."""
    return PoseStamped(header=header(stamp, frame), pose=_pose(pose))


def pose_with_covariance_message(pose: Pose, covariance: Array, stamp: int, frame: str) -> Any:
    """Return PoseWithCovarianceStamped; covariance (6, 6), m and rad, in the order of ROS."""
    # Filled in place: a message that is given its parts makes them anew first, which takes longer.
    message = PoseWithCovarianceStamped()
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, _NS)
    message.header.frame_id = frame
    message.pose.covariance = covariance.ravel()
    at, turn = message.pose.pose.position, message.pose.pose.orientation
    at.x, at.y, at.z = pose.position.tolist()
    turn.x, turn.y, turn.z, turn.w = quaternion_from_rotation(pose.rotation).tolist()
    return message


def transform_message(pose: Pose, stamp: int, frame: str, child: str) -> Any:
    """Return TransformStamped of the pose of `child` in `frame`."""
    message = TransformStamped(header=header(stamp, frame), child_frame_id=child)
    message.transform.translation = _vector(Vector3, pose.position)
    message.transform.rotation = _quaternion(pose)
    return message


def vector_message(vector: Array, stamp: int, frame: str) -> Any:
    """Return Vector3Stamped of (3,)."""
    return Vector3Stamped(header=header(stamp, frame), vector=_vector(Vector3, vector))


def number_message(value: float) -> Any:
    """Return std_msgs/Float64."""
    return Float64(data=float(value))


def key_values_message(
    name: str,
    values: Mapping[str, object],
    stamp: int,
    text: str = '',
    level: bytes = DiagnosticStatus.OK,
) -> Any:
    """Return a DiagnosticArray with one status; numbers are written so that they read back."""
    pairs = [KeyValue(key=key, value=_text(value)) for key, value in values.items()]
    status = DiagnosticStatus(level=level, name=name, message=text, values=pairs)
    return DiagnosticArray(header=header(stamp), status=[status])


def markers_message(shapes: Iterable[Segments], stamp: int, frame: str) -> Any:
    """Return a MarkerArray with one marker a shape."""
    markers = []
    for shape in shapes:
        marker = Marker(header=header(stamp, frame), ns=shape.name)
        marker.type = Marker.LINE_LIST if shape.lines else Marker.SPHERE_LIST
        marker.action = Marker.ADD
        marker.scale = _vector(Vector3, np.full(3, shape.size))
        red, green, blue, alpha = shape.color
        marker.color = ColorRGBA(r=red, g=green, b=blue, a=alpha)
        marker.points = [_vector(Point, point) for point in shape.points]
        markers.append(marker)
    return MarkerArray(markers=markers)


def _pose(pose: Pose) -> Any:
    return PoseMessage(position=_vector(Point, pose.position), orientation=_quaternion(pose))


def _quaternion(pose: Pose) -> Any:
    x, y, z, w = quaternion_from_rotation(pose.rotation).tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


def _vector(kind: Any, values: Array) -> Any:
    x, y, z = values.tolist()
    return kind(x=x, y=y, z=z)


def _text(value: object) -> str:
    return repr(float(value)) if isinstance(value, float) else str(value)


def landmarks_shape(points: Array) -> Segments:
    """Return balls at landmarks (N, 3), m, of a size that suits their distance."""
    size = 0.02 * float(np.linalg.norm(points, axis=-1).mean())
    return Segments('landmarks', points, (0.1, 0.1, 0.1, 1.0), size, lines=False)


def tag_map_shapes(tags: TagMap) -> list[Segments]:
    """Return the outlines of tags, and axes of their errors: two standard errors either way."""
    edges = np.stack([tags.corners, np.roll(tags.corners, -1, axis=1)], axis=2)
    shapes = [Segments('tags', edges.reshape(-1, 3), (0.1, 0.1, 0.1, 1.0), 0.01)]
    if tags.covariance is not None:
        count = len(tags.ids)
        blocks = tags.covariance.reshape(count, 6, count, 6)[
            np.arange(count), :3, np.arange(count), :3
        ]
        variances, axes = np.linalg.eigh(blocks)
        ends = 2 * np.sqrt(np.maximum(variances, 0.0))[..., None] * np.swapaxes(axes, -1, -2)
        center = tags.poses.position[:, None]
        lines = np.stack([center - ends, center + ends], axis=2)
        shapes.append(
            Segments('errors of tags', lines.reshape(-1, 3), (0.9, 0.1, 0.1, 1.0), 0.004)
        )
    return shapes


def camera_shape(pose: Pose, name: str, alpha: float) -> Segments:
    """Return a pyramid for a camera, its tip at the pose, opening along the viewing axis."""
    corners = np.array([[x, y, _CAMERA_SIZE] for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    corners[:, :2] *= _HALF_BASE
    edges = [
        edge
        for i in range(4)
        for edge in (np.zeros(3), corners[i], corners[i], corners[(i + 1) % 4])
    ]
    world = np.stack(edges) @ pose.rotation.T + pose.position
    return Segments(f'camera {name}', world, (0.1, 0.5, 0.9, alpha), 0.003)


def rays_shape(lens: Lens, pose: Pose, points: Array, name: str) -> Segments:
    """Return the rays from each landmark (N, 3), m, to the viewpoint it has in the lens."""
    rays = incidence(lens, pose.into_body(points))
    viewpoint = np.zeros((len(points), 3))
    viewpoint[:, 2] = lens.shift_at(rays.theta)
    start = viewpoint @ pose.rotation.T + pose.position
    both = np.stack([start, points], axis=1)[rays.valid].reshape(-1, 3)
    return Segments(f'rays {name}'.strip(), both, (0.9, 0.5, 0.1, 0.5), 0.001)


def epipolar_shapes(lens: Lens, pose: Pose, curves: Array, uv: Array) -> list[Segments]:
    """Return epipolar curves (N, K, 2) and image points (N, 2), px, on the base of the camera.

    The longer side of the image is the side of the base; curves are cut where they are NaN.
    """

    def to_frustum(pixels: Array) -> Array:
        size = np.array([lens.width, lens.height])
        sideways = (pixels - (size - 1) / 2) * 2 * _HALF_BASE / size.max()
        ahead = np.full((*sideways.shape[:-1], 1), _CAMERA_SIZE)
        return np.concatenate([sideways, ahead], axis=-1) @ pose.rotation.T + pose.position

    steps = np.stack([curves[:, :-1], curves[:, 1:]], axis=2).reshape(-1, 2, 2)
    known = steps[np.isfinite(steps).all(axis=(1, 2))].reshape(-1, 2)
    return [
        Segments('epipolar curves', to_frustum(known), (0.8, 0.2, 0.2, 0.8), 0.0003),
        Segments('image points', to_frustum(uv), (0.1, 0.1, 0.1, 1.0), 0.001, lines=False),
    ]
