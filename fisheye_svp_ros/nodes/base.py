"""What every node shares: parameters, guarded inputs, diagnostics, how it runs."""

from __future__ import annotations

import functools
import math
import signal
import sys
import time
import traceback
from collections.abc import Callable, Mapping
from copy import copy
from typing import Any, ClassVar, TypeVar

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.msg import SetParametersResult
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from fisheye_svp_ros.errors import FisheyeSvpError, ParameterError
from fisheye_svp_ros.io.parameters import changed, rows
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.access import allowed
from fisheye_svp_ros.nodes.declaration import declare
from fisheye_svp_ros.nodes.inputs import Count, Unread, twins
from fisheye_svp_ros.nodes.timers import every
from fisheye_svp_ros.study.settings import Settings

# All topics are reliable; inputs are deep enough for what comes while a solver is busy.
RELIABLE = QoSProfile(depth=100)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
INPUT = QoSProfile(depth=1000)
SENSOR = SENSOR_INPUT = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED_INPUT = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
HEARD_LATER = QoSProfile(depth=100)

_OF_ROS = ('use_sim_time', 'start_type_description_service')
_OVERRIDDEN = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY,
               QoSPolicyKind.DURABILITY)
_TWICE = 1.0  # s between two interrupts that are one
_KINDS_OF_ERRORS = 100  # that are told from each other

T = TypeVar('T')


class Finished(Exception):
    """A node has done all that it was started for."""


class Failed(Finished):
    """A node cannot go on with what it was started for."""


class BaseNode(Node):  # type: ignore[misc]
    """A node whose parameters are the table `SETTINGS`.

    A subclass creates its topics, then calls `start()`; `configure` gets every valid new table.
    Every callback is a boundary: nothing that comes from outside ends the node.
    """

    NAME: ClassVar[str]
    SETTINGS: ClassVar[type[Settings]]

    def __init__(self) -> None:
        try:
            super().__init__(self.NAME, automatically_declare_parameters_from_overrides=True)
        except NameValidationException:  # a ValueError, too
            raise
        except ValueError as cause:  # an empty list has no type, and rclpy does not say which
            raise ParameterError(f'parameters: {cause}; a list must not be empty') from cause
        # The public way to learn what was given; what is known is declared anew, with its type.
        self.given = {name: parameter.value
                      for name, parameter in self.get_parameters_by_prefix('').items()
                      if name not in _OF_ROS}
        for name in self.given:
            self.undeclare_parameter(name)
        self.settings = declare(self, self.SETTINGS)
        self._inputs: dict[str, Count] = {}
        self._complaint = ''
        self._unforeseen: set[tuple[object, ...]] = set()
        self._failures = 0
        self._candidate: tuple[Settings, Any] | None = None
        self._waited_for: list[Any] = []
        self._diagnostics = self.announce(DiagnosticArray, '/diagnostics')
        self.every(1.0, self._publish_diagnostics)

    def start(self) -> None:
        """Take the initial parameters into use, and every later change of them.

        Raises FisheyeSvpError where they cannot be used.
        """
        self.take_up()
        self.warn_of_unknown_parameters()
        self.add_on_set_parameters_callback(self._consider)
        self.add_post_set_parameters_callback(self.guarded(self._adopt))

    def take_up(self) -> None:
        """Take the parameters as they are into use; raise FisheyeSvpError where that fails."""
        self.configure(self.prepare(self.settings))

    def prepare(self, settings: Any) -> Any:
        """Return what `configure` needs; raise FisheyeSvpError to refuse the settings."""
        return settings

    def configure(self, prepared: Any) -> None:
        """Take new settings into use; nothing in it may fail."""

    def guarded(self, callback: Callable[..., T]) -> Callable[..., T | None]:
        """Return a callback that what goes wrong in it does not get out of.

        Bad input is named in the log and on /diagnostics; an error of this package is logged with
        its traceback, once, and counted.  The callback then returns its last argument, which is
        the response of a service.
        """

        @functools.wraps(callback)
        def run(*arguments: Any) -> T | None:
            try:
                return callback(*arguments)
            except Finished:
                raise
            except FisheyeSvpError as error:
                self._complain(error)
            except Exception as error:
                self.unforeseen(error)
            return arguments[-1] if arguments else None

        return run

    def unforeseen(self, error: Exception) -> None:
        """Count an error that nobody has thought of; log it once, with its traceback."""
        if not self.context.ok():
            return  # a signal ended the context between two calls: what fails then is no failure
        self._failures += 1
        last = traceback.extract_tb(error.__traceback__)[-1:]
        kind = (type(error), *((frame.filename, frame.lineno) for frame in last))
        if kind not in self._unforeseen and len(self._unforeseen) < _KINDS_OF_ERRORS:
            self._unforeseen.add(kind)
            text = ''.join(traceback.format_exception(error)).rstrip()
            self.get_logger().error(f'internal error, told once: {text}')

    def every(self, period: float, callback: Callable[[], None], clock: Any = None) -> Any:
        """Have a function called every `period` seconds, of real time where no clock is given."""
        return every(self, period, self.guarded(callback), clock)

    def announce(self, kind: Any, topic: str, qos: Any = RELIABLE, wait: bool = False) -> Any:
        """Create a publisher; wait: it counts for `has_listeners`."""
        publisher = self._with_qos(self.create_publisher, kind, topic, qos=qos)
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
        qos: Any = INPUT,
    ) -> None:
        """Subscribe: `read` decodes a message, `use` gets its stamp (ns) and what was read.

        A message that either of them refuses is logged, dropped and counted.
        """
        self.collect(kind, topic, read, lambda stamp, unread: use(stamp, unread.read()), qos)

    def collect(
        self,
        kind: Any,
        topic: str,
        read: Callable[[Any, str], Any],
        use: Callable[[int, Unread], None],
        qos: Any = INPUT,
        volatile_qos: Any = HEARD_LATER,
    ) -> None:
        """Subscribe, as `listen` does, but leave it to `use` whether a message is decoded.

        volatile_qos: of the second subscription of what is latched.
        """
        count = self._inputs[topic] = Count()

        def receive(data: bytes) -> None:
            count.received += 1
            try:
                unread = Unread(topic, kind, bytes(data), read, count)
                use(unread.stamp, unread)
            except Finished:
                raise
            except FisheyeSvpError as error:
                self.drop(topic, error)
            except Exception as error:
                count.dropped += 1
                self.unforeseen(error)

        create = functools.partial(self._with_qos, self.create_subscription, kind, topic)
        if qos.durability != DurabilityPolicy.TRANSIENT_LOCAL:
            self.subscribe(functools.partial(create, receive, qos=qos, raw=True))
            return
        # Only what is latched comes late; only a volatile subscription hears what is not.
        latched, volatile = twins(receive)
        # The other one warns of whom neither hears.
        silent = SubscriptionEventCallbacks(use_default_callbacks=False)
        self.subscribe(functools.partial(
            create, latched, qos=qos, raw=True, event_callbacks=silent))
        self.subscribe(functools.partial(
            create, volatile, qos=volatile_qos, entity='volatile', raw=True))

    def subscribe(self, create: Callable[[], Any]) -> None:
        """Create a subscription."""
        create()

    def listens_to(self, topic: str) -> bool:
        """Say whether there is a subscription of a topic."""
        return topic in self._inputs

    def _with_qos(
        self, create: Callable[..., Any], *arguments: Any, qos: Any, entity: str | None = None,
        **more: Any,
    ) -> Any:
        """Create a publisher or subscription of which parameters may override the QoS."""
        options = QoSOverridingOptions(_OVERRIDDEN, entity_id=entity)
        try:
            # A copy, because rclpy changes the profile that it is given.
            return create(*arguments, copy(qos), qos_overriding_options=options, **more)
        except RuntimeError as cause:
            if not self.context.ok():
                raise
            raise ParameterError(f'{arguments[1]}: {cause}') from cause

    def drop(self, topic: str, error: Exception) -> None:
        """Count and log an input that cannot be used."""
        self._inputs[topic].dropped += 1
        self._complain(error)

    def _complain(self, error: Exception) -> None:
        self._complaint = str(error)
        self.get_logger().warning(f'dropped: {error}', throttle_duration_sec=1.0)

    def _consider(self, parameters: list[Any]) -> Any:
        self._candidate = None
        try:
            values = {p.name: p.value for p in parameters}
            if not values.keys() & {row.name for row in rows(self.SETTINGS)}:
                return SetParametersResult(successful=True)  # of ROS itself, such as a QoS
            for row in rows(self.SETTINGS):
                if row.file and isinstance(values.get(row.name), str):
                    allowed(values[row.name], self.settings.folder, row.name)
            settings = changed(self.settings, values)
            self._candidate = settings, self.prepare(settings)
        except FisheyeSvpError as error:
            return SetParametersResult(successful=False, reason=str(error))
        except Exception as error:
            self.unforeseen(error)
            return SetParametersResult(successful=False, reason=f'internal error: {error!r:.200}')
        return SetParametersResult(successful=True)

    def _adopt(self, parameters: list[Any]) -> None:
        if self._candidate is not None:
            self.settings, prepared = self._candidate
            self._candidate = None
            self.configure(prepared)

    def warn_of_unknown_parameters(self) -> None:
        """Warn of what was given and means nothing to this node and its topics."""
        known = ', '.join(row.name for row in rows(self.SETTINGS))
        for name in self.given:
            # Those topics come and go with what there is to tell.
            if not self.has_parameter(name) and '/metrics/' not in name:
                self.get_logger().warning(
                    f'parameter {name!r} means nothing to this node; it knows {known}'
                )

    def report(self) -> tuple[Mapping[str, object], str]:
        """Return what else there is to count, and what is wrong right now."""
        return {}, ''

    def _publish_diagnostics(self) -> None:
        counts: dict[str, object] = {}
        for topic, count in self._inputs.items():
            counts |= {f'{topic}: received': count.received, f'{topic}: read': count.read,
                       f'{topic}: dropped': count.dropped}
        more, trouble = self.report()
        now = self.get_clock().now().nanoseconds
        trouble = trouble or ('' if now else 'use_sim_time is true, but /clock has no time yet')
        text = trouble or self._complaint
        level = DiagnosticStatus.WARN if text else DiagnosticStatus.OK
        text, self._complaint = text or 'all inputs usable', ''  # what it was is in the counts
        if self._failures:
            level, text = DiagnosticStatus.ERROR, f'{self._failures} internal errors; {text}'
        name = f'{self.get_fully_qualified_name()}: inputs'
        self._diagnostics.publish(messages.key_values_message(
            name, {**counts, **more, 'internal errors': self._failures}, now, text, level))


def run(kind: type[BaseNode], args: list[str] | None = None) -> int:
    """Spin a node until it ends; return the exit status, 2 for unusable arguments."""
    signal.signal(signal.SIGINT, _interrupting_without_echo())
    try:
        try:
            rclpy.init(args=args)
        except Exception as error:
            return _refuse(kind, f'ROS arguments or environment: {error}')
        return _run(kind)
    except KeyboardInterrupt:
        return 0


def _interrupting_without_echo() -> Callable[..., None]:
    """Return a handler: below `ros2 launch` Ctrl-C comes twice, from the terminal and from launch.

    The second one would end what the first one has begun to put away.  A later one counts again:
    the first is lost where C code calls Python and drops its exceptions.
    """
    last = -math.inf

    def interrupt(*_: Any) -> None:
        nonlocal last
        before, last = last, time.monotonic()
        if last - before > _TWICE:
            raise KeyboardInterrupt

    return interrupt


def _run(kind: type[BaseNode]) -> int:
    node = None
    try:
        node = kind()
        _spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except Failed as error:
        return _refuse(kind, error)
    except Finished:
        pass
    except (FisheyeSvpError, ParameterException, NameValidationException) as error:
        return _refuse(kind, error)
    except Exception:
        # A signal ends the context between any two calls; what fails then is no failure.
        if rclpy.ok():
            raise
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


def _spin(node: BaseNode) -> None:
    while rclpy.ok():
        try:
            rclpy.spin(node)
        except (ExternalShutdownException, Finished):
            raise
        except Exception as error:  # of the client library, about what came over the wire
            node.unforeseen(error)


def _refuse(kind: type[BaseNode], error: Exception | str) -> int:
    print(f'{kind.NAME}: {" ".join(str(error).split())}', file=sys.stderr)
    return 2
