"""The state between `rclpy.init()` and `rclpy.shutdown()`: arguments, wire, signals."""

from __future__ import annotations

import os
import signal
import sys
import threading
from functools import partial
from types import FrameType
from typing import Any
from uuid import UUID

from fisheye_svp_ros.standalone import arguments, dds, logging, messages
from fisheye_svp_ros.standalone.exceptions import NotInitializedException, RCLError
from fisheye_svp_ros.standalone.interrupts import INTERRUPTS
from fisheye_svp_ros.standalone.qos import DurabilityPolicy, QoSProfile

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_LAST_DOMAIN = 232  # the ports of higher ones do not exist


class Graph:
    """Announces the nodes of this process, as `ros2 node list` and `info` see them."""

    _QOS = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)

    def __init__(self, participant: dds.Participant) -> None:
        self._participant = participant
        self._nodes: dict[Any, tuple[list[Any], list[Any]]] = {}
        name = 'rmw_dds_common/msg/ParticipantEntitiesInfo'
        self._writer = dds.Writer(participant, 'ros_discovery_info', name, self._QOS)

    def announce(
        self, node: tuple[str, str], readers: list[dds.Reader], writers: list[dds.Writer]
    ) -> None:
        """Tell what a node, given as (namespace, name), reads and writes by now."""
        self._nodes[node] = ([_gid(r.entity.guid) for r in readers],
                             [_gid(w.entity.guid) for w in writers])  # fmt: skip
        self._publish()

    def withdraw(self, node: tuple[str, str]) -> None:
        """Tell that a node is gone."""
        self._nodes.pop(node, None)
        self._publish()

    def _publish(self) -> None:
        info: Any = messages.message_class('rmw_dds_common/msg/ParticipantEntitiesInfo')
        entry: Any = messages.message_class('rmw_dds_common/msg/NodeEntitiesInfo')
        self._writer.write(info(
            gid=_gid(self._participant.guid),
            node_entities_info_seq=[
                entry(node_namespace=ns, node_name=name, reader_gid_seq=r, writer_gid_seq=w)
                for (ns, name), (r, w) in self._nodes.items()
            ],
        ))


def _gid(guid: UUID) -> Any:
    return messages.message_class('rmw_dds_common/msg/Gid')(data=[*guid.bytes])


class Context:
    """Everything that the nodes of one process share."""

    def __init__(self) -> None:
        self.arguments = arguments.Arguments()
        self.nodes: list[Any] = []
        self.interrupted = False
        self._running = False
        self._wire: tuple[dds.Participant, Graph] | None = None
        self._handlers: dict[signal.Signals, Any] = {}

    def init(self, args: list[str] | None) -> None:
        """Read the arguments, join the domain and take over SIGINT and SIGTERM."""
        if self._running:
            raise RCLError('Context.init() must only be called once')
        self.shut_down()
        self.arguments = arguments.parse(sys.argv if args is None else args)
        for name, level in self.arguments.log_levels.items():
            logging.set_logger_level(name, level)
        given = os.getenv('ROS_DOMAIN_ID') or '0'
        if not given.isdecimal() or int(given) > _LAST_DOMAIN:
            raise RCLError(f'ROS_DOMAIN_ID={given} is not a number from 0 to {_LAST_DOMAIN}')
        participant = dds.Participant(int(given))
        self._wire = participant, Graph(participant)
        self._running, self.interrupted = True, False
        if threading.current_thread() is threading.main_thread():
            self._handlers = {s: signal.signal(s, self._on_signal) for s in _SIGNALS}

    def ok(self) -> bool:
        """Say whether nodes may run: initialized, and neither shut down nor interrupted."""
        return self._running

    @property
    def participant(self) -> dds.Participant:
        """This process on the domain."""
        return self._connected()[0]

    @property
    def graph(self) -> Graph:
        """What this process tells about its nodes."""
        return self._connected()[1]

    def shut_down(self) -> None:
        """Leave the domain; nodes that still exist are destroyed."""
        self._running = False
        for node in [*self.nodes]:
            node.destroy_node()
        self._wire = None
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        self._handlers = {}

    def _connected(self) -> tuple[dds.Participant, Graph]:
        if self._wire is None:
            raise NotInitializedException('rclpy.init() has not been called')
        return self._wire

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        # As in rclpy: the context ends, and Python's own handler turns SIGINT into an exception.
        self._running = False
        self.interrupted = number == signal.SIGINT
        previous = self._handlers.get(signal.Signals(number))
        if callable(previous):
            INTERRUPTS.handle(partial(previous, number, frame))


_default = Context()


def get_default_context() -> Context:
    """Return the context of this process."""
    return _default
