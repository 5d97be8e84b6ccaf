"""Nodes and what they are made of: `rclpy.node`, `rclpy.publisher`, `rclpy.timer` and so on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from copy import copy
from typing import Any

from fisheye_svp_ros.standalone import dds, logging, names
from fisheye_svp_ros.standalone.clock import Clock, ClockType, Time
from fisheye_svp_ros.standalone.context import get_default_context
from fisheye_svp_ros.standalone.entities import (
    GuardCondition,
    Publisher,
    Service,
    Subscription,
    Timer,
)
from fisheye_svp_ros.standalone.exceptions import (
    NotInitializedException,
    NotSupportedError,
)
from fisheye_svp_ros.standalone.messages import Message, message_class
from fisheye_svp_ros.standalone.parameter_services import ParameterServices
from fisheye_svp_ros.standalone.parameters import ParameterHolder
from fisheye_svp_ros.standalone.qos import (
    QoSOverridingOptions,
    QoSProfile,
    SubscriptionEventCallbacks,
    TopicEndpointInfo,
    policy_text,
    policy_value,
    profile,
    qos_profile_parameter_events,
    qos_profile_rosout_default,
    qos_profile_services_default,
)


class Node(ParameterHolder):
    """A participant in the ROS graph: name, parameters, publishers, subscriptions, services."""

    def __init__(
        self,
        node_name: str,
        *,
        namespace: str = '/',
        automatically_declare_parameters_from_overrides: bool = False,
    ) -> None:
        self.context = get_default_context()
        if not self.context.ok():
            raise NotInitializedException('cannot create a node before rclpy.init()')
        arguments = self.context.arguments
        self.__rules = arguments.rules
        given = names.node_name(node_name), names.namespace(namespace)
        self.__name, self.__namespace = names.remap_node(self.__rules, *given)
        overrides = arguments.overrides(self.get_fully_qualified_name())
        super().__init__(overrides)
        self._publishers: list[Publisher] = []
        self._subscriptions: list[Subscription] = []
        self._services: list[Service] = []
        self._timers: list[Timer] = []
        self._guards: list[GuardCondition] = []
        self._clock = Clock(clock_type=ClockType.ROS_TIME)
        dotted = self.get_fully_qualified_name()[1:].replace('/', '.')
        self._logger = logging.Logger(dotted)
        self.context.nodes.append(self)
        self.__set_up(arguments.rosout)
        if automatically_declare_parameters_from_overrides:
            for name, value in overrides.items():
                self.declare_parameter(name, value)
        if not self.has_parameter('use_sim_time'):
            self.declare_parameter('use_sim_time', False)
        ParameterServices(self)

    def __set_up(self, rosout: bool) -> None:
        event: Any = message_class('rcl_interfaces/msg/ParameterEvent')
        self._parameter_event_publisher = self.create_publisher(
            event, '/parameter_events', qos_profile_parameter_events)
        if rosout:
            log: Any = message_class('rcl_interfaces/msg/Log')
            publisher = self.create_publisher(log, '/rosout', qos_profile_rosout_default)

            def sink(stamp: int, severity: int, name: str, message: str) -> None:
                publisher.publish(log(stamp=Time(stamp).to_msg(), level=int(severity), name=name,
                                      msg=message))

            logging.attach_sink(self._logger.name, sink)

    def _publish_parameter_event(self, event: Any) -> None:
        event.node = self.get_fully_qualified_name()
        event.stamp = self._clock.now().to_msg()
        self._parameter_event_publisher.publish(event)

    def get_name(self) -> str:
        """Return the name of this node, after remapping."""
        return self.__name

    def get_namespace(self) -> str:
        """Return the namespace of this node, after remapping."""
        return self.__namespace

    def get_fully_qualified_name(self) -> str:
        """Return namespace and name."""
        return names.join(self.__namespace, self.__name)

    def get_clock(self) -> Clock:
        """Return the clock of this node."""
        return self._clock

    def get_logger(self) -> logging.Logger:
        """Return the logger of this node."""
        return self._logger

    def resolve_topic_name(self, topic: str) -> str:
        """Return the absolute name of a topic, after remapping."""
        return names.remap(self.__rules, topic, self.__name, self.__namespace)

    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        """Return every topic on the domain with its types."""
        return sorted((n, sorted(t)) for n, t in self.context.participant.topics().items())

    def count_publishers(self, topic_name: str) -> int:
        """Return how many publishers a topic has on the domain."""
        return len(self.get_publishers_info_by_topic(topic_name))

    def get_publishers_info_by_topic(self, topic_name: str) -> list[TopicEndpointInfo]:
        """Return type and QoS of everybody who publishes on a topic."""
        name = f'rt{self.resolve_topic_name(topic_name)}'
        return [TopicEndpointInfo(kind, qos)
                for kind, qos in self.context.participant.writers_of(name)]

    def create_publisher(
        self,
        msg_type: type[Message],
        topic: str,
        qos_profile: QoSProfile | int,
        *,
        qos_overriding_options: QoSOverridingOptions | None = None,
    ) -> Publisher:
        """Publish on a topic."""
        name = self.resolve_topic_name(topic)
        qos = self.__overridden(qos_profile, name, 'publisher', qos_overriding_options)
        writer = dds.Writer(self.context.participant, f'rt{name}', msg_type.TYPENAME, qos)
        publisher = Publisher(writer, msg_type, name)
        self._publishers.append(publisher)
        self.__announce()
        return publisher

    def create_subscription(
        self,
        msg_type: type[Message],
        topic: str,
        callback: Callable[[Any], Any],
        qos_profile: QoSProfile | int,
        *,
        raw: bool = False,
        qos_overriding_options: QoSOverridingOptions | None = None,
        event_callbacks: SubscriptionEventCallbacks | None = None,
    ) -> Subscription:
        """Have a function called with each message on a topic; raw: with its bytes as CDR."""
        name = self.resolve_topic_name(topic)
        qos = self.__overridden(qos_profile, name, 'subscription', qos_overriding_options)
        reader = dds.Reader(self.context.participant, f'rt{name}', msg_type, qos)
        subscription = Subscription(self, callback, reader, name, raw)
        self._subscriptions.append(subscription)
        self.__announce()
        return subscription

    def create_service(
        self,
        srv_type: Any,
        srv_name: str,
        callback: Callable[[Any, Any], Any],
        *,
        qos_profile: QoSProfile = qos_profile_services_default,
    ) -> Service:
        """Have a function answer requests: it fills in the response and returns it."""
        name = names.remap(self.__rules, srv_name, self.__name, self.__namespace, 'service')
        participant = self.context.participant
        user_data = participant.service_id()
        reader = dds.Reader(
            participant, f'rq{name}Request', srv_type.Request, qos_profile, user_data)
        writer = dds.Writer(
            participant, f'rr{name}Reply', srv_type.Response.TYPENAME, qos_profile, user_data)
        service = Service(self, callback, srv_type, (reader, writer), srv_name, name)
        self._services.append(service)
        self.__announce()
        return service

    def create_guard_condition(self, callback: Callable[[], Any]) -> GuardCondition:
        """Have a function called whenever it is triggered."""
        guard = GuardCondition(self, callback)
        self._guards.append(guard)
        return guard

    def create_timer(
        self, timer_period_sec: float, callback: Callable[[], Any], *, clock: Clock | None = None
    ) -> Timer:
        """Have a function called periodically; no clock here is other than real time."""
        timer = Timer(self, callback, int(timer_period_sec * 1e9))
        self._timers.append(timer)
        return timer

    def destroy_subscription(self, subscription: Subscription) -> bool:
        """Leave a topic."""
        return self.__destroy(self._subscriptions, subscription)

    def destroy_timer(self, timer: Timer) -> bool:
        """Stop a timer for good."""
        return self.__destroy(self._timers, timer)

    def destroy_node(self) -> None:
        """Leave the graph; the node is of no use afterwards."""
        if self not in self.context.nodes:
            return
        self.context.nodes.remove(self)
        logging.attach_sink(self._logger.name, None)
        for things in (self._publishers, self._subscriptions, self._services, self._timers,
                       self._guards):
            for thing in things:
                thing.destroy()
            things.clear()
        self.context.graph.withdraw((self.__namespace, self.__name))

    @property
    def timers(self) -> Iterator[Timer]:
        """The timers of this node."""
        yield from self._timers

    @property
    def subscriptions(self) -> Iterator[Subscription]:
        """The subscriptions of this node."""
        yield from self._subscriptions

    @property
    def guards(self) -> Iterator[GuardCondition]:
        """The guard conditions of this node."""
        yield from self._guards

    @property
    def services(self) -> Iterator[Service]:
        """The services of this node."""
        yield from self._services

    def __overridden(
        self, qos: QoSProfile | int, topic: str, kind: str, options: QoSOverridingOptions | None
    ) -> QoSProfile:
        """Return a profile after the parameters `qos_overrides.<topic>.<kind>.<policy>`."""
        result = copy(profile(qos))
        suffix = f'_{options.entity_id}' if options and options.entity_id else ''
        for kind_of_policy in options.policy_kinds if options else ():
            policy = kind_of_policy.name.lower()
            name = f'qos_overrides.{topic}.{kind}{suffix}.{policy}'
            if not self.has_parameter(name):
                description = f'{policy} of the {kind} of {topic}'
                self.declare_parameter(
                    name, policy_text(getattr(result, policy)),
                    message_class('rcl_interfaces/msg/ParameterDescriptor')(
                        description=description, read_only=True))
            setattr(result, policy, policy_value(policy, self.get_parameter(name).value, name))
        return result

    def __destroy(self, things: list[Any], thing: Any) -> bool:
        if thing not in things:
            return False
        things.remove(thing)
        thing.destroy()
        self.__announce()
        return True

    def __announce(self) -> None:
        readers = [e.reader for e in (*self._subscriptions, *self._services) if e.reader]
        writers = [p.writer for p in self._publishers if p.writer]
        writers += [service.writer for service in self._services]
        self.context.graph.announce((self.__namespace, self.__name), readers, writers)

    def __getattr__(self, name: str) -> Any:
        raise NotSupportedError(f'Node.{name} does not exist, or needs an installation of ROS 2')
