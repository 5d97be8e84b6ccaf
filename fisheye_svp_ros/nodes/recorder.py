"""Writes topics to a recording as they appear; behind `fisheye-svp record`."""

from __future__ import annotations

import re
import signal
import time
from importlib import import_module

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from fisheye_svp_ros.io.bags import BagWriter

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
        self._timer = self.create_timer(_LOOK_EVERY, self._look)

    def spin(self) -> None:
        """Record until SIGINT or SIGTERM, and then until nothing more arrives."""
        executor, ended = SingleThreadedExecutor(), []
        executor.add_node(self)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: ended.append(True))
        while not ended:
            executor.spin_once(timeout_sec=_LOOK_EVERY)
        self._timer.cancel()
        # Only a whole wait that brought nothing says so: this process may have been held up.
        waited, count = 0.0, -1
        while waited < _QUIET or self._bag.count > count:
            start, count = time.monotonic(), self._bag.count
            executor.spin_once(timeout_sec=_QUIET)
            waited = time.monotonic() - start

    def _look(self) -> None:
        # A node that waits for its listeners counts those of image_points or ~/result: when it
        # sees this node there, this node must be on its other topics already.  That topic is the
        # last a node publishes, so where its publisher is known, those found now are all.
        names = [name for name, _ in self.get_topic_names_and_types()]
        complete = {name for name in names
                    if name.endswith(_COUNTED) and self.count_publishers(name)}
        found = self.get_topic_names_and_types()
        for topic, types in sorted(found, key=lambda entry: entry[0].endswith(_COUNTED)):
            if topic in self.topics or (topic.endswith(_COUNTED) and topic not in complete):
                continue
            if self._wanted.fullmatch(topic) and len(types) == 1:
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
