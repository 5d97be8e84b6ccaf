"""What nodes are made of: `rclpy.publisher`, `.subscription`, `.timer` and `.service`."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from fisheye_svp_ros.standalone import dds, logging
from fisheye_svp_ros.standalone.exceptions import RCLError
from fisheye_svp_ros.standalone.messages import Message, UnreadableError

if TYPE_CHECKING:
    from fisheye_svp_ros.standalone.node import Node

# How long a reply waits for the reader of its client, as in rmw_cyclonedds.
_CLIENT_TIMEOUT = 0.1


class Publisher:
    """Publishes messages of one type on a topic."""

    def __init__(self, writer: dds.Writer, msg_type: type[Message], topic: str) -> None:
        self.writer: dds.Writer | None = writer
        self.msg_type = msg_type
        self.topic_name = topic
        self.lost = 0
        self._logger = logging.Logger('rclpy.publisher')

    def publish(self, msg: Message | bytes) -> None:
        """Send a message, or one that is serialized already, to all subscribers."""
        if not isinstance(msg, self.msg_type | bytes):
            raise TypeError(f'Expected {self.msg_type.TYPENAME}, got {type(msg).__name__}')
        if not self._alive().write(msg):
            self.lost += 1
            self._logger.warning(
                f'{self.topic_name}: a subscriber is too slow; {self.lost} messages are lost',
                throttle_duration_sec=5.0)

    def get_subscription_count(self) -> int:
        """Return how many subscribers are connected."""
        return len(self._alive().matched())

    def destroy(self) -> None:
        """Leave the topic."""
        self.writer = None

    def _alive(self) -> dds.Writer:
        if self.writer is None:
            raise RCLError(f'the publisher of {self.topic_name} is destroyed')
        return self.writer


class Entity:
    """Something of a node that the executor waits for."""

    reader: dds.Reader | None = None
    next_call: int | None = None

    def __init__(self, node: Node, callback: Callable[..., Any]) -> None:
        self.node = node
        self.callback = callback

    def is_ready(self) -> bool:
        """Say whether there is something to do."""
        return self.reader is not None and bool(self.reader.condition.triggered)

    def execute(self) -> None:
        """Do one thing."""
        raise NotImplementedError

    def destroy(self) -> None:
        """Do nothing any more."""
        self.reader = self.next_call = None


class Timer(Entity):
    """Calls a function periodically, skipping calls that would come too late."""

    def __init__(self, node: Node, callback: Callable[[], Any], period: int) -> None:
        super().__init__(node, callback)
        self.timer_period_ns = period
        self.reset()

    def is_ready(self) -> bool:
        """Say whether a call is due."""
        return self.next_call is not None and time.monotonic_ns() >= self.next_call

    def execute(self) -> None:
        """Call the function."""
        now, period = time.monotonic_ns(), self.timer_period_ns
        assert self.next_call is not None  # it is ready
        late = now - self.next_call
        self.next_call += period * (1 + late // period) if period else late
        self.callback()

    def cancel(self) -> None:
        """Stop until reset."""
        self.next_call = None

    def reset(self) -> None:
        """Start anew: the next call comes one period from now."""
        self.next_call = time.monotonic_ns() + self.timer_period_ns

    def is_canceled(self) -> bool:
        """Say whether the timer is stopped."""
        return self.next_call is None


class GuardCondition(Entity):
    """Calls a function once after each time that it was triggered."""

    def trigger(self) -> None:
        """Have the function called, after whatever is ready by now."""
        self.next_call = time.monotonic_ns()

    def is_ready(self) -> bool:
        """Say whether it was triggered."""
        return self.next_call is not None

    def execute(self) -> None:
        """Call the function."""
        self.next_call = None
        self.callback()


class Subscription(Entity):
    """Calls a function with each message on a topic."""

    def __init__(
        self, node: Node, callback: Callable[[Any], Any], reader: dds.Reader, topic: str, raw: bool
    ) -> None:
        super().__init__(node, callback)
        self.reader = reader
        self.topic_name = topic
        self.raw = raw

    def execute(self) -> None:
        """Call the function with one message."""
        if self.reader is None:
            return
        try:
            message = self.reader.take_raw() if self.raw else self.reader.take()
        except UnreadableError as error:
            self.node.get_logger().error(f'{self.topic_name}: {error}', throttle_duration_sec=1.0)
            return
        if message is not None:
            self.callback(message)


class Service(Entity):
    """Answers requests with what a function makes of them."""

    def __init__(
        self,
        node: Node,
        callback: Callable[[Any, Any], Any],
        srv_type: Any,
        ends: tuple[dds.Reader, dds.Writer],
        given_name: str,
        name: str,
    ) -> None:
        super().__init__(node, callback)
        self.reader, self.writer = ends
        self.srv_type = srv_type
        self.srv_name = given_name
        self.service_name = name

    def execute(self) -> None:
        """Answer one request."""
        try:
            taken = self.reader.take_call() if self.reader else None
        except UnreadableError as error:
            self.node.get_logger().error(f'{self.srv_name}: {error}', throttle_duration_sec=1.0)
            return
        if self.reader is None or taken is None:
            return
        header, request = taken
        response = self.callback(request, self.srv_type.Response())
        if client := self.reader.client_of(header):
            self.writer.wait_for_client(client, _CLIENT_TIMEOUT)
        self.writer.write_call(header, response)
