"""Names, namespaces and remapping."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from helpers.nodes import NodeProcess

pytest.importorskip('cyclonedds')
pytest.importorskip('rosbags')

from fisheye_svp_ros.standalone import names
from fisheye_svp_ros.standalone.exceptions import NameValidationException

_NODE = """
import sys
import rclpy
from rclpy.node import Node
from std_msgs.msg import Float64
from std_srvs.srv import Trigger
rclpy.init()
nodes = [Node('a', namespace='ns'), Node('b')]
for node in nodes:
    topics = [node.create_publisher(Float64, t, 1).topic_name for t in ('x', '~/x', '/x', 'sub/x')]
    service = node.create_service(Trigger, 'x', lambda request, response: response)
    print(node.get_fully_qualified_name(), *topics, service.service_name, flush=True)
"""


def test_nodes_of_one_process(run_node: Callable[..., NodeProcess]) -> None:
    node = run_node(
        _NODE, '--ros-args', '-r', 'a:__node:=first', '-r', 'b:x:=mine', '-r', 'x:=y',
        '-r', 'b:__ns:=/deep/down',
        '-r', 'rosservice://x:=asked', '-r', '/x:=/z')  # fmt: skip
    assert node.finish() == 0
    assert node.lines == [
        '/ns/first /ns/y /ns/first/x /z /ns/sub/x /ns/y',
        '/deep/down/b /deep/down/mine /deep/down/b/x /z /deep/down/sub/x /deep/down/mine',
    ]


@pytest.mark.parametrize(
    ('name', 'expanded'),
    [
        ('x', '/ns/x'), ('/x', '/x'), ('~', '/ns/node'), ('~/x', '/ns/node/x'), ('a/b', '/ns/a/b'),
    ],
)  # fmt: skip
def test_expansion(name: str, expanded: str) -> None:
    assert names.expand(name, 'node', '/ns') == expanded


@pytest.mark.parametrize('name', ['', '1x', 'a//b', 'a b', 'a/', '/a/', '~x', 'x{node}', '/', 'ä'])
def test_malformed_topics_are_refused(name: str) -> None:
    with pytest.raises(NameValidationException, match='Invalid topic name'):
        names.expand(name, 'node', '/ns')


@pytest.mark.parametrize('name', ['', 'a/b', '1', 'a-b'])
def test_malformed_nodes_are_refused(name: str) -> None:
    with pytest.raises(NameValidationException, match='Invalid node name'):
        names.node_name(name)


@pytest.mark.parametrize('text', ['', 'a', 'a:=', ':=b', 'a=b'])
def test_malformed_rules_are_refused(text: str) -> None:
    with pytest.raises(NameValidationException, match='is not from:=to'):
        names.Rule.parse(text)


@pytest.mark.parametrize(
    ('rule', 'name', 'result'),
    [
        ('x:=y', 'x', '/ns/y'), ('x:=/y', 'x', '/y'), ('/ns/x:=y', 'x', '/ns/y'),
        ('~/x:=y', '~/x', '/ns/y'), ('x:=~/y', '/ns/x', '/ns/node/y'), ('node:x:=y', 'x', '/ns/y'),
        ('other:x:=y', 'x', '/ns/x'), ('rosservice://x:=y', 'x', '/ns/x'),
        ('rostopic://x:=y', 'x', '/ns/y'), ('z:=y', 'x', '/ns/x'),
    ],
)  # fmt: skip
def test_remapping(rule: str, name: str, result: str) -> None:
    assert names.remap([names.Rule.parse(rule)], name, 'node', '/ns') == result
