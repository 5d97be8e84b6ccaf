"""Which nodes a process has, as it tells the domain."""

from __future__ import annotations

from typing import Any
from uuid import UUID

from fisheye_svp_ros.standalone import messages
from fisheye_svp_ros.standalone.dds import Participant, Reader, Writer
from fisheye_svp_ros.standalone.qos import DurabilityPolicy, QoSProfile


class Graph:
    """Announces the nodes of this process, as `ros2 node list` and `info` see them."""

    _QOS = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)

    def __init__(self, participant: Participant) -> None:
        self._participant = participant
        self._nodes: dict[Any, tuple[list[Any], list[Any]]] = {}
        name = 'rmw_dds_common/msg/ParticipantEntitiesInfo'
        self._writer = Writer(participant, 'ros_discovery_info', name, self._QOS)

    def announce(
        self, node: tuple[str, str], readers: list[Reader], writers: list[Writer]
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
