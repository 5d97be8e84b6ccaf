"""How nodes start and end: signals, shutdown, logs, and what is not covered."""

from __future__ import annotations

import re
import signal
from collections.abc import Callable

import pytest
from helpers.nodes import GENUINE, NodeProcess

pytest.importorskip('cyclonedds')
pytest.importorskip('rosbags')

_MAIN = """
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

def main(args=None):
    rclpy.init(args=args)
    node = Node('waiting')
    try:
        print('spinning', flush=True)
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException) as end:
        print('ended by', type(end).__name__, rclpy.ok(), flush=True)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()

main()
"""


@pytest.mark.parametrize(
    ('number', 'end'),
    [(signal.SIGINT, 'KeyboardInterrupt'), (signal.SIGTERM, 'ExternalShutdownException')],
)
def test_signals_end_a_node_quietly(
    run_node: Callable[..., NodeProcess], number: signal.Signals, end: str
) -> None:
    node = run_node(_MAIN)
    node.wait_for('spinning')
    assert node.finish(number) == 0
    # As in rclpy, a SIGTERM that does not find the executor waiting just ends the loop.
    assert node.lines[0] == 'spinning'
    assert node.lines[1:] == [f'ended by {end} False'] or number == signal.SIGTERM


def test_one_process_can_start_again(run_node: Callable[..., NodeProcess]) -> None:
    node = run_node("""
import rclpy
from rclpy.node import Node
for attempt in range(3):
    rclpy.init()
    node = Node('again')
    node.create_timer(0.0, lambda: print('called', flush=True))
    rclpy.spin_once(node)
    rclpy.shutdown()
try:
    rclpy.shutdown()
except RuntimeError as error:
    print('refused', error)
try:
    Node('late')
except Exception as error:
    print(type(error).__name__)
""")
    assert node.finish() == 0
    assert node.lines[:3] == ['called'] * 3
    assert 'already called' in node.lines[3]
    assert node.lines[4:] == ['NotInitializedException']


def test_shutdown_from_a_callback_ends_spin(run_node: Callable[..., NodeProcess]) -> None:
    node = run_node("""
import rclpy
from rclpy.node import Node
rclpy.init()
node = Node('short')
node.create_timer(0.01, rclpy.shutdown)
rclpy.spin(node)
print('over', rclpy.ok())
""")
    assert node.finish() == 0
    assert node.lines == ['over False']


def test_an_error_in_a_callback_ends_spin(run_node: Callable[..., NodeProcess]) -> None:
    node = run_node("""
import rclpy
from rclpy.node import Node
rclpy.init()
node = Node('bad')
node.create_timer(0.01, lambda: 1 / 0)
rclpy.spin(node)
""")
    assert node.finish() == 1
    assert node.lines[-1] == 'ZeroDivisionError: division by zero'


@pytest.mark.parametrize(
    ('name', 'value', 'message'),
    [
        ('ROS_DOMAIN_ID', '233', 'not a number from 0 to 232'),
        ('ROS_DOMAIN_ID', 'x', 'not a number from 0 to 232'),
        ('ROS_AUTOMATIC_DISCOVERY_RANGE', 'OFF', 'use LOCALHOST or SUBNET'),
        ('CYCLONEDDS_URI', '<Nonsense/>', 'cannot join ROS domain'),
    ],
)
def test_a_faulty_environment_is_named(
    run_node: Callable[..., NodeProcess], name: str, value: str, message: str
) -> None:
    node = run_node(f'import os, rclpy\nos.environ[{name!r}] = {value!r}\nrclpy.init()')
    assert node.finish() == 1
    assert message in node.lines[-1]


def test_spin_once_times_out(run_node: Callable[..., NodeProcess]) -> None:
    node = run_node("""
import time
import rclpy
from rclpy.node import Node
rclpy.init()
node = Node('idle')
start = time.monotonic()
rclpy.spin_once(node, timeout_sec=0)
rclpy.spin_once(node, timeout_sec=0.3)
print('waited', 0.3 <= time.monotonic() - start)
""")
    assert node.finish() == 0
    assert node.lines == ['waited True']


def test_log_format_levels_and_filters(run_node: Callable[..., NodeProcess]) -> None:
    node = run_node("""
import rclpy
from rclpy.node import Node
rclpy.init()
log = Node('noisy', namespace='left').get_logger()
Node('quiet', namespace='left').get_logger().info('never')
for _ in range(3):
    log.debug('every time')
    log.info('as often')
    log.warn('once', once=True)
    log.fatal('seldom', throttle_duration_sec=60.0)
""", '--ros-args', '--log-level', 'warn', '--log-level', 'left.noisy:=debug')  # fmt: skip
    assert node.finish() == 0
    assert all(
        re.fullmatch(r'\[[A-Z]+\] \[\d{10}\.\d{9}\] \[left\.noisy\]: .*', line)
        for line in node.lines
    )
    said = [line.split(': ')[1] for line in node.lines]
    assert said.count('every time') == said.count('as often') == 3
    assert said.count('once') == said.count('seldom') == 1
    assert 'never' not in said


def test_what_is_not_covered_is_named(run_node: Callable[..., NodeProcess]) -> None:
    node = run_node("""
import rclpy
import rclpy.executors
from rclpy.node import Node
from rclpy.qos import QoSProfile
rclpy.init()
node = Node('limited')
for attempt in (lambda: node.create_client, lambda: rclpy.executors.MultiThreadedExecutor,
                lambda: rclpy.spin_until_future_complete,
                lambda: QoSProfile(depth=1, lifespan=3),
                lambda: __import__('sensor_msgs.msg').msg.NoSuchThing):
    try:
        attempt()
    except AttributeError as error:
        print(error)
try:
    import rclpy.action
except ModuleNotFoundError as error:
    print(error)
""")
    assert node.finish() == 0
    for line, name in zip(
        node.lines,
        ('create_client', 'MultiThreadedExecutor', 'spin_until_future_complete', 'lifespan',
         'NoSuchThing', 'rclpy.action'),
        strict=True,
    ):  # fmt: skip
        assert name in line


@pytest.mark.skipif(not GENUINE, reason='ROS 2 is not installed here')
def test_nothing_is_installed_where_ros_is(run_node: Callable[..., NodeProcess]) -> None:
    code = """
from fisheye_svp_ros import standalone
standalone.install()
import rclpy
print(standalone.is_genuine(), 'standalone' in rclpy.__file__)
"""
    node = run_node(code, genuine=True)
    assert node.finish() == 0
    assert node.lines == ['True False']


def test_standalone_knows_that_it_is(run_node: Callable[..., NodeProcess]) -> None:
    node = run_node('standalone.install(); import rclpy\nprint(standalone.is_genuine())')
    assert node.finish() == 0
    assert node.lines == ['False']
