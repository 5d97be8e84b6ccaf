"""Writes topics to a recording as they appear; behind `fisheye-svp record`."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from importlib import import_module
from typing import Any

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from fisheye_svp_ros.io.bags import BagWriter, OfferedQos
from fisheye_svp_ros.nodes.session import SignalHandler, start_timer

_COUNTED_TOPICS = ('/image_points', '/result')
_LOOK_EVERY = 0.2  # s, for topics that are new
_FLUSH_EVERY = 1.0  # s; a crash loses no more
_IDLE_TIME = 0.5  # s without a message after which nothing is on its way any more
_MAX_WAIT = 2.0  # s to wait for that


class Recorder(Node):  # type: ignore[misc]
    """Subscribes to the topics of a pattern and writes what comes on them."""

    def __init__(self, bag: BagWriter, wanted: re.Pattern[str]) -> None:
        super().__init__('recorder')
        self.topics: set[str] = set()
        self._bag = bag
        self._wanted = wanted
        self._warned: set[str] = set()
        start_timer(self, _LOOK_EVERY, self._look)
        start_timer(self, _FLUSH_EVERY, bag.flush)

    def spin(self, signals: SignalHandler) -> None:
        """Record until a signal comes, and then what is on its way; a second one ends that."""
        executor, quiet = SingleThreadedExecutor(), False
        executor.add_node(self)
        signals.collect()
        while not signals.times:
            executor.spin_once(timeout_sec=_LOOK_EVERY)
        for timer in self.timers:
            timer.cancel()
        while len(signals.times) == 1 and not quiet:
            # Only a whole wait that brought nothing says so: this process may have been held up.
            # Where others go on publishing, it is enough that nothing waits to be taken.
            start, count = time.monotonic(), self._bag.count
            patience = _IDLE_TIME if start - signals.times[0] < _MAX_WAIT else 0.0
            executor.spin_once(timeout_sec=patience)
            quiet = self._bag.count == count and time.monotonic() - start >= patience

    def _look(self) -> None:
        # A node that waits for its listeners counts those of image_points or ~/result: when it
        # sees this node there, this node must be on its other topics already.  That topic is the
        # last a node publishes, so where its publisher is known, those found now are all.
        names = [name for name, _ in self.get_topic_names_and_types()]
        complete = {
            name
            for name in names
            if name.endswith(_COUNTED_TOPICS) and self.count_publishers(name)
        }
        found = self.get_topic_names_and_types()
        for topic, types in sorted(found, key=lambda entry: entry[0].endswith(_COUNTED_TOPICS)):
            if topic in self.topics or (topic.endswith(_COUNTED_TOPICS) and topic not in complete):
                continue
            if self._wanted.fullmatch(topic):
                self._take(topic, types)

    def _take(self, topic: str, types: Sequence[str]) -> None:
        """Record a topic once somebody publishes on it; warn, once, where that is impossible."""
        publishers = self.get_publishers_info_by_topic(topic)
        for typename in types:
            offered = [
                OfferedQos(
                    publisher.qos_profile.reliability != ReliabilityPolicy.BEST_EFFORT,
                    publisher.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL,
                )
                for publisher in publishers
                if publisher.topic_type == typename
            ]
            if not offered:
                continue
            try:
                package, _, name = typename.split('/')
                kind = getattr(import_module(f'{package}.msg'), name)
                self._subscribe(topic, kind, typename, offered)
            except Exception as error:  # a stranger's topic may have any name and any type
                self._warn(f'{topic}: {typename} is not recorded ({error!r:.200})')
                continue
            self.topics.add(topic)
            if len(types) > 1:
                self._warn(f'{topic}: of {", ".join(types)} only {typename} is recorded')
            return

    def _subscribe(
        self, topic: str, kind: Any, typename: str, offered: Sequence[OfferedQos]
    ) -> None:
        self._bag.add(topic, typename, offered)
        # What everybody offers is asked for; who asks for more does not hear the others.
        latched, reliable = (
            all(values) for values in ([o.latched for o in offered], [o.reliable for o in offered])
        )
        self.create_subscription(
            kind,
            topic,
            lambda data: self._bag.write(topic, typename, data),
            QoSProfile(
                depth=1000,
                durability=DurabilityPolicy.TRANSIENT_LOCAL
                if latched
                else DurabilityPolicy.VOLATILE,
                reliability=ReliabilityPolicy.RELIABLE
                if reliable
                else ReliabilityPolicy.BEST_EFFORT,
            ),
            raw=True,
        )

    def _warn(self, text: str) -> None:
        if text not in self._warned:
            self._warned.add(text)
            self.get_logger().warning(text)
