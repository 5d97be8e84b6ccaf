"""Follows the results of all solver nodes; behind `fisheye-svp watch`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.io.decoding import read_key_values
from fisheye_svp_ros.nodes.quality import RELIABLE
from fisheye_svp_ros.nodes.session import SignalHandler, start_timer

_TYPE = 'diagnostic_msgs/msg/DiagnosticArray'
_LOOK_EVERY = 0.5  # s, for nodes that are new


@dataclass
class MetricHistory:
    """What one metric of a node has been: its latest value, mean and largest magnitude."""

    latest: float = math.nan
    total: float = 0.0
    largest: float = 0.0
    count: int = 0

    def add(self, value: float) -> None:
        """Take a value in."""
        self.latest, self.count = value, self.count + 1
        self.total, self.largest = self.total + value, max(self.largest, abs(value))


@dataclass
class SolverResults:
    """What a node has told: sets it was given, sets it could not solve, its metrics.

    note: why the latest set is not solved, or what is doubtful in it.
    """

    sets: int = 0
    lost: int = 0
    note: str = ''
    metrics: dict[str, MetricHistory] = field(default_factory=dict)


class Watcher(Node):  # type: ignore[misc]
    """Subscribes to every `~/result` that appears."""

    def __init__(self) -> None:
        super().__init__('watcher')
        self.results: dict[str, SolverResults] = {}
        start_timer(self, _LOOK_EVERY, self._look)

    def spin(self, show: Callable[[], None], signals: SignalHandler) -> None:
        """Follow until a signal comes; `show` is called after whatever came."""
        executor = SingleThreadedExecutor()
        executor.add_node(self)
        signals.collect()
        while not signals.times:
            executor.spin_once(timeout_sec=_LOOK_EVERY)
            show()

    def _look(self) -> None:
        for topic, types in self.get_topic_names_and_types():
            node = topic.removesuffix('/result')
            if node != topic and node not in self.results and types == [_TYPE]:
                self.results[node] = SolverResults()
                self.create_subscription(DiagnosticArray, topic, self._hear(node), RELIABLE)

    def _hear(self, node: str) -> Callable[[DiagnosticArray], None]:
        results = self.results[node]

        def hear(message: DiagnosticArray) -> None:
            try:
                values = read_key_values(message, f'{node}/result')
                numbers = {name: float(value) for name, value in values.items()}
            except (ObservationError, ValueError):
                return
            results.sets += 1
            results.lost += not numbers
            results.note = message.status[0].message
            for name, value in numbers.items():
                if math.isfinite(value):
                    results.metrics.setdefault(name, MetricHistory()).add(value)

        return hear
