"""What every node shares: parameters, guarded inputs, diagnostics; what managed nodes add."""

from __future__ import annotations

import functools
import re
import time
import traceback
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, TypeVar

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.msg import SetParametersResult
from rclpy.exceptions import NameValidationException
from rclpy.lifecycle import LifecycleNodeMixin, TransitionCallbackReturn
from rclpy.node import Node

from fisheye_svp_ros.errors import FisheyeSvpError, ParameterError
from fisheye_svp_ros.io.parameters import rows, with_values
from fisheye_svp_ros.io.share import expand_path
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.declaration import (
    check_access,
    declare,
    unknown_parameters,
    with_declared_types,
)
from fisheye_svp_ros.nodes.quality import INPUT, RELIABLE, create_with_qos
from fisheye_svp_ros.nodes.session import start_timer
from fisheye_svp_ros.nodes.subscriptions import (
    LIMIT,
    Input,
    Unread,
    explain_silence,
    silent_inputs,
)
from fisheye_svp_ros.reporting.wording import inputs as wording
from fisheye_svp_ros.study.settings import Settings, SolverSettings

# What one reason is told with, and another time otherwise: names, numbers, lists of them.
_DETAIL = re.compile(r"'[^']*'|[-+]?\d[\d.]*(e[-+]?\d+)?")
_KEY_LENGTH = 60  # characters: more is a list
_MAX_SLOTS = 20  # in one report
_MAX_LOGGED = 200  # slots of which it is known when they were logged
_OF_ROS = ('use_sim_time', 'start_type_description_service')
_KINDS_OF_ERRORS = 100  # that are told from each other
_REPORT_PERIOD = 1.0  # s, on /diagnostics
T = TypeVar('T')


class Complaints:
    """Texts since the last report: no reason hides another, and each is logged now and then.

    log: writes a line.
    """

    def __init__(self, log: Callable[[str], object]) -> None:
        self._log = log
        self._texts: dict[str, str] = {}
        self._logged: OrderedDict[str, float] = OrderedDict()  # s, by slot

    def add(self, text: str, period: float, prefix: str = '') -> None:
        """Take a text up; log it with a prefix, once in `period` seconds.

        The text begins with its topic, the rest is the reason.
        """
        slot = _DETAIL.sub('#', text)[:_KEY_LENGTH]
        if slot in self._texts or len(self._texts) < _MAX_SLOTS:
            self._texts[slot] = text
        now = time.monotonic()
        if now - self._logged.get(slot, -period) < period:
            return
        self._logged[slot] = now
        self._logged.move_to_end(slot)
        if len(self._logged) > _MAX_LOGGED:
            self._logged.popitem(last=False)
        self._log(f'{prefix}{text}')

    def collect(self) -> list[str]:
        """Return the texts since the last time, in the order in which their slots began."""
        texts, self._texts = [*self._texts.values()], {}
        return texts


class NodeExit(Exception):
    """A node has done all that it was started for."""


class NodeFailure(NodeExit):
    """A node cannot go on with what it was started for."""


class BaseNode(Node):  # type: ignore[misc]
    """A node whose parameters are the table `SETTINGS`.

    A subclass creates its topics, then calls `start()`; `configure` gets every valid new table.
    Every callback is a boundary: nothing that comes from outside ends the node.
    """

    NAME: ClassVar[str]
    SETTINGS: ClassVar[type[Settings]]

    def __init__(self, node_name: str | None = None, **options: Any) -> None:
        """Create the node; options: as those of rclpy.node.Node, such as its namespace."""
        try:
            super().__init__(
                node_name or self.NAME,
                automatically_declare_parameters_from_overrides=True,
                **options,
            )
        except NameValidationException:  # a ValueError, too
            raise
        except ValueError as cause:  # an empty list has no type, and rclpy does not say which
            raise ParameterError(f'parameters: {cause}; a list must not be empty') from cause
        # The public way to learn what was given; what is known is declared anew, with its type.
        self.given = {
            name: parameter.value
            for name, parameter in self.get_parameters_by_prefix('').items()
            if name not in _OF_ROS
        }
        for name in self.given:
            self.undeclare_parameter(name)
        self.settings = declare(self, self.SETTINGS, self.given)
        self._inputs: dict[str, Input] = {}
        self.unread: list[Any] = []  # what else has messages to `take` before a set is solved
        self._silences: set[tuple[str, str]] = set()
        self._complaints = Complaints(self.get_logger().warning)
        self._unforeseen: set[tuple[object, ...]] = set()
        self._failures = 0
        self._candidate: tuple[Settings, Any] | None = None
        self._waited_for: list[Any] = []
        self._diagnostics = self.announce(DiagnosticArray, '/diagnostics')
        self.start_timer(_REPORT_PERIOD, self._publish_diagnostics)

    def start(self) -> None:
        """Take the initial parameters into use, and every later change of them.

        Raises FisheyeSvpError where they cannot be used.
        """
        self.take_up()
        self.introduce()
        self.add_pre_set_parameters_callback(functools.partial(with_declared_types, self))
        self.add_on_set_parameters_callback(self._consider)
        self.add_post_set_parameters_callback(self.guard_callback(self._adopt))

    def take_up(self) -> None:
        """Take the parameters as they are into use; raise FisheyeSvpError where that fails."""
        self.configure(self.prepare(self.settings))

    def prepare(self, settings: Any) -> Any:
        """Return what `configure` needs; raise FisheyeSvpError to refuse the settings."""
        return settings

    def configure(self, prepared: Any) -> None:
        """Take new settings into use; nothing in it may fail."""

    def set_parameters_atomically(self, parameter_list: list[Any]) -> Any:
        """Set all parameters or none; say of one that is fixed how to change it."""
        result = super().set_parameters_atomically(parameter_list)
        if not result.successful and 'read-only' in result.reason:
            result.reason = (
                f'{result.reason} It is read at the start: restart the node with -p NAME:=VALUE'
            )
        return result

    def set_parameters(self, parameter_list: list[Any]) -> list[Any]:
        """Set parameters one by one."""
        return [self.set_parameters_atomically([one]) for one in parameter_list]

    def guard_callback(self, callback: Callable[..., T]) -> Callable[..., T | None]:
        """Return a callback that what goes wrong in it does not get out of.

        Bad input is named in the log and on /diagnostics; an error of this package is logged with
        its traceback, once, and counted.  The callback then returns its last argument, which is
        the response of a service.
        """

        @functools.wraps(callback)
        def run(*arguments: Any) -> T | None:
            try:
                return callback(*arguments)
            except NodeExit:
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
            self.get_logger().error(f'internal error, logged once: {text}')

    def start_timer(self, period: float, callback: Callable[[], None], clock: Any = None) -> Any:
        """Have a function called every `period` seconds, of real time where no clock is given."""
        return start_timer(self, period, self.guard_callback(callback), clock)

    def announce(self, kind: Any, topic: str, qos: Any = RELIABLE, wait: bool = False) -> Any:
        """Create a publisher; wait: it counts for `has_listeners`."""
        publisher = create_with_qos(self, self.create_publisher, kind, topic, qos=qos)
        if wait:
            self._waited_for.append(publisher)
        return publisher

    def has_listeners(self) -> bool:
        """Say whether as many subscriptions are there as the parameters ask for."""
        return not self.unheard_topics()

    def unheard_topics(self) -> list[str]:
        """Return the topics with fewer subscriptions than the parameters ask for."""
        wanted = self.settings.wait_for_subscribers
        return [
            one.topic_name
            for one in self._waited_for
            if wanted and one.get_subscription_count() < wanted
        ]

    def listen(
        self,
        kind: Any,
        topic: str,
        read: Callable[[Any, str], T],
        use: Callable[[int, T], None],
        latched: bool = False,
    ) -> None:
        """Subscribe: `read` decodes a message, `use` gets its stamp (ns) and what was read.

        A message that either of them refuses is logged, dropped and counted.  latched: what was
        published before counts as well.
        """
        self.collect(
            kind, topic, read, lambda stamp, unread: use(stamp, unread.read()), latched=latched
        )

    def collect(
        self,
        kind: Any,
        topic: str,
        read: Callable[[Any, str], Any],
        use: Callable[[int, Unread], None],
        qos: Any = INPUT,
        latched: bool = False,
        name: str = '',
    ) -> None:
        """Subscribe, as `listen` does, but leave it to `use` whether a message is decoded.

        name: of the topic where it is not what the node calls it.
        """

        def receive(data: bytes) -> None:
            count = self._inputs[topic].count
            count.received += 1
            try:
                unread = Unread(topic, kind, bytes(data), read, count)
                use(unread.stamp, unread)
            except NodeExit:
                raise
            except FisheyeSvpError as error:
                self.drop(topic, error)
            except Exception as error:
                count.dropped += 1
                self.unforeseen(error)

        self._inputs[topic] = Input(self, kind, name or topic, receive, qos, latched)
        if self.listening:
            self._inputs[topic].subscribe()

    def after_message(self) -> None:
        """Do what there is to do once the executor has brought a message, by then taken in."""

    @property
    def listening(self) -> bool:
        """Whether the node listens to its inputs now."""
        return True

    def listens_to(self, topic: str) -> bool:
        """Say whether there is a subscription of a topic."""
        return topic in self._inputs

    def needed_inputs(self) -> Sequence[Sequence[str]]:
        """Return the topics without which there is nothing to do: one of each group."""
        return [(topic,) for topic in self._inputs]

    def drop(self, topic: str, error: Exception) -> None:
        """Count and log a message that cannot be used."""
        self._inputs[topic].count.dropped += 1
        self._complain(error)

    def warn(self, text: str) -> None:
        """Log a warning, and say it in the next report on /diagnostics."""
        self._complaints.add(text, 10.0)

    def _complain(self, error: Exception, prefix: str = 'dropped: ') -> None:
        self._complaints.add(str(error), 1.0, prefix)

    def _consider(self, parameters: list[Any]) -> Any:
        self._candidate = None
        try:
            values = {p.name: p.value for p in parameters}
            if not values.keys() & {row.name for row in rows(self.SETTINGS)}:
                return SetParametersResult(successful=True)  # of ROS itself, such as a QoS
            for row in rows(self.SETTINGS):
                if row.file and isinstance(values.get(row.name), str):
                    path = expand_path(values[row.name])
                    check_access(path, self.settings.folder, row.name)
            settings = with_values(self.settings, values)
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

    def introduce(self) -> None:
        """Say what the node listens to; warn of what was given and means nothing to it."""
        if self._inputs:
            topics = sorted(subscription.resolved for subscription in self._inputs.values())
            self.get_logger().info(f'listening to {", ".join(topics)}')
        names = [row.name for row in rows(self.SETTINGS)]
        for text in unknown_parameters(self, self.given, names):
            self.get_logger().warning(text)

    def report(self) -> tuple[Mapping[str, object], str]:
        """Return what else there is to count, and what is wrong right now."""
        return {}, ''

    def _publish_diagnostics(self) -> None:
        counts: dict[str, object] = {}
        for topic, one in self._inputs.items():
            counts |= {
                f'{topic}: received': one.count.received,
                f'{topic}: read': one.count.read,
                f'{topic}: dropped': one.count.dropped,
                f'{topic}: lost': one.count.lost,
            }
            one.adapt()
            if losses := one.losses():
                self.warn(losses)
        more, trouble = self.report()
        now = self.get_clock().now().nanoseconds
        clock = '' if now else 'use_sim_time is true, but /clock has no time yet'
        troubles = [trouble, clock, *self._complaints.collect(), self._explain_silence()]
        text = '; '.join(dict.fromkeys(filter(None, troubles)))
        level = DiagnosticStatus.WARN if text else DiagnosticStatus.OK
        text = text or 'all inputs usable'
        if self._failures:
            level, text = DiagnosticStatus.ERROR, f'{self._failures} internal errors; {text}'
        name = f'{self.get_fully_qualified_name()}: inputs'
        self._diagnostics.publish(
            messages.key_values_message(
                name, {**counts, **more, 'internal errors': self._failures}, now, text, level
            )
        )

    def _explain_silence(self) -> str:
        """Say what does not come, or comes no more; log it once, until it comes again."""
        texts, reasons = [], set()
        for ones in silent_inputs(self.needed_inputs(), self._inputs, LIMIT):
            start, reason = explain_silence(self, ones)
            texts.append(f'{start}: {reason}')
            reasons.add((ones[0].resolved, reason))
            if (ones[0].resolved, reason) not in self._silences:
                self.get_logger().warning(texts[-1])
        self._silences = reasons
        return '; '.join(texts)


class ManagedNode(LifecycleNodeMixin, BaseNode):  # type: ignore[misc]
    """A node that, with the parameter `lifecycle`, waits to be configured and activated.

    Configure loads the lens, activate listens.  Without it nothing here makes a difference.
    """

    settings: SolverSettings

    def __init__(self, node_name: str | None = None, **options: Any) -> None:
        BaseNode.__init__(self, node_name, **options)
        self._active = self._configured = not self.settings.lifecycle
        if self.settings.lifecycle:
            LifecycleNodeMixin.__init__(self)

    @property
    def listening(self) -> bool:
        """Whether the node is active."""
        return self._active

    def take_up(self) -> None:
        """Take the initial parameters into use, unless `on_configure` is to do it."""
        if not self.settings.lifecycle:
            super().take_up()

    def introduce(self) -> None:
        """Say what the node listens to, or what has to be done before it does."""
        if self._active:
            super().introduce()
        else:
            self.get_logger().info(self.inactive_reason())

    def inactive_reason(self) -> str:
        """Say that the node listens to nothing, and what to do."""
        return wording.inactive(self.get_fully_qualified_name(), self._configured)

    def has_listeners(self) -> bool:
        """Say whether there is anybody to work for; there is nobody for an inactive node."""
        return self._active and super().has_listeners()

    def on_configure(self, state: Any) -> Any:
        """Load the lens; the node stays unconfigured where that fails."""
        try:
            super().take_up()
        except FisheyeSvpError as error:
            self.get_logger().error(f'not configured: {error}')
            return TransitionCallbackReturn.FAILURE
        self._configured = True
        return super().on_configure(state)

    def on_cleanup(self, state: Any) -> Any:
        """Be as before it was configured."""
        self._configured = False
        return super().on_cleanup(state)

    def on_activate(self, state: Any) -> Any:
        """Listen."""
        self._active = True
        for subscription in self._inputs.values():
            subscription.subscribe()
        self.introduce()
        return super().on_activate(state)

    def on_deactivate(self, state: Any) -> Any:
        """Listen no more."""
        self._fall_silent()
        return super().on_deactivate(state)

    def on_shutdown(self, state: Any) -> Any:
        """Listen no more, for good."""
        self._fall_silent()
        return super().on_shutdown(state)

    def _fall_silent(self) -> None:
        self._active = False
        for subscription in self._inputs.values():
            subscription.unsubscribe()
