"""Arrays to and from ROS messages, and messages that cannot be used."""

from __future__ import annotations

import math
from array import array
from typing import Any

import numpy as np
import pytest
from helpers import graph  # noqa: F401 - skips where there is no rclpy

from sensor_msgs.msg import PointCloud2, PointField  # isort: skip

from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.io import decoding
from fisheye_svp_ros.io.decoding import IMAGE_POINTS, RESIDUALS, stamp_of, structured_array, unpack
from fisheye_svp_ros.io.landmark_files import environment
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.optics.curves import kannala_brandt_equivalent
from fisheye_svp_ros.pose import Pose, rotation_from_vector

STAMP = 1_700_000_000_123_456_789
POSE = Pose(rotation_from_vector(np.array([0.3, -1.2, 2.0])), np.array([0.1, -0.2, 1e-17]))


def image_points() -> Any:
    uv = np.array([[0.1, 1e-300], [1535.9, -3.25], [1 / 3, 7.0]])
    return messages.image_points_message(np.array([7, 4_294_967_295, 0]), uv, STAMP, 'camera')


def test_image_points_survive_bit_by_bit() -> None:
    message = image_points()
    assert [f.name for f in message.fields] == ['landmark', 'u', 'v']
    assert [f.datatype for f in message.fields] == [
        PointField.UINT32,
        PointField.FLOAT64,
        PointField.FLOAT64,
    ]
    back = decoding.read_image_points(message)
    assert back.landmark.tolist() == [7, 4_294_967_295, 0]
    assert back.uv.tolist() == [[0.1, 1e-300], [1535.9, -3.25], [1 / 3, 7.0]]
    assert back.frame == 'camera' and stamp_of(message) == STAMP


def test_landmarks_survive_bit_by_bit() -> None:
    landmarks = environment('outer', 0.2)
    back = decoding.read_landmarks(messages.landmarks_message(landmarks, STAMP, 'world'))
    assert back.landmarks.ids.tolist() == landmarks.ids.tolist()
    assert np.array_equal(back.landmarks.points, landmarks.points) and back.frame == 'world'


def test_residuals_have_the_fields_of_the_design() -> None:
    message = messages.cloud_message(
        structured_array(RESIDUALS, np.array([3]), *np.arange(6.0)[:, None]), STAMP, 'camera'
    )
    assert [f.name for f in message.fields] == ['landmark', 'u', 'v', 'du', 'dv', 'theta', 'range']
    assert unpack(message, RESIDUALS, 'residuals').tolist() == [(3, 0, 1, 2, 3, 4, 5)]


def test_other_field_order_width_and_endianness_are_read() -> None:
    raw = np.array([(1.5, 9, 2.5, 7, 0)], dtype='>f4,>u2,>f4,>i4,>u4')
    message = PointCloud2(height=1, width=1, is_bigendian=True, point_step=18, row_step=18)
    message.fields = [
        PointField(name=name, offset=offset, datatype=kind, count=1)
        for name, offset, kind in (
            ('v', 0, 7),
            ('intensity', 4, 4),
            ('u', 6, 7),
            ('landmark', 10, 5),
        )
    ]
    message.data = array('B', raw.tobytes())
    back = decoding.read_image_points(message)
    assert back.uv.tolist() == [[2.5, 1.5]] and back.landmark.tolist() == [7]


def test_rows_that_are_padded_are_read() -> None:
    points = structured_array(IMAGE_POINTS, np.arange(6), np.arange(6.0), np.arange(6.0) + 10)
    message = messages.cloud_message(points, STAMP, 'camera')
    message.height, message.width = 2, 3
    message.row_step = 3 * message.point_step + 5
    rows = np.pad(np.frombuffer(points.tobytes(), np.uint8).reshape(2, -1), ((0, 0), (0, 5)))
    message.data = array('B', rows.tobytes())
    back = decoding.read_image_points(message)
    assert back.landmark.tolist() == [*range(6)] and back.uv[:, 1].tolist() == [*range(10, 16)]
    message.data = message.data[:-5]
    with pytest.raises(ObservationError, match='do not hold 6 points'):
        decoding.read_image_points(message)


def test_an_empty_cloud_holds_no_image_points() -> None:
    message = messages.image_points_message(np.array([], dtype=int), np.empty((0, 2)), 1, '')
    assert len(decoding.read_image_points(message).landmark) == 0


def without_field(message: Any) -> Any:
    message.fields = message.fields[:2]
    return message


def wrong_kind(message: Any) -> Any:
    message.fields[1].datatype = PointField.UINT32
    return message


def float_landmark(message: Any) -> Any:
    message.fields[0].datatype = PointField.FLOAT32
    return message


def unknown_datatype(message: Any) -> Any:
    message.fields[1].datatype = 77
    return message


def field_past_the_end(message: Any) -> Any:
    message.fields[2].offset = 14
    return message


def several_values(message: Any) -> Any:
    message.fields[2].count = 2
    return message


def field_twice(message: Any) -> Any:
    message.fields[2].name = 'u'
    return message


def too_few_bytes(message: Any) -> Any:
    message.data = array('B', bytes(message.data)[:-1])
    return message


def too_many_points(message: Any) -> Any:
    message.width = 4_000_000_000
    return message


def no_step(message: Any) -> Any:
    message.point_step = 0
    return message


def with_u(value: float) -> Any:
    uv = np.array([[value, 1.0], [2.0, 3.0]])
    return lambda _: messages.image_points_message(np.array([1, 2]), uv, STAMP, '')


def landmark_twice(_: Any) -> Any:
    return messages.image_points_message(np.array([5, 5]), np.ones((2, 2)), STAMP, '')


@pytest.mark.parametrize(
    ('spoil', 'reason'),
    [
        (without_field, "field 'v' is missing; needed are landmark, u, v"),
        (wrong_kind, "field 'u' is uint32; a floating-point number is needed"),
        (float_landmark, "field 'landmark' is float32; a whole number is needed"),
        (unknown_datatype, "field 'u' has an impossible type"),
        (field_past_the_end, "field 'v' has an impossible type, count or offset"),
        (several_values, "field 'v' has an impossible type, count or offset"),
        (field_twice, "field 'u' has an impossible type"),
        (too_few_bytes, '59 bytes of data do not hold 3 points of 20 bytes'),
        (too_many_points, '60 bytes of data do not hold 4000000000 points'),
        (no_step, 'impossible type, count or offset'),
        (with_u(math.nan), "field 'u' of point 0 is nan; leave out points without a value"),
        (with_u(math.inf), "field 'u' of point 0 is inf"),
        (landmark_twice, 'landmark 5 is listed twice'),
    ],
)
def test_image_points_that_cannot_be_used(spoil: Any, reason: str) -> None:
    with pytest.raises(ObservationError, match=r'^left/image_points: ') as caught:
        decoding.read_image_points(spoil(image_points()), 'left/image_points')
    assert reason in str(caught.value) and '\n' not in str(caught.value)


def test_landmarks_need_at_least_one() -> None:
    message = messages.image_points_message(np.array([], dtype=int), np.empty((0, 2)), 1, '')
    message.fields = [
        PointField(name=name, offset=0, datatype=kind, count=1)
        for name, kind in (('landmark', 6), ('x', 8), ('y', 8), ('z', 8))
    ]
    with pytest.raises(ObservationError, match='landmarks: no landmark in it'):
        decoding.read_landmarks(message)


def test_a_negative_landmark_is_refused() -> None:
    message = image_points()
    message.fields[0].datatype = PointField.INT32
    with pytest.raises(ObservationError, match="field 'landmark' of point 1 is -1"):
        decoding.read_image_points(message)


def test_poses_and_transforms_survive() -> None:
    back = decoding.read_pose(messages.pose_message(POSE, STAMP, 'world'))
    assert np.abs(back.difference(POSE)).max() < 1e-15
    message = messages.transform_message(POSE, STAMP, 'right', 'left')
    assert message.child_frame_id == 'left'
    assert np.abs(decoding.read_transform(message).difference(POSE)).max() < 1e-15


@pytest.mark.parametrize(
    ('field', 'value', 'reason'),
    [
        ('position.x', math.nan, 'not a finite number'),
        ('orientation.w', math.inf, 'not a finite number'),
        ('orientation.w', 2.0, 'not a unit quaternion'),
    ],
)
def test_poses_that_cannot_be_used(field: str, value: float, reason: str) -> None:
    message = messages.pose_message(POSE, STAMP, 'world')
    part, axis = field.split('.')
    setattr(getattr(message.pose, part), axis, value)
    with pytest.raises(ObservationError, match=f'true_pose: .*{reason}'):
        decoding.read_pose(message)


def test_covariance_is_row_by_row() -> None:
    covariance = np.arange(36.0).reshape(6, 6)
    message = messages.pose_with_covariance_message(POSE, covariance, STAMP, 'world')
    assert list(message.pose.covariance) == list(range(36))


def test_key_values_read_back_exactly() -> None:
    values = {'error_m': 1 / 3, 'tiny_px': 5e-324, 'count': 3, 'name': 'a b', 'flag': True}
    message = messages.key_values_message('n', values, STAMP)
    back = decoding.read_key_values(message)
    assert float(back['error_m']) == 1 / 3 and float(back['tiny_px']) == 5e-324
    assert back['count'] == '3' and back['name'] == 'a b' and back['flag'] == 'True'
    message.status = []
    with pytest.raises(ObservationError, match='scenario: 0 statuses in it; one is needed'):
        decoding.read_key_values(message)


def test_key_values_take_numpy_numbers() -> None:
    message = messages.key_values_message('n', {'x_m': np.float64(0.1)}, 1)
    assert decoding.read_key_values(message) == {'x_m': '0.1'}


@pytest.mark.parametrize('name', ['fish180', 'fish214'])
def test_camera_info_is_the_equidistant_model_nearest_to_the_lens(name: str) -> None:
    lens = load_lens(lens_path(name))
    message = messages.camera_info_message(lens, STAMP, 'camera')
    assert message.distortion_model == 'equidistant' and len(message.d) == 4
    assert (message.width, message.height) == (lens.width, lens.height)
    theta = np.linspace(0, lens.max_incidence, 333)
    powers = theta[:, None] ** np.arange(3, 10, 2)
    height = message.k[0] * (theta + powers @ np.array(message.d))
    assert np.abs(height - lens.fx * lens.image_height.value_and_slope(theta)[0]).max() < 1e-5
    assert message.k[2] == lens.cx and message.k[5] == lens.cy
    assert list(message.p) == [*message.k[:3], 0, *message.k[3:6], 0, *message.k[6:], 0]


def test_a_kannala_brandt_lens_is_its_own_equivalent_without_the_shift() -> None:
    lens = load_lens(lens_path('fish214'))
    once = kannala_brandt_equivalent(lens)
    assert once.viewpoint_shift is None
    assert kannala_brandt_equivalent(once) == once


def test_markers_keep_every_point() -> None:
    shape = messages.Segments('rays', np.eye(3)[[0, 1]], (1.0, 0.5, 0.0, 1.0), 0.01)
    (marker,) = messages.markers_message([shape], STAMP, 'world').markers
    assert marker.type == marker.LINE_LIST and marker.ns == 'rays'
    assert [(p.x, p.y, p.z) for p in marker.points] == [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)]


def test_the_default_topic_names_the_input() -> None:
    with pytest.raises(ObservationError, match=r'^landmarks: '):
        decoding.read_landmarks(PointCloud2())
