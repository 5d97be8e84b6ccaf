"""The inputs of a node: each is heard from whoever publishes it, and decoded when it is needed.

Who asks for more than a publisher offers does not hear it, and who asks for less does not get
what a latched publisher has sent before.  So an input asks for what the topic usually has, and
adds a subscription when a publisher appears that offers something else.  To ask for all at once
would have the log of every driver say that no messages are sent.  Why nothing comes on an input,
and what to do about it, is said as far as a node can see it.
"""

from __future__ import annotations

import os
import struct
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterable, Sequence
from copy import copy
from dataclasses import dataclass
from difflib import SequenceMatcher
from typing import Any, NamedTuple

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import (
    DurabilityPolicy,
    QoSCompatibility,
    QoSPolicyKind,
    ReliabilityPolicy,
    qos_check_compatible,
)
from rclpy.serialization import deserialize_message
from rclpy.utilities import get_rmw_implementation_identifier

from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.io.decoding import nanoseconds
from fisheye_svp_ros.io.share import config_path
from fisheye_svp_ros.nodes.quality import INPUT, PREFIX, create_with_qos, overridden, qos_words
from fisheye_svp_ros.reporting.wording import inputs as wording

_LONG_INTERVALS = 3  # of a topic, without a message: it has stopped
# Messages by which one subscription of a topic may be ahead of another: as many as may wait.
_MAX_HASHES = INPUT.depth

_MIN_BYTES = 12  # bytes: the head of CDR and a stamp

_Kind = tuple[bool, bool]  # of a subscription: reliable, latched
LIMIT = 5.0  # s without a message after which it is said
_MAX_PROPOSALS = 3  # topics to propose
_MAX_LOSS = 0.1  # of the messages between two reports, lost on the way
# The same of so many messages or more: what is seldom lost is told as well
_MAX_LOSS_OF_MANY, _MANY = 0.01, 200
_PROFILE_VARIABLE, _PROFILE = 'FASTRTPS_DEFAULT_PROFILES_FILE', 'fastdds/images.xml'
_IMAGE_TYPES = ('sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage')


@dataclass
class Count:
    """How many messages of a topic came, were looked at, could not be used, and did not come."""

    received: int = 0
    read: int = 0
    dropped: int = 0
    lost: int = 0


class Unread:
    """A message that has come and is not decoded yet."""

    def __init__(
        self, topic: str, kind: Any, data: bytes, decode: Callable[[Any, str], Any], counts: Count
    ) -> None:
        self.topic = topic
        self._kind, self._data, self._decode, self._counts = kind, data, decode, counts
        self._outcome: tuple[Any, ObservationError | None] | None = None

    @property
    def stamp(self) -> int:
        """The stamp of its header, which every message starts with that a node listens to, ns."""
        try:
            if len(self._data) < _MIN_BYTES:
                raise ObservationError(f'{self.topic}: {len(self._data)} bytes are not a message')
            order = '<' if self._data[1] & 1 else '>'
            sec, nanosec = struct.unpack_from(f'{order}iI', self._data, 4)
            return nanoseconds(sec, nanosec, self.topic)
        except ObservationError:
            self._counts.read += 1
            raise

    @property
    def content(self) -> int:
        """A hash of what it holds, but for its stamp."""
        return hash(self._data[_MIN_BYTES:])

    def read(self) -> Any:
        """Return what it holds; raise ObservationError where it cannot be used."""
        if self._outcome is None:
            self._counts.read += 1
            try:
                self._outcome = self._decode_data(), None
            except ObservationError as error:
                self._outcome = None, error
        value, refusal = self._outcome
        if refusal is not None:
            raise refusal
        return value

    def _decode_data(self) -> Any:
        try:
            message = deserialize_message(self._data, self._kind)
        except Exception as cause:
            kind = self._kind.__name__
            raise ObservationError(f'{self.topic}: not a {kind} ({cause})') from cause
        return self._decode(message, self.topic)


class _Subscription(NamedTuple):
    """One of rclpy, and what is called with each of its messages."""

    of_rclpy: Any
    hear: Callable[[bytes, Any], None]


class Input:
    """A topic that a node listens to, and how many messages have come.

    name: to be resolved; resolved: the full name, after remapping; typename: as `ros2 topic list
    -t` has it; latched: whether what was published before is wanted as well.
    """

    def __init__(
        self,
        node: Any,
        kind: Any,
        name: str,
        receive: Callable[[bytes], None],
        qos: Any,
        latched: bool,
    ) -> None:
        self.name, self.count = name, Count()
        self.resolved = str(node.resolve_topic_name(name))
        self.typename = f'{kind.__module__.partition(".")[0]}/msg/{kind.__name__}'
        self._node, self._kind, self._receive = node, kind, receive
        self._qos, self.latched = qos, latched
        self._subscriptions: dict[_Kind, _Subscription] = {}
        self._since = self._first = self._latest = 0.0  # s
        self._heard = 0
        self._has_one_publisher = False
        self._number: int | None = None  # of the latest message, as its publisher counts
        self._reported, self._window = Count(), Count()
        self._seldom_lost = ''

    @property
    def profiles(self) -> list[Any]:
        """What is asked for; empty while the node does not listen."""
        return [subscription.of_rclpy.qos_profile for subscription in self._subscriptions.values()]

    @property
    def has_messages(self) -> bool:
        """Whether a message has come since the node listens."""
        return self._heard > 0

    def silent_for(self) -> float:
        """Return for how many seconds nothing has come; 0 while the node does not listen."""
        if not self._subscriptions:
            return 0.0
        return time.monotonic() - (self._latest if self._heard else self._since)

    def is_silent(self, limit: float) -> bool:
        """Say whether nothing has come for `limit` seconds, or for what is long on this topic.

        What is latched has come for good; else three times the mean interval is long.
        """
        if self._heard and self.latched:
            return False
        interval = (self._latest - self._first) / max(self._heard - 1, 1)
        return self.silent_for() > max(limit, _LONG_INTERVALS * interval)

    def subscribe(self) -> None:
        """Listen."""
        self._since, self._heard = time.monotonic(), 0
        self._first = self._latest = self._since
        self._filter = DuplicateFilter(self._hear, self.latched)
        reliable = self._qos.reliability != ReliabilityPolicy.BEST_EFFORT
        self._add_subscription((reliable, False), self._qos)

    def _hear(self, data: bytes) -> None:
        self._latest = time.monotonic()
        self._first = self._first if self._heard else self._latest
        self._heard += 1
        self._receive(data)

    def unsubscribe(self) -> None:
        """Listen no more."""
        for subscription in self._subscriptions.values():
            self._node.destroy_subscription(subscription.of_rclpy)
        self._subscriptions.clear()

    def take(self) -> bool:
        """Take in a message that the executor has not brought yet; say whether there was one."""
        taken = False
        for subscription in self._subscriptions.values():
            handle = subscription.of_rclpy.handle
            with handle:
                message = handle.take_message(self._kind, True)
            if message is not None:
                taken = True
                subscription.hear(*message)
        return taken

    def adapt(self) -> None:
        """Add the subscriptions that the publishers of the topic need."""
        if not self._subscriptions:
            return
        publishers = self._node.get_publishers_info_by_topic(self.resolved)
        self._has_one_publisher = len(publishers) == 1
        if self._is_fixed():
            return
        if self.typename in _IMAGE_TYPES:
            self._match(publishers)
            return
        usual = next(iter(self._subscriptions))
        for publisher in publishers:
            offered = publisher.qos_profile
            latched = self.latched and offered.durability == DurabilityPolicy.TRANSIENT_LOCAL
            reliable = offered.reliability != ReliabilityPolicy.BEST_EFFORT
            needed = reliable and (usual[0] or latched), latched
            if publisher.topic_type == self.typename and needed not in self._subscriptions:
                qos = copy(self.profiles[0])
                qos.reliability = (
                    ReliabilityPolicy.RELIABLE if needed[0] else ReliabilityPolicy.BEST_EFFORT
                )
                if latched:
                    qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
                self._add_subscription(needed, qos)

    def _match(self, publishers: Sequence[Any]) -> None:
        """Subscribe to images reliably where all publishers offer that: they get lost otherwise.

        In place of the subscription that is there: two would bring each image twice.
        """
        offers = [one.qos_profile for one in publishers if one.topic_type == self.typename]
        reliable = all(one.reliability == ReliabilityPolicy.RELIABLE for one in offers)
        if not offers or (reliable, False) in self._subscriptions:
            return
        qos = copy(self.profiles[0])
        qos.reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        for kind in [*self._subscriptions]:
            self._node.destroy_subscription(self._subscriptions.pop(kind).of_rclpy)
        self._number = None
        self._add_subscription((reliable, False), qos)

    def losses(self) -> str:
        """Say how many messages have been lost, where that is many; call it for each report.

        Many of those since the last call, or some of the latest `_MANY`, until there are as many
        more.
        """
        lost, total = self._lost_since(self._reported)
        self._reported = copy(self.count)
        few, of_many = self._lost_since(self._window)
        if of_many >= _MANY:
            self._window = copy(self.count)
            seldom = few > _MAX_LOSS_OF_MANY * of_many
            self._seldom_lost = self._tell_losses(few, of_many) if seldom else ''
        if lost > _MAX_LOSS * total:
            return self._tell_losses(lost, total)
        return self._seldom_lost if total else ''

    def _can_be_reliable(self) -> bool:
        """Say whether a user's override alone keeps this node from what publishers offer."""
        publishers = self._node.get_publishers_info_by_topic(self.resolved)
        offers = [one.qos_profile.reliability == ReliabilityPolicy.RELIABLE for one in publishers]
        asks = [one.reliability == ReliabilityPolicy.RELIABLE for one in self.profiles]
        return bool(offers) and all(offers) and not any(asks)

    def _lost_since(self, before: Count) -> tuple[int, int]:
        """Return how many messages were lost since a count, and how many there should be."""
        lost = self.count.lost - before.lost
        return lost, lost + self.count.received - before.received

    def _tell_losses(self, lost: int, total: int) -> str:
        remedy = _loss_remedy(self.typename, self.resolved, self._can_be_reliable())
        return wording.messages_lost(self.name, lost, total, remedy)

    def _count_losses(self, number: int | None) -> None:
        """Count what is missing between two messages of one publisher, which numbers them.

        number: None where the middleware does not tell.
        """
        last, self._number = self._number, number
        if self._has_one_publisher and None not in (last, number):
            self.count.lost += max(int(number or 0) - int(last or 0) - 1, 0)

    def _is_fixed(self) -> bool:
        """Say whether the user has decided what to ask for."""
        chosen = overridden(self._node, self.resolved, 'subscription')
        return bool({QoSPolicyKind.RELIABILITY, QoSPolicyKind.DURABILITY} & {*chosen})

    def _add_subscription(self, kind: _Kind, qos: Any) -> None:
        node = self._node
        adapt = node.guard_callback(lambda _: self.adapt())
        events = SubscriptionEventCallbacks(
            matched=adapt if self.latched or self.typename in _IMAGE_TYPES else None,
            incompatible_qos=None if self._is_fixed() else adapt,
        )
        hear_data, first = self._filter.callback(), not self._subscriptions

        def hear(data: bytes, info: Any) -> None:
            if first:
                self._count_losses(info['publication_sequence_number'])
            hear_data(data)

        def receive(data: bytes, info: Any) -> None:
            hear(data, info)
            node.after_message()

        self._subscriptions[kind] = _Subscription(
            create_with_qos(
                node,
                node.create_subscription,
                self._kind,
                self.name,
                receive,
                qos=qos,
                raw=True,
                event_callbacks=events,
            ),
            hear,
        )


class DuplicateFilter:
    """Passes on what comes to several subscriptions, each message once.

    Messages are known by their hashes: to keep them would keep the last hundred.  history: a
    later subscription may bring what came before.
    """

    def __init__(self, receive: Callable[[bytes], None], history: bool) -> None:
        self._receive, self._history = receive, history
        self._callbacks = 0
        self._passed: OrderedDict[int, int] = OrderedDict()  # how often, by hash
        self._heard: Counter[tuple[int, int]] = Counter()  # how often, by subscription and hash

    def callback(self) -> Callable[[bytes], None]:
        """Return the callback of one more subscription."""
        number = self._callbacks
        self._callbacks += 1

        def hear(data: bytes) -> None:
            if self._callbacks == 1 and not self._history:
                self._receive(data)
                return
            key = hash(data)
            self._heard[number, key] += 1
            if self._heard[number, key] <= self._passed.get(key, 0):
                return
            self._passed[key] = self._passed.pop(key, 0) + 1
            if len(self._passed) > _MAX_HASHES:
                old, _ = self._passed.popitem(last=False)
                for one in range(self._callbacks):
                    self._heard.pop((one, old), None)
            self._receive(data)

        return hear


def silent_inputs(
    needed: Iterable[Sequence[str]], inputs: dict[str, Input], limit: float
) -> list[Sequence[Input]]:
    """Return the inputs on which nothing has come, or comes any more.

    needed: topics one of which has to come, each; limit: s without a message.
    """
    open_ones = [[inputs[topic] for topic in topics if topic in inputs] for topics in needed]
    return [ones for ones in open_ones if ones and all(one.is_silent(limit) for one in ones)]


def explain_silence(node: Any, inputs: Sequence[Input]) -> tuple[str, str]:
    """Say on which topic nothing comes, and since when; and why, and what to do.

    inputs: alternatives.
    """
    publishers = {one: node.get_publishers_info_by_topic(one.resolved) for one in inputs}
    one = next((one for one, found in publishers.items() if found), inputs[0])
    one = next((known for known in inputs if known.has_messages), one)
    since = f' for {one.silent_for():.0f} s' if one.has_messages else ''
    return (f'no message on {one.resolved}{since}', _reason(node, inputs, one, publishers[one]))


def _reason(
    node: Any, inputs: Sequence[Input], subscription: Input, publishers: Sequence[Any]
) -> str:
    if not publishers:
        if subscription.has_messages:
            return 'its publisher is gone; start it again'
        return 'it has no publisher; ' + _proposal(node, inputs)
    right = [info for info in publishers if info.topic_type == subscription.typename]
    if not right:
        kinds = ', '.join(sorted({info.topic_type for info in publishers}))
        return f'its type is {kinds}, but {subscription.typename} is needed; ' + _proposal(
            node, inputs
        )
    names = ', '.join(sorted({info.node_name for info in right}))
    if subscription.has_messages:
        return (
            f'{names} is still connected; check its own input, and run ros2 topic hz '
            f'{subscription.resolved}'
        )
    offers = [info.qos_profile for info in right]
    if all(
        qos_check_compatible(offered, asked)[0] == QoSCompatibility.ERROR
        for offered in offers
        for asked in subscription.profiles
    ):
        return (
            f'{names} offers {qos_words(offers[0])}, but this node requests '
            f'{qos_words(subscription.profiles[0])}; remove '
            f'{PREFIX}{subscription.resolved}.subscription.*'
        )
    return f'{names} is connected, but no message has arrived{_remedy(subscription, offers)}'


def _remedy(subscription: Input, offers: Sequence[Any]) -> str:
    """Return what may help where a publisher that is heard has sent nothing, or nothing came."""
    if subscription.typename not in _IMAGE_TYPES:
        volatile = all(offer.durability == DurabilityPolicy.VOLATILE for offer in offers)
        if subscription.latched and volatile:
            return ' (volatile: what was sent before this node started is lost; publish it again)'
        return f'; check its own input, and run ros2 topic hz {subscription.resolved}'
    if any(asked.reliability == ReliabilityPolicy.RELIABLE for asked in subscription.profiles):
        return f'; check its own input, and run ros2 topic hz {subscription.resolved}'
    if all(offer.reliability == ReliabilityPolicy.RELIABLE for offer in offers):
        override = f'set {PREFIX}{subscription.resolved}.subscription.reliability:=reliable'
        return f'; if ros2 topic hz {subscription.resolved} shows messages, {override}'
    remedy = _loss_remedy(subscription.typename, subscription.resolved)
    return f' (best effort loses large messages: {remedy})'


def _loss_remedy(typename: str, topic: str, reliable: bool = False) -> str:
    """Say what helps against the loss of messages of a type on a topic.

    reliable: its publishers send reliably, and this node is told not to ask for that.
    """
    if reliable:
        return f'set {PREFIX}{topic}.subscription.reliability:=reliable'
    if typename not in _IMAGE_TYPES:
        return wording.small_message_remedy(f'{PREFIX}{topic}')
    takes_profiles = get_rmw_implementation_identifier().startswith('rmw_fastrtps')
    named = takes_profiles and _PROFILE_VARIABLE not in os.environ
    return wording.large_message_remedy(str(config_path(_PROFILE)) if named else '')


def _comes_from_elsewhere(node: Any, topic: str) -> bool:
    own = node.get_name(), node.get_namespace()
    return any(
        (info.node_name, info.node_namespace) != own
        for info in node.get_publishers_info_by_topic(topic)
    )


def _proposal(node: Any, inputs: Sequence[Input]) -> str:
    """Return the topics of the same type that are most alike, and how to listen to the first."""
    wanted, known = inputs[0], {one.typename for one in inputs}
    own = {one.resolved for one in inputs}
    found = [
        topic
        for topic, kinds in node.get_topic_names_and_types()
        if known & {*kinds} and topic not in own and _comes_from_elsewhere(node, topic)
    ]
    if not found:
        return (
            f'no topic here has type {wanted.typename}; start its publisher with the same '
            'ROS_DOMAIN_ID'
        )
    found.sort(key=lambda topic: -SequenceMatcher(None, topic, wanted.resolved).ratio())
    topic = found[0].removesuffix('/compressed') if len(inputs) > 1 else found[0]
    return (
        f'{wanted.typename} is on {", ".join(found[:_MAX_PROPOSALS])}; subscribe to it with '
        f'-r {wanted.name}:={topic}'
    )
