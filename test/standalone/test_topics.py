"""Two processes that publish and subscribe through the standalone client."""

from __future__ import annotations

import signal
from collections.abc import Callable

import pytest
from helpers.node_scripts import HEAD, RECEIVE_CLOUD, SEND_CLOUD
from helpers.nodes import NodeProcess

pytest.importorskip('cyclonedds')
pytest.importorskip('rosbags')

_LISTEN = HEAD + """
heard = []
def hear(message):
    heard.append(message.data)
    print('heard', message.data, flush=True)
node.create_subscription(String, 'chatter', hear, {qos})
print('listening', flush=True)
rclpy.spin(node)
"""

_TALK = HEAD + """
publisher = node.create_publisher(String, 'chatter', {qos})
count = 0
def talk():
    global count
    if publisher.get_subscription_count():
        count += 1
        publisher.publish(String(data=f'{{count}}'))
node.create_timer(0.01, talk)
rclpy.spin(node)
"""

_LATCH = HEAD + """
publisher = node.create_publisher(String, 'chatter', latched)
for word in 'abcde':
    publisher.publish(String(data=word))
print('published', flush=True)
rclpy.spin(node)
"""


@pytest.mark.parametrize('reliability', ['RELIABLE', 'BEST_EFFORT'])
def test_messages_arrive_in_order(
    run_node: Callable[..., NodeProcess], reliability: str
) -> None:
    qos = f'QoSProfile(depth=10, reliability=ReliabilityPolicy.{reliability})'
    listener = run_node(_LISTEN.format(qos=qos), 'listener')
    run_node(_TALK.format(qos=qos), 'talker')
    heard = [int(listener.wait_for('heard (.*)')[1]) for _ in range(5)]
    assert heard == sorted(set(heard))
    # The talker knows of the listener before the listener of it: best effort loses the first.
    assert reliability == 'BEST_EFFORT' or heard == [1, 2, 3, 4, 5]


def test_late_subscriber_receives_the_last_ones(run_node: Callable[..., NodeProcess]) -> None:
    run_node(_LATCH, 'talker').wait_for('published')
    for name in ('first', 'second'):
        late = run_node(_LISTEN.format(qos='latched'), name)
        assert [late.wait_for('heard (.*)')[1] for _ in range(3)] == ['c', 'd', 'e']


def test_large_point_cloud_arrives_unchanged(run_node: Callable[..., NodeProcess]) -> None:
    receiver = run_node(RECEIVE_CLOUD, 'receiver')
    sent = run_node(SEND_CLOUD, 'sender').wait_for('sent (.*)')[1]
    assert receiver.wait_for('received (.*)')[1] == f'{sent} z 43691 True'
    assert run_node(RECEIVE_CLOUD, 'late').wait_for('received')


def test_topics_are_discovered_and_recorded_as_cdr(run_node: Callable[..., NodeProcess]) -> None:
    run_node(_LATCH, 'talker').wait_for('published')
    recorder = run_node(HEAD + """
node.create_subscription(String, 'chatter', lambda data: print('raw', type(data), data.hex(),
                                                               flush=True), latched, raw=True)
while '/chatter' not in (topics := dict(node.get_topic_names_and_types())):
    rclpy.spin_once(node, timeout_sec=0.05)
print('topics', topics['/chatter'], topics['/rosout'], flush=True)
while not node.count_publishers('chatter'):
    rclpy.spin_once(node, timeout_sec=0.05)
node.create_subscription(String, 'only_heard', print, 10)
while '/only_heard' not in dict(node.get_topic_names_and_types()):
    rclpy.spin_once(node, timeout_sec=0.05)
print('publishers', node.count_publishers('/chatter'), node.count_publishers('only_heard'),
      flush=True)
rclpy.spin(node)
""", 'recorder')  # fmt: skip
    raw = [recorder.wait_for("raw <class 'bytes'> (.*)|topics (.*)|publishers (.*)")
           for _ in range(5)]
    (topics,) = (match[2] for match in raw if match[2])
    assert topics == "['std_msgs/msg/String'] ['rcl_interfaces/msg/Log']"
    assert [match[3] for match in raw if match[3]] == ['1 0']
    first = next(match[1] for match in raw if match[1])
    assert bytes.fromhex(first)[:10] == b'\0\1\0\0' + b'\2\0\0\0' + b'c\0'


def test_incompatible_qos_does_not_connect(run_node: Callable[..., NodeProcess]) -> None:
    talker = run_node(HEAD + """
publisher = node.create_publisher(String, 'chatter', 10)
other = node.create_publisher(String, 'end', latched)
other.publish(String())
rclpy.spin(node)
""", 'talker')  # fmt: skip
    listener = run_node(HEAD + """
node.create_subscription(String, 'chatter', print, latched)
def end(message):
    names = ('chatter', 'end')
    print('connected', *(n for n, s in zip(names, node.subscriptions)
                         if s.reader.entity.get_matched_publications()), flush=True)
node.create_subscription(String, 'end', end, latched)
rclpy.spin(node)
""", 'listener')  # fmt: skip
    assert listener.wait_for('connected(.*)')[1] == ' end'
    assert talker.process.poll() is None


def test_subscribers_are_counted_while_they_come_and_go(
    run_node: Callable[..., NodeProcess]
) -> None:
    guests = run_node(HEAD + """
print('ready', flush=True)
for _ in range(300):
    both = [node.create_subscription(String, 'chatter', print, 10) for _ in range(2)]
    for subscription in both:
        node.destroy_subscription(subscription)
print('gone', flush=True)
rclpy.spin(node)
""", 'guests')  # fmt: skip
    counter = run_node(HEAD + """
publisher = node.create_publisher(String, 'chatter', 10)
node.create_subscription(String, 'end', lambda _: print('counted', flush=True), latched)
def count():
    for _ in range(10_000):
        assert publisher.get_subscription_count() >= 0
node.create_timer(0.01, count)
rclpy.spin(node)
""", 'counter')  # fmt: skip
    guests.wait_for('gone')
    run_node(HEAD + """
node.create_publisher(String, 'end', latched).publish(String())
rclpy.spin(node)
""", 'end')  # fmt: skip
    counter.wait_for('counted')


def test_a_subscriber_that_does_not_keep_up_does_not_stop_a_publisher(
    run_node: Callable[..., NodeProcess]
) -> None:
    slow = run_node(HEAD + """
qos = QoSProfile(history=HistoryPolicy.KEEP_ALL)
node.create_subscription(String, 'text', lambda _: print('one', flush=True), qos)
rclpy.spin(node)
""", 'slow')
    sender = run_node(HEAD + """
import time
publisher = node.create_publisher(String, 'text', QoSProfile(history=HistoryPolicy.KEEP_ALL))
while not publisher.get_subscription_count():
    rclpy.spin_once(node, timeout_sec=0.05)
publisher.publish(String(data='first'))
time.sleep(2)
for _ in range(2000):
    publisher.publish(String(data=50_000 * 'x'))
    if publisher.lost >= 3:
        break
print('over', publisher.lost, flush=True)
""", 'sender')
    slow.wait_for('one')
    slow.process.send_signal(signal.SIGSTOP)
    assert int(sender.wait_for(r'over (\d+)')[1]) >= 3
    assert sum('a subscriber is too slow' in line for line in sender.lines) == 1
