"""The wire: ROS 2's conventions for topics, types, QoS and discovery, on Eclipse Cyclone DDS.

The conventions are those of rmw_cyclonedds_cpp, so that nodes of an installed ROS 2 and nodes of
this client find each other and exchange messages.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import socket
import struct
import time
from collections.abc import Collection, Iterable
from functools import cache, cached_property
from pathlib import Path
from typing import Any, ClassVar, NamedTuple
from uuid import UUID

from cyclonedds.builtin import (
    BuiltinDataReader,
    BuiltinTopicDcpsPublication,
    BuiltinTopicDcpsSubscription,
)
from cyclonedds.core import (
    DDSException,
    InstanceState,
    Policy,
    Qos,
    ReadCondition,
    SampleState,
    ViewState,
)
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct, make_idl_struct
from cyclonedds.idl import types as idl
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from rosbags.interfaces import Nodetype

from fisheye_svp_ros.standalone import messages
from fisheye_svp_ros.standalone.exceptions import NotSupportedError, RCLError
from fisheye_svp_ros.standalone.interrupts import INTERRUPTS
from fisheye_svp_ros.standalone.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSProfile,
    ReliabilityPolicy,
)

_ANY = SampleState.Any | ViewState.Any | InstanceState.Any
_MANY = 100_000  # endpoints on a domain
_PATIENCE = duration(milliseconds=50)  # with a subscriber that does not keep up
_HEADER = struct.Struct('<Qq')  # before requests and replies: client, sequence number
_IDL = {'bool': bool, 'string': str}

# As in ROS 2, this many processes of one domain find each other on one host without multicast.
_DISCOVERY = (
    '<ParticipantIndex>auto</ParticipantIndex>'
    '<MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>'
)
_LOCALHOST = '<Peers><Peer address="127.0.0.1"/></Peers>'
_UNICAST = '<AllowMulticast>false</AllowMulticast>'
_LOOPBACK = '<Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>'


class Sample:
    """CDR bytes that cyclonedds hands on as they are; a subclass exists for each DDS type."""

    __idl__: ClassVar[Any]

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.sample_info: Any = None

    def serialize(self, use_version_2: bool | None = None) -> bytes:
        """Return the bytes to send."""
        return self.data

    @classmethod
    def deserialize(cls, data: bytes) -> Sample:
        """Keep the bytes that were received."""
        return cls(data)

    deserialize_key = deserialize


class Header(NamedTuple):
    """What precedes a request or reply: who asks, and which of their requests it is."""

    client: int
    sequence: int
    writer: int = 0  # the DDS writer that a request came from; not sent


@cache
def _idl_struct(typename: str) -> type[IdlStruct]:
    package, kind, name = typename.split('/')
    fields = {field: _idl_type(desc) for field, desc in messages.definition(typename)}
    struct: type[IdlStruct] = make_idl_struct(name, f'{package}.{kind}.dds_.{name}_', fields)
    return struct


def _idl_type(desc: Any) -> Any:
    kind, argument = desc
    if kind == Nodetype.BASE:
        name, bound = argument
        if name == 'string' and bound:
            return idl.bounded_str[bound]
        return _IDL.get(name) or getattr(idl, name)
    if kind == Nodetype.NAME:
        return _idl_struct(argument)
    item, length = argument
    if kind == Nodetype.ARRAY:
        return idl.array[_idl_type(item), length]
    return idl.sequence[_idl_type(item), length] if length else idl.sequence[_idl_type(item)]


@cache
def _sample_class(typename: str, *, service: bool) -> type[Sample]:
    definition = _idl_struct(typename)
    if service:
        header = {'rmw_client': idl.uint64, 'rmw_sequence': idl.int64}
        fields = header | dict(definition.__annotations__)
        definition = make_idl_struct(
            definition.__name__, definition.__idl_typename__, fields)
    return type(definition.__name__, (Sample,), {'__idl__': definition.__idl__})


class Participant:
    """One process on a domain, with everything that its nodes write and read."""

    def __init__(self, domain_id: int) -> None:
        if os.getenv('ROS_SECURITY_ENABLE', '').lower() == 'true':
            raise NotSupportedError('ROS_SECURITY_ENABLE=true: DDS security needs an installation '
                                    'of ROS 2; without it nothing is encrypted (docs/security.md)')
        before = _sockets()
        try:
            self._domain = Domain(domain_id, _configuration())
            self.entity = DomainParticipant(domain_id, Qos(Policy.Userdata(b'enclave=/;')))
        except DDSException as error:
            hint = 'too many processes on it, or a faulty CYCLONEDDS_URI?'
            raise RCLError(f'cannot join ROS domain {domain_id}: {hint}') from error
        if _is_local():
            now = _sockets()
            _keep_on_loopback(now[name] for name in now.keys() - before)
        self.guid: UUID = self.entity.guid
        self._service_ids = itertools.count(1)

    def topic(self, name: str, typename: str, *, service: bool = False) -> Topic[Any]:
        """Return a DDS topic that carries a ROS type."""
        return Topic(self.entity, name, _sample_class(typename, service=service))

    def topics(self) -> dict[str, set[str]]:
        """Return the types of every topic that somebody on the domain writes or reads, by name."""
        found: dict[str, set[str]] = {}
        for endpoints in (self._writers, self._readers):
            for name, typename, _ in endpoints.alive():
                if name.startswith('rt/'):
                    found.setdefault(name[2:], set()).add(_ros_type(typename))
        return found

    def writers_of(self, name: str) -> list[tuple[str, QoSProfile]]:
        """Return ROS type and QoS of everybody on the domain who writes a DDS topic."""
        return [(_ros_type(kind), qos) for topic, kind, qos in self._writers.alive()
                if topic == name]

    @cached_property
    def _writers(self) -> _Endpoints:
        return _Endpoints(self.entity, BuiltinTopicDcpsPublication)

    @cached_property
    def _readers(self) -> _Endpoints:
        return _Endpoints(self.entity, BuiltinTopicDcpsSubscription)

    def service_id(self) -> str:
        """Return a new user-data entry that ties the two halves of a service together."""
        identifier = self.guid.bytes[:12] + next(self._service_ids).to_bytes(4, 'big')
        return f'serviceid={".".join(f"{byte:x}" for byte in identifier)};'


class _Endpoints:
    """All writers, or all readers, on a domain; each look takes in only what has changed."""

    def __init__(self, participant: DomainParticipant, kind: Any) -> None:
        self._reader = BuiltinDataReader(participant, kind)
        self._alive: dict[UUID, tuple[str, str, QoSProfile]] = {}

    def alive(self) -> Collection[tuple[str, str, QoSProfile]]:
        """Return topic, type and QoS of every endpoint that is there now."""
        with INTERRUPTS:
            taken = self._reader.take(_MANY)
        for endpoint in taken:
            if endpoint.sample_info.instance_state == InstanceState.Alive:
                self._alive[endpoint.key] = (
                    endpoint.topic_name, endpoint.type_name, _ros_qos(endpoint.qos))
            else:
                self._alive.pop(endpoint.key, None)
        return self._alive.values()


def _ros_type(typename: str) -> str:
    return typename.replace('::dds_::', '/').replace('::', '/').removesuffix('_')


def _ros_qos(qos: Qos) -> QoSProfile:
    """Return what discovery tells of a profile; it tells nothing of the history."""
    latched = Policy.Durability.Volatile not in qos and Policy.Durability in qos
    best = Policy.Reliability.BestEffort in qos
    return QoSProfile(
        depth=1,
        reliability=ReliabilityPolicy.BEST_EFFORT if best else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def _is_local() -> bool:
    local = (os.getenv('ROS_AUTOMATIC_DISCOVERY_RANGE') or 'LOCALHOST') == 'LOCALHOST'
    return local or os.getenv('ROS_LOCALHOST_ONLY') == '1'


def _sockets() -> dict[str, int]:
    """Return the open sockets of this process and their descriptors."""
    found = {}
    for entry in Path('/proc/self/fd').glob('*'):
        with contextlib.suppress(OSError):
            found[str(entry.readlink())] = int(entry.name)
    return {name: number for name, number in found.items() if name.startswith('socket:')}


def _keep_on_loopback(descriptors: Iterable[int]) -> None:
    """Have UDP sockets take in nothing from outside this machine.

    Cyclone DDS binds those that receive to every interface, whichever it was told to use.
    """
    for descriptor in descriptors:
        with contextlib.suppress(OSError), socket.socket(fileno=os.dup(descriptor)) as one:
            if one.type == socket.SOCK_DGRAM and hasattr(socket, 'SO_BINDTODEVICE'):
                one.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b'lo')


def _configuration() -> str:
    asked = os.getenv('ROS_AUTOMATIC_DISCOVERY_RANGE') or 'LOCALHOST'
    if asked not in {'LOCALHOST', 'SUBNET'}:
        raise NotSupportedError(f'ROS_AUTOMATIC_DISCOVERY_RANGE={asked}: use LOCALHOST or SUBNET')
    general, discovery, own = '', _DISCOVERY, os.getenv('CYCLONEDDS_URI', '')
    if _is_local():
        discovery += _LOCALHOST
        # Cyclone refuses an interface that is named twice, so the user's own choice stands alone.
        general = _UNICAST + ('' if own else _LOOPBACK)
    inner = f'<General>{general}</General><Discovery>{discovery}</Discovery>'
    return f'<CycloneDDS><Domain>{inner}</Domain></CycloneDDS>,{own}'


class Writer:
    """Publishes messages of one type on one DDS topic."""

    def __init__(
        self,
        participant: Participant,
        topic: str,
        typename: str,
        qos: QoSProfile,
        user_data: str | None = None,
    ) -> None:
        dds_topic = participant.topic(topic, typename, service=user_data is not None)
        self.entity = DataWriter(participant.entity, dds_topic, _dds_qos(qos, typename, user_data))

    def write(self, message: messages.Message | bytes) -> bool:
        """Send a message, or its CDR; False where a subscriber was too slow for it."""
        return self._write(message if isinstance(message, bytes) else messages.serialize(message))

    def write_call(self, header: Header, message: messages.Message) -> None:
        """Send a request or a reply."""
        data = messages.serialize(message)
        self._write(data[:4] + _HEADER.pack(header.client, header.sequence) + data[4:])

    def matched(self) -> list[int]:
        """Return the handles of the readers that are connected."""
        while True:
            # It counts the readers, then lists them: one that comes in between is too many for it.
            with contextlib.suppress(IndexError):
                return self.entity.get_matched_subscriptions()  # type: ignore[no-any-return]

    def wait_for_client(self, user_data: bytes, timeout: float) -> None:
        """Wait until the reader of a client is connected: what is sent earlier would be lost."""
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            for handle in self.matched():
                with INTERRUPTS:
                    endpoint = self.entity.get_matched_subscription_data(handle)
                if endpoint and _client_id(endpoint.qos) == user_data:
                    return
            time.sleep(0.005)

    def _write(self, data: bytes) -> bool:
        try:
            self.entity.write(self.entity.data_type(data))
        except DDSException as error:
            if error.code != DDSException.DDS_RETCODE_TIMEOUT:
                raise
            return False
        return True


class Reader:
    """Receives messages of one type on one DDS topic."""

    def __init__(
        self,
        participant: Participant,
        topic: str,
        cls: type[messages.Message],
        qos: QoSProfile,
        user_data: str | None = None,
    ) -> None:
        typename = cls.TYPENAME
        dds_topic = participant.topic(topic, typename, service=user_data is not None)
        self.entity = DataReader(participant.entity, dds_topic, _dds_qos(qos, typename, user_data))
        self.condition = ReadCondition(self.entity, _ANY)
        self._class = cls

    def take(self) -> messages.Message | None:
        """Return the next message, or None."""
        data = self.take_raw()
        return messages.deserialize(data, self._class) if data else None

    def take_raw(self) -> bytes | None:
        """Return the next message as CDR with its encapsulation header, or None."""
        sample = self._take()
        return sample.data if sample else None

    def take_call(self) -> tuple[Header, messages.Message] | None:
        """Return the next request or reply with its header, or None."""
        sample = self._take()
        if sample is None:
            return None
        data, end = sample.data, 4 + _HEADER.size
        order = '<' if data[1] & 1 else '>'
        client, sequence = struct.unpack(f'{order}Qq', data[4:end])
        header = Header(client, sequence, sample.sample_info.publication_handle)
        return header, messages.deserialize(data[:4] + data[end:], self._class)

    def client_of(self, header: Header) -> bytes:
        """Return what a client calls itself; empty when it is gone or does not say."""
        with INTERRUPTS:
            endpoint = self.entity.get_matched_publication_data(header.writer)
        return _client_id(endpoint.qos) if endpoint else b''

    def _take(self) -> Sample | None:
        # Samples without data tell that a writer left; there may be several before the next one.
        with INTERRUPTS:
            while taken := self.entity.take(1):
                if taken[0].sample_info.valid_data:
                    return taken[0]  # type: ignore[no-any-return]
        return None


def _client_id(qos: Qos) -> bytes:
    policy = qos[Policy.Userdata] if Policy.Userdata in qos else None  # noqa: SIM401
    entries = policy.data.split(b';') if policy else []
    return next((entry for entry in entries if entry.startswith(b'clientid=')), b'')


def _dds_qos(qos: QoSProfile, typename: str, user_data: str | None) -> Qos:
    keep_all = qos.history == HistoryPolicy.KEEP_ALL
    history = Policy.History.KeepAll if keep_all else Policy.History.KeepLast(qos.depth or 1)
    policies = [
        history,
        Policy.Reliability.BestEffort
        if qos.reliability == ReliabilityPolicy.BEST_EFFORT
        else Policy.Reliability.Reliable(max_blocking_time=_PATIENCE),
        Policy.WriterDataLifecycle(autodispose=False),
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.Userdata(f'{user_data or ""}typehash={messages.type_hash(typename)};'.encode()),
    ]
    if qos.durability == DurabilityPolicy.TRANSIENT_LOCAL:
        policies += [
            Policy.Durability.TransientLocal,
            # What late subscribers receive is as deep as the history of the topic.
            Policy.DurabilityService(0, history, -1, -1, -1),
        ]
    return Qos(*policies)
