"""Nodes and a probe in the process of the test, spun by one executor."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from helpers.nodes import TIMEOUT, need_ros

need_ros()

import rclpy  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile  # noqa: E402

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402  # isort: skip
from geometry_msgs.msg import PoseWithCovarianceStamped  # noqa: E402  # isort: skip
from sensor_msgs.msg import PointCloud2  # noqa: E402  # isort: skip

from fisheye_svp_ros.io.decoding import stamp_of  # noqa: E402
from fisheye_svp_ros.io.landmark_files import environment  # noqa: E402
from fisheye_svp_ros.nodes import messages  # noqa: E402
from fisheye_svp_ros.nodes.localizer import Localizer  # noqa: E402

RELIABLE = QoSProfile(depth=1000)
LATCHED = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Graph:
    """Nodes under test; arguments as after `--ros-args`."""

    def __init__(self, *arguments: str) -> None:
        rclpy.init(args=['--ros-args', *arguments])
        self.executor = SingleThreadedExecutor()
        self.probe = self.add(Node('probe'))
        self._publishers: list[Any] = []
        self._nodes: list[Any] = [self.probe]

    def add(self, node: Any) -> Any:
        """Run a node from now on."""
        self.executor.add_node(node)
        return node

    def start(self, kind: Callable[[], Any]) -> Any:
        """Create a node and run it."""
        node = self.add(kind())
        self._nodes.append(node)
        return node

    def hear(self, kind: Any, topic: str, qos: Any = RELIABLE) -> list[Any]:
        """Return a list that fills with the messages of a topic."""
        heard: list[Any] = []
        self.probe.create_subscription(kind, topic, heard.append, qos)
        return heard

    def tell(self, kind: Any, topic: str, qos: Any = RELIABLE) -> Any:
        """Return a publisher that is connected."""
        publisher = self.probe.create_publisher(kind, topic, qos)
        self._publishers.append(publisher)
        self.until(lambda: publisher.get_subscription_count() > 0)
        return publisher

    def until(self, condition: Callable[[], Any], timeout: float = TIMEOUT) -> Any:
        """Spin until a condition holds; return its answer, fail after a while."""
        end = time.monotonic() + timeout
        while time.monotonic() < end:
            if answer := condition():
                return answer
            # Not after each message: conditions that publish would have nodes do nothing else.
            self.idle(0.02)
        raise AssertionError('nothing happened in time')

    def idle(self, seconds: float) -> None:
        """Spin for a while, for what must not happen."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.02)  # another one each time would starve nodes

    def close(self) -> None:
        """End all nodes."""
        for node in self._nodes:
            self.executor.remove_node(node)
            node.destroy_node()
        self.executor.shutdown()
        rclpy.try_shutdown()


class HeardLocalizer:
    """A localizer, what it publishes, and publishers of what it gets."""

    def __init__(self, g: Graph) -> None:
        self.graph = g
        self.results = g.hear(DiagnosticArray, 'localizer/result')
        self.poses = g.hear(PoseWithCovarianceStamped, 'localizer/pose')
        self.reports = g.hear(DiagnosticArray, '/diagnostics')
        self.node = g.start(Localizer)
        self.landmarks = g.tell(PointCloud2, 'landmarks', LATCHED)
        self.points = g.tell(PointCloud2, 'image_points')
        g.until(lambda: self.node._result.get_subscription_count() > 0)


class FedLocalizer(HeardLocalizer):
    """A localizer that gets the landmarks of Kita's environment, and image points set by set."""

    def __init__(self, g: Graph) -> None:
        super().__init__(g)
        self.landmarks.publish(messages.landmarks_message(environment('whole', 2.0), 0, 'map'))

    def feed(self, stamp: int, landmark: Any, uv: Any, frame: str) -> None:
        """Publish a set of image points."""
        self.points.publish(messages.image_points_message(landmark, uv, stamp, frame))

    def status(self, stamp: int) -> Any:
        """Return the result of a set, once it is there."""
        result = self.graph.until(
            lambda: next((m for m in self.results if stamp_of(m) == stamp), None)
        )
        return result.status[0]


def set_parameter(node: Any, name: str, value: Any) -> Any:
    """Set a parameter as `ros2 param set` does, and return the result with its reason."""
    (result,) = node.set_parameters([Parameter(name, value=value)])
    return result
