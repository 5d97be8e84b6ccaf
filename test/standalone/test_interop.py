"""Nodes of the standalone client as the tools of an installed ROS 2 see and reach them."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable

import pytest
from helpers.node_scripts import RECEIVE_CLOUD, SEND_CLOUD
from helpers.nodes import GENUINE, TIMEOUT, NodeProcess, services_of_cyclone

pytest.importorskip('cyclonedds')
pytest.importorskip('rosbags')
pytestmark = pytest.mark.skipif(
    not GENUINE or shutil.which('ros2') is None,
    reason='ROS 2 is not installed here',
)
needs_services = pytest.mark.skipif(
    GENUINE and not services_of_cyclone(),
    reason='services reach no other RMW than rmw_cyclonedds_cpp')

NODE = """
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CameraInfo, PointCloud2, PointField
from std_srvs.srv import Trigger
rclpy.init()
node = Node('camera', namespace='left')
node.declare_parameter('rate', 10.0, ParameterDescriptor(description='how often',
    floating_point_range=[FloatingPointRange(from_value=0.5, to_value=50.0)]))
node.declare_parameter('lens.name', 'fish')
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
status = DiagnosticStatus(level=DiagnosticStatus.WARN, values=[KeyValue(key='k', value='v')])
for topic, message in (
    ('pose', PoseStamped()), ('scenario', DiagnosticArray(status=[status])),
    ('camera_info', CameraInfo(width=640, k=[float(i) for i in range(9)], d=[0.5, 0.25])),
    ('points', PointCloud2(width=2, fields=[PointField(name='x', datatype=8, count=1)],
                           data=bytes(range(16)))),
):
    node.create_publisher(type(message), topic, latched).publish(message)
def hear(pose):
    print('heard', pose.header.frame_id, pose.pose.position.x, pose.pose.orientation.w, flush=True)
node.create_subscription(PoseStamped, 'goal', hear, 10)
def answer(request, response):
    response.success, response.message = True, 'done'
    return response
node.create_service(Trigger, '~/reset', answer)
node.get_logger().info('ready')
rclpy.spin(node)
"""


def _ros2(*words: str, complaint: str = '') -> str:
    done = subprocess.run(
        ['ros2', *words], capture_output=True, text=True, timeout=TIMEOUT, check=False)
    # A message that differs from its definition, or an unknown type hash, would be warned of.
    assert complaint in done.stderr if complaint else not done.stderr
    return done.stdout


@pytest.fixture
def camera(run_node: Callable[..., NodeProcess]) -> NodeProcess:
    node = run_node(NODE)
    node.wait_for('ready')
    return node


def _see(*words: str, complaint: str = '') -> str:
    return _ros2(*words, '--no-daemon', '--spin-time', '2', complaint=complaint)


def test_graph(camera: NodeProcess) -> None:
    topics = _see('topic', 'list', '-t').splitlines()
    for line in (
        '/left/pose [geometry_msgs/msg/PoseStamped]',
        '/left/goal [geometry_msgs/msg/PoseStamped]',
        '/left/scenario [diagnostic_msgs/msg/DiagnosticArray]',
        '/rosout [rcl_interfaces/msg/Log]',
    ):
        assert line in topics
    services = _see('service', 'list', '-t').splitlines()
    assert '/left/camera/reset [std_srvs/srv/Trigger]' in services
    info = _see('node', 'info', '/left/camera')
    for line in (
        '/left/goal: geometry_msgs/msg/PoseStamped',
        '/left/camera_info: sensor_msgs/msg/CameraInfo',
        '/left/camera/set_parameters: rcl_interfaces/srv/SetParameters',
    ):
        assert line in info
    verbose = _see('topic', 'info', '-v', '/left/pose')
    assert 'Node name: camera' in verbose
    assert 'Node namespace: /left' in verbose
    assert 'Durability: TRANSIENT_LOCAL' in verbose
    assert 'RIHS01_10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8' in verbose


@pytest.mark.parametrize(
    ('topic', 'typename', 'lines'),
    [
        ('pose', 'geometry_msgs/msg/PoseStamped', ['w: 1.0']),
        ('scenario', 'diagnostic_msgs/msg/DiagnosticArray',
         ['- level: "\\x01"', '- key: k', 'value: v']),
        ('camera_info', 'sensor_msgs/msg/CameraInfo', ['width: 640', '- 0.25', '- 8.0']),
        ('points', 'sensor_msgs/msg/PointCloud2', ['width: 2', '- name: x', '- 15']),
        ('/rosout', 'rcl_interfaces/msg/Log', ['msg: ready', 'level: 20']),
    ],
)  # fmt: skip
def test_echo(camera: NodeProcess, topic: str, typename: str, lines: list[str]) -> None:
    name = topic if topic.startswith('/') else f'/left/{topic}'
    # With the type given, nothing hangs on how soon the tool knows of the topic.
    text = _ros2('topic', 'echo', '--once', '--qos-durability', 'transient_local',
                 '--qos-reliability', 'reliable', name, typename)  # fmt: skip
    shown = [line.strip() for line in text.splitlines()]
    for line in lines:
        assert line in shown


def test_pub(camera: NodeProcess, start_process: Callable[..., NodeProcess]) -> None:
    # Again and again: Fast DDS knows the reader before Cyclone DDS knows the writer.
    start_process(
        ['ros2', 'topic', 'pub', '--rate', '5', '/left/goal', 'geometry_msgs/msg/PoseStamped',
         '{header: {frame_id: map}, pose: {position: {x: 2.5}}}'], dict(os.environ))
    assert camera.wait_for('heard (.*)')[1] == 'map 2.5 1.0'


@needs_services
def test_service_call(camera: NodeProcess) -> None:
    text = _ros2('service', 'call', '/left/camera/reset', 'std_srvs/srv/Trigger')
    assert "Trigger_Response(success=True, message='done')" in text


@needs_services
def test_param(camera: NodeProcess) -> None:
    node = '/left/camera'
    assert _see('param', 'list', node).split() == ['lens.name', 'rate', 'use_sim_time']
    assert _see('param', 'get', node, 'rate') == 'Double value is: 10.0\n'
    assert _see('param', 'set', node, 'rate', '20.0') == 'Set parameter successful\n'
    refused = 'Parameter rate out of range Min: 0.5, Max: 50.0, value: 99.0'
    _see('param', 'set', node, 'rate', '99.0', complaint=refused)
    _see('param', 'set', node, 'rate', 'fast', complaint='Wrong parameter type')
    assert _see('param', 'get', node, 'rate') == 'Double value is: 20.0\n'
    described = _see('param', 'describe', node, 'rate')
    assert 'Description: how often' in described
    assert 'Max value: 50.0' in described
    dumped = _see('param', 'dump', node)
    assert 'lens:\n      name: fish' in dumped
    assert 'rate: 20.0' in dumped


@pytest.mark.parametrize('standalone', ['sender', 'receiver'])
def test_large_point_cloud(run_node: Callable[..., NodeProcess], standalone: str) -> None:
    receiver = run_node(RECEIVE_CLOUD, 'receiver', genuine=standalone == 'sender')
    sender = run_node(SEND_CLOUD, 'sender', genuine=standalone == 'receiver')
    sent = sender.wait_for('sent (.*)')[1]
    assert receiver.wait_for('received (.*)')[1] == f'{sent} z 43691 True'
