"""What every node shares: parameters, guarded inputs, diagnostics, main()."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from fisheye_svp_ros.errors import FisheyeSvpError
from fisheye_svp_ros.io.clouds import stamp_of
from fisheye_svp_ros.io.parameters import Row, changed, rows
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.study.settings import Settings

# All topics are reliable; deep enough for a burst of inputs while a solver is busy.
RELIABLE = QoSProfile(depth=100)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
LATCHED_INPUT = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)


S = TypeVar('S', bound=Settings)
T = TypeVar('T')


@dataclass
class _Input:
    received: int = 0
    dropped: int = 0


class Finished(Exception):
    """A node has done all that it was started for."""


class BaseNode(Node):  # type: ignore[misc]
    """A node whose parameters are the table `SETTINGS`.

    A subclass creates its topics, then calls `start()`; `configure` gets every valid new table.
    """

    NAME: ClassVar[str]
    SETTINGS: ClassVar[type[Settings]]

    def __init__(self) -> None:
        super().__init__(self.NAME)
        self.settings = declare(self, self.SETTINGS)
        self._inputs: dict[str, _Input] = {}
        self._complaint = ''
        self._candidate: tuple[Settings, Any] | None = None
        self._waited_for: list[Any] = []
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', RELIABLE)
        self.create_timer(1.0, self._publish_diagnostics)

    def start(self) -> None:
        """Take the initial parameters into use, and every later change of them.

        Raises FisheyeSvpError where they cannot be used.
        """
        self._warn_of_unknown_parameters()
        self.configure(self.prepare(self.settings))
        self.add_on_set_parameters_callback(self._consider)
        self.add_post_set_parameters_callback(self._adopt)

    def prepare(self, settings: Any) -> Any:
        """Return what `configure` needs; raise FisheyeSvpError to refuse the settings."""
        return settings

    def configure(self, prepared: Any) -> None:
        """Take new settings into use."""

    def knows(self, parameter: str) -> bool:
        """Say whether a parameter given from outside means something to this node."""
        return bool(self.has_parameter(parameter))

    def announce(self, kind: Any, topic: str, qos: Any = RELIABLE, wait: bool = False) -> Any:
        """Create a publisher; wait: it counts for `has_listeners`."""
        publisher = self.create_publisher(kind, topic, qos)
        if wait:
            self._waited_for.append(publisher)
        return publisher

    def has_listeners(self) -> bool:
        """Say whether as many subscriptions are there as the parameters ask for."""
        wanted = self.settings.wait_for_subscribers
        return not wanted or all(p.get_subscription_count() >= wanted for p in self._waited_for)

    def listen(
        self,
        kind: Any,
        topic: str,
        read: Callable[[Any, str], T],
        use: Callable[[int, T], None],
        qos: Any = RELIABLE,
    ) -> None:
        """Subscribe: `read` decodes a message, `use` gets its stamp (ns) and what was read.

        A message that either of them refuses is logged, dropped and counted.
        """
        self._inputs[topic] = _Input()

        def receive(message: Any) -> None:
            self._inputs[topic].received += 1
            try:
                use(stamp_of(message), read(message, topic))
            except FisheyeSvpError as error:
                self.drop(topic, error)

        self.create_subscription(kind, topic, receive, qos)

    def drop(self, topic: str, error: FisheyeSvpError) -> None:
        """Count and log an input that cannot be used."""
        self._inputs[topic].dropped += 1
        self._complaint = str(error)
        self.get_logger().warning(f'dropped: {error}', throttle_duration_sec=1.0)

    def _consider(self, parameters: list[Any]) -> Any:
        try:
            settings = changed(self.settings, {p.name: p.value for p in parameters})
            self._candidate = settings, self.prepare(settings)
        except FisheyeSvpError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _adopt(self, parameters: list[Any]) -> None:
        if self._candidate is not None:
            self.settings, prepared = self._candidate
            self._candidate = None
            self.configure(prepared)

    def _warn_of_unknown_parameters(self) -> None:
        known = ', '.join(row.name for row in rows(self.SETTINGS))
        for name in self._parameter_overrides:
            if not (self.knows(name) or name.startswith('qos_overrides.')):
                self.get_logger().warning(
                    f'parameter {name!r} means nothing to this node; it knows {known}'
                )

    def _publish_diagnostics(self) -> None:
        counts: dict[str, object] = {}
        for topic, count in self._inputs.items():
            counts |= {f'{topic}: received': count.received, f'{topic}: dropped': count.dropped}
        bad = any(count.dropped for count in self._inputs.values())
        name = f'{self.get_fully_qualified_name()}: inputs'
        text = self._complaint if bad else 'all inputs usable'
        now = self.get_clock().now().nanoseconds
        self._diagnostics.publish(messages.key_values_message(name, counts, now, text, bad))


def declare(node: Any, kind: type[S]) -> S:
    """Declare every row of a table on a node, and return the values it starts with.

    Raises ParameterError for a value that is not allowed; rclpy's own errors for a wrong type.
    """
    values = {}
    for row in rows(kind):
        default = list(row.default) if isinstance(row.default, tuple) else row.default
        values[row.name] = node.declare_parameter(row.name, default, descriptor(row)).value
    return changed(kind(), values)


def descriptor(row: Row) -> Any:
    """Return the ParameterDescriptor of a row."""
    unit = f' [{row.unit}]' if row.unit else ''
    message = ParameterDescriptor(name=row.name, description=row.description + unit)
    # A parameter of one type would not let both `auto` and YAML's true be given.
    message.dynamic_typing = row.takes_booleans
    if row.choices:
        message.additional_constraints = row.constraint()
    if row.low is None or row.high is None:
        return message
    if isinstance(row.default, int):
        limits = IntegerRange(from_value=int(row.low), to_value=int(row.high))
        message.integer_range = [limits]
    else:
        limits = FloatingPointRange(from_value=float(row.low), to_value=float(row.high))
        message.floating_point_range = [limits]
    return message


def run(kind: type[BaseNode], args: list[str] | None = None) -> int:
    """Spin a node until it ends; return the exit status, 2 for unusable parameters."""
    node = None
    try:
        rclpy.init(args=args)
        node = kind()
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException, Finished):
        pass
    except (FisheyeSvpError, ParameterException) as error:
        print(f'{kind.NAME}: {error}', file=sys.stderr)
        return 2
    except Exception:
        # A signal ends the context between any two calls; what fails then is no failure.
        if rclpy.ok():
            raise
    finally:
        # Below `ros2 launch` Ctrl-C comes twice, from the terminal and from launch.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0
