"""Writes topics to a recording as they appear; behind `fisheye-svp record`."""

from __future__ import annotations

import re
import signal
import time
from importlib import import_module

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from fisheye_svp_ros.bags import BagWriter

_COUNTED = ('/image_points', '/result')
_LATCHED = ('landmarks', 'camera_info', 'rig')
_LOOK_EVERY = 0.2  # s, for topics that are new
_QUIET = 0.5  # s without a message after which nothing is on its way any more


class Recorder(Node):  # type: ignore[misc]
    """Subscribes to the topics of a pattern and writes what comes on them."""

    def __init__(self, bag: BagWriter, wanted: re.Pattern[str]) -> None:
        super().__init__('recorder')
        self.topics: set[str] = set()
        self._bag = bag
        self._wanted = wanted
        self.create_timer(_LOOK_EVERY, self._look)

    def spin(self) -> None:
        """Record until SIGINT or SIGTERM, and then until nothing more arrives."""
        executor, ended = SingleThreadedExecutor(), []
        executor.add_node(self)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: ended.append(True))
        while not ended:
            executor.spin_once(timeout_sec=_LOOK_EVERY)
        last, count = time.monotonic(), self._bag.count
        while time.monotonic() - last < _QUIET:
            executor.spin_once(timeout_sec=_QUIET)
            if self._bag.count > count:
                last, count = time.monotonic(), self._bag.count

    def _look(self) -> None:
        # A node that waits for its listeners counts those of image_points or ~/result: when it
        # sees this node there, this node must be on its other topics already.
        found = self.get_topic_names_and_types()
        for topic, types in sorted(found, key=lambda entry: entry[0].endswith(_COUNTED)):
            if topic not in self.topics and self._wanted.fullmatch(topic) and len(types) == 1:
                self._subscribe(topic, types[0])

    def _subscribe(self, topic: str, typename: str) -> None:
        latched = topic.rpartition('/')[2] in _LATCHED
        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        package, _, name = typename.split('/')
        self.create_subscription(
            getattr(import_module(f'{package}.msg'), name),
            topic,
            lambda data: self._bag.write(topic, typename, data),
            QoSProfile(depth=1000, durability=durability),
            raw=True,
        )
        self.topics.add(topic)
