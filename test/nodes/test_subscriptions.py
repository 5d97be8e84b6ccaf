"""Inputs that are heard from any publisher, each message once."""

from __future__ import annotations

import sys
from collections.abc import Callable

import pytest
from helpers.graph import LATCHED, Graph
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from sensor_msgs.msg import CompressedImage, Image, PointCloud2  # isort: skip

from fisheye_svp_ros.io.landmark_files import environment
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.detector import Detector
from fisheye_svp_ros.nodes.localizer import Localizer
from fisheye_svp_ros.nodes.subscriptions import DuplicateFilter

BEST_EFFORT = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)


def test_what_several_subscriptions_bring_is_taken_once_and_in_order() -> None:
    heard: list[bytes] = []
    once = DuplicateFilter(heard.append, history=True)
    one, other = once.callback(), once.callback()
    for hear, data in (
        (one, b'a'),
        (one, b'b'),
        (other, b'a'),
        (other, b'b'),
        (other, b'c'),
        (one, b'a'),
        (other, b'a'),
    ):
        hear(data)
    assert heard == [b'a', b'b', b'c', b'a']


def test_a_later_subscription_brings_what_came_before() -> None:
    heard: list[bytes] = []
    once = DuplicateFilter(heard.append, history=True)
    one = once.callback()
    one(b'a')
    one(b'a')
    other = once.callback()
    for hear, data in ((other, b'a'), (one, b'a'), (other, b'a'), (other, b'b'), (one, b'b')):
        hear(data)
    assert heard == [b'a', b'a', b'a', b'b']


def test_no_message_is_kept_and_memory_is_bounded() -> None:
    once = DuplicateFilter(lambda _: None, history=True)
    hear, _ = once.callback(), once.callback()
    data = bytes(1000)
    before = sys.getrefcount(data)
    hear(data)
    assert sys.getrefcount(data) == before
    for number in range(3000):
        hear(b'%d' % number)
    assert len(once._passed) == 1000 and len(once._heard) <= 1000


def test_the_latest_messages_are_remembered() -> None:
    heard: list[bytes] = []
    once = DuplicateFilter(heard.append, history=True)
    one, other = once.callback(), once.callback()
    sent = [b'%d' % number for number in range(1500)]
    for data in sent:
        one(data)
    for data in sent[-900:]:
        other(data)
    assert heard == sent


def test_one_subscription_may_be_a_whole_queue_behind_another() -> None:
    heard: list[bytes] = []
    once = DuplicateFilter(heard.append, history=True)
    one, other = once.callback(), once.callback()
    sent = [b'%d' % number for number in range(1000)]
    for hear in (one, other):
        for data in sent:
            hear(data)
    assert heard == sent


def test_subscriptions_are_added_as_publishers_need_them(graph: Callable[..., Graph]) -> None:
    g = graph('lens:=fish214', 'svp:=true')
    node = g.start(Localizer)

    def asked() -> list[tuple[str, str]]:
        return [
            (one.reliability.name, one.durability.name)
            for one in node._inputs['landmarks'].profiles
        ]

    assert asked() == [('RELIABLE', 'VOLATILE')]
    g.probe.create_publisher(PointCloud2, 'landmarks', 1)
    g.idle(1.5)
    assert asked() == [('RELIABLE', 'VOLATILE')]
    g.probe.create_publisher(PointCloud2, 'landmarks', LATCHED)
    g.until(lambda: len(asked()) == 2)
    g.probe.create_publisher(PointCloud2, 'landmarks', BEST_EFFORT)
    g.until(lambda: len(asked()) == 3)
    g.idle(1.5)
    assert asked()[1:] == [('RELIABLE', 'TRANSIENT_LOCAL'), ('BEST_EFFORT', 'VOLATILE')]


def test_landmarks_that_were_latched_by_two_are_all_heard(graph: Callable[..., Graph]) -> None:
    g = graph('lens:=fish214', 'svp:=true')
    for radius in (1.0, 2.0):
        one = g.probe.create_publisher(PointCloud2, 'landmarks', LATCHED)
        one.publish(messages.landmarks_message(environment('whole', radius), 0, 'world'))
    node = g.start(Localizer)
    count = node._inputs['landmarks'].count
    g.until(lambda: count.received == 2)
    g.idle(0.5)
    assert count.received == 2


def test_an_override_stays_as_the_user_has_it(graph: Callable[..., Graph]) -> None:
    g = graph(
        'qos_overrides./landmarks.subscription.durability:=transient_local',
        'qos_overrides./landmarks.subscription.depth:=7',
    )
    node = g.start(Localizer)
    g.probe.create_publisher(PointCloud2, 'landmarks', BEST_EFFORT)
    g.idle(1.5)
    (profile,) = node._inputs['landmarks'].profiles
    assert profile.durability == DurabilityPolicy.TRANSIENT_LOCAL and profile.depth == 7


@pytest.mark.parametrize(
    ('remapped', 'topics'),
    [
        ((), ('/image', '/image/compressed')),
        (('image:=/camera/image_raw',), ('/camera/image_raw', '/camera/image_raw/compressed')),
        (('image:=cam', '__ns:=/left'), ('/left/cam', '/left/cam/compressed')),
        (('image:=/raw', 'image/compressed:=/small'), ('/raw', '/small')),
        (('image/compressed:=/small',), ('/image', '/small')),
    ],
)
def test_compressed_images_go_with_the_others(
    ros_domain: int, remapped: tuple[str, ...], topics: tuple[str, str]
) -> None:
    g = Graph(*(word for one in remapped for word in ('-r', one)))
    try:
        node = g.start(Detector)
        assert (
            tuple(node._inputs[name].resolved for name in ('image', 'image/compressed')) == topics
        )
        for kind, topic in ((Image, topics[0]), (CompressedImage, topics[1])):
            publisher = g.probe.create_publisher(kind, topic, BEST_EFFORT)
            g.until(lambda publisher=publisher: publisher.get_subscription_count())
    finally:
        g.close()
