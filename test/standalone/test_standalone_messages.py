"""Message classes: defaults, types, constants, and their way over the wire."""

from __future__ import annotations

import array
import copy
from typing import Any

import numpy as np
import pytest

pytest.importorskip('cyclonedds')
pytest.importorskip('rosbags')

from fisheye_svp_ros.standalone import dds, messages
from fisheye_svp_ros.standalone.messages import (
    FieldValueError,
    UnknownFieldError,
    UnreadableError,
    deserialize,
    message_class,
    serialize,
)


def _class(name: str) -> Any:
    return messages.message_class(name)


def _there_and_back(message: Any) -> Any:
    return messages.deserialize(messages.serialize(message), type(message))


def test_defaults_are_those_of_the_definitions() -> None:
    pose = _class('geometry_msgs/msg/PoseStamped')()
    assert pose.pose.position.x == 0.0
    assert pose.pose.orientation.w == 1.0
    assert pose.header.frame_id == ''
    pose.header.stamp.sec = 1
    assert pose.header.stamp.sec == 1
    assert _class('geometry_msgs/msg/PoseStamped')().header.stamp.sec == 0
    info = _class('sensor_msgs/msg/CameraInfo')()
    assert info.k.shape == (9,)
    assert len(info.d) == 0


def test_constants() -> None:
    assert _class('diagnostic_msgs/msg/DiagnosticStatus').WARN == b'\x01'
    assert _class('sensor_msgs/msg/PointField').FLOAT64 == 8
    assert messages.service_class('rcl_interfaces/srv/ListParameters').Request.DEPTH_RECURSIVE == 0


@pytest.mark.parametrize('convert', [bytes, bytearray, memoryview, list, tuple,
                                     lambda b: array.array('B', b),
                                     lambda b: np.frombuffer(b, np.uint8)])  # fmt: skip
def test_bytes_come_in_every_form(convert: Any) -> None:
    data = bytes(range(256)) * 4
    cloud = _class('sensor_msgs/msg/PointCloud2')(data=convert(data))
    assert isinstance(cloud.data, array.array)
    assert cloud.data.tobytes() == data
    assert _there_and_back(cloud) == cloud


def test_an_array_is_not_copied() -> None:
    data = array.array('B', b'abc')
    assert _class('sensor_msgs/msg/PointCloud2')(data=data).data is data


def test_every_kind_of_field_survives_the_wire() -> None:
    value = _class('rcl_interfaces/msg/ParameterValue')(
        type=3, bool_value=True, integer_value=-(2**63), double_value=0.1, string_value='ü',
        byte_array_value=[b'\0', b'\xff'], bool_array_value=[True, False],
        integer_array_value=[1, -2], double_array_value=np.array([0.5, np.inf]),
        string_array_value=('a', ''),
    )  # fmt: skip
    back = _there_and_back(value)
    assert back == value
    assert back.byte_array_value == [b'\0', b'\xff']
    assert back.bool_array_value[0] is True
    status = _class('diagnostic_msgs/msg/DiagnosticStatus')
    message = _class('diagnostic_msgs/msg/DiagnosticArray')(status=[
        status(level=status.STALE, values=[_class('diagnostic_msgs/msg/KeyValue')(key='k')])])
    assert _there_and_back(message).status[0].level == status.STALE
    marker = _class('visualization_msgs/msg/Marker')(
        points=[_class('geometry_msgs/msg/Point')(x=float(x)) for x in range(5)])
    back = _there_and_back(_class('visualization_msgs/msg/MarkerArray')(markers=[marker] * 2))
    assert [point.x for point in back.markers[1].points] == [0.0, 1.0, 2.0, 3.0, 4.0]
    info = _there_and_back(_class('sensor_msgs/msg/CameraInfo')(k=range(9), d=[0.5]))
    info.k[0] = 7.0  # what was received can be changed
    assert info.k.tolist() == [7.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0]


@pytest.mark.parametrize(
    ('name', 'field', 'value'),
    [
        ('geometry_msgs/msg/Point', 'x', 1), ('geometry_msgs/msg/Point', 'x', np.float32(1)),
        ('std_msgs/msg/UInt8', 'data', 256), ('std_msgs/msg/UInt8', 'data', 1.0),
        ('std_msgs/msg/Bool', 'data', 1), ('std_msgs/msg/String', 'data', b'x'),
        ('std_msgs/msg/Header', 'stamp', 3.0), ('sensor_msgs/msg/CameraInfo', 'k', [1.0]),
        ('sensor_msgs/msg/CameraInfo', 'd', 'text'), ('sensor_msgs/msg/CameraInfo', 'd', ['x']),
        ('diagnostic_msgs/msg/DiagnosticStatus', 'level', 1),
        ('diagnostic_msgs/msg/DiagnosticStatus', 'values', ['x']),
        ('diagnostic_msgs/msg/DiagnosticStatus', 'values', 3),
        ('sensor_msgs/msg/PointCloud2', 'data', [300]),
        ('rmw_dds_common/msg/NodeEntitiesInfo', 'node_name', 'x' * 257),
    ],
)  # fmt: skip
def test_values_that_do_not_fit_are_refused(name: str, field: str, value: object) -> None:
    with pytest.raises(FieldValueError, match=rf'{name}\.{field}'):
        _class(name)(**{field: value})


def test_copies_are_independent() -> None:
    pose = _class('geometry_msgs/msg/PoseStamped')()
    other = copy.deepcopy(pose)
    other.header.frame_id = 'map'
    assert pose.header.frame_id == ''
    assert other != pose


def test_unknown_names_are_refused() -> None:
    point = _class('geometry_msgs/msg/Point')
    with pytest.raises(UnknownFieldError, match="no field 'w'"):
        point(w=1.0)
    with pytest.raises(UnknownFieldError, match="no field 'w'"):
        point().w = 1.0


@pytest.mark.parametrize(
    ('name', 'digest'),
    [  # as an installed Jazzy has them
        ('std_msgs/msg/String',
         'df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18'),
        ('rmw_dds_common/msg/ParticipantEntitiesInfo',
         '91a0593bacdcc50ea9bdcf849a938b128412cc1ea821245c663bcd26f83c295e'),
        ('std_srvs/srv/Trigger_Request',
         'd010825374ce8918e72bfd826c82603e60f45419e932ea976f807b74a863a199'),
        ('rcl_interfaces/srv/ListParameters_Response',
         '31b937b82de3612426be79f231e386259f97e8dc843e3f2845288b4bfa296bdd'),
    ],
)  # fmt: skip
def test_type_hashes(name: str, digest: str) -> None:
    assert messages.type_hash(name) == f'RIHS01_{digest}'


@pytest.mark.parametrize(
    ('name', 'typename'),
    [
        ('geometry_msgs/msg/PoseStamped', 'geometry_msgs::msg::dds_::PoseStamped_'),
        ('std_srvs/srv/Trigger_Request', 'std_srvs::srv::dds_::Trigger_Request_'),
    ],
)
def test_type_names_on_the_wire(name: str, typename: str) -> None:
    for service in (False, True):
        sample = dds._sample_class(name, service=service)
        assert sample.__idl__.idl_transformed_typename == typename


def test_text_that_is_not_utf_8_is_replaced() -> None:
    pair = message_class('diagnostic_msgs/msg/KeyValue')
    data = serialize(pair(key='lens', value='fish????'))
    bad = data.replace(b'fish????', b'fish\xff\xfe\xc3(')
    assert bad != data
    back = deserialize(bad, pair)
    assert back.key == 'lens' and back.value == 'fish???('


def test_numbers_keep_the_bytes_of_text_that_is_not_utf_8() -> None:
    pose = message_class('geometry_msgs/msg/PoseStamped')
    message = pose()
    message.header.frame_id, message.pose.position.x = '?', float('-inf')
    data = serialize(message).replace(b'?\0', b'\xff\0', 1)
    back = deserialize(data, pose)
    assert back.header.frame_id == '?' and back.pose.position.x == float('-inf')


@pytest.mark.parametrize('cut', [0, 3, 4, 7, 12])
def test_what_is_no_message_is_one_error(cut: int) -> None:
    pair = message_class('diagnostic_msgs/msg/KeyValue')
    data = serialize(pair(key='lens', value='fish'))
    with pytest.raises(UnreadableError, match='not a diagnostic_msgs/msg/KeyValue'):
        deserialize(data[:cut], pair)
