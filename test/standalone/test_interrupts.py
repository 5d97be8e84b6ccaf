"""Ctrl-C while the DDS library is at work."""

from __future__ import annotations

import signal
from collections.abc import Callable

import pytest
from helpers.node_scripts import HEAD
from helpers.nodes import NodeProcess

pytest.importorskip('cyclonedds')
pytest.importorskip('rosbags')

# The library's C code calls this class, whose first line is where Python runs signal handlers.
_INTERRUPTED = HEAD + """
import signal
from cyclonedds import internal
plain = internal.SampleInfo.__init__
def interrupted(self, *args):
    signal.raise_signal(signal.SIGINT)
    plain(self, *args)
publisher = node.create_publisher(String, 'chatter', latched)
node.create_subscription(String, 'chatter', print, latched)
publisher.publish(String(data='word'))
internal.SampleInfo.__init__ = interrupted
try:
    {call}
except KeyboardInterrupt:
    print('interrupted', flush=True)
"""


@pytest.mark.parametrize('call', ['rclpy.spin(node)', 'node.get_topic_names_and_types()'])
def test_interrupt_amid_a_take_is_an_exception_after_it(
    run_node: Callable[..., NodeProcess], call: str
) -> None:
    node = run_node(_INTERRUPTED.format(call=call), 'node')
    node.wait_for('interrupted')
    assert node.finish() == 0
    assert not any(line.startswith('std_msgs') for line in node.lines)


def test_interrupt_between_takes_is_an_exception_at_once(
    run_node: Callable[..., NodeProcess]
) -> None:
    node = run_node(HEAD + """
import time
node.create_timer(0.01, lambda: (print('asleep', flush=True), time.sleep(60)))
try:
    rclpy.spin(node)
except KeyboardInterrupt:
    print('awake', flush=True)
""", 'node')
    node.wait_for('asleep')
    node.process.send_signal(signal.SIGINT)
    node.wait_for('awake', timeout=30)
