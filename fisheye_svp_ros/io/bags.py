"""rosbag2 recordings (MCAP): written so that a crash loses a second at most, read even then."""

from __future__ import annotations

import struct
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import Reader, StoragePlugin, Writer, WriterError
from rosbags.rosbag2.storage_mcap import McapWriter
from rosbags.typesys import Stores, get_typestore

from fisheye_svp_ros.errors import BagError
from fisheye_svp_ros.io.mcap import RawMessage, whole_messages

_FLUSH_EVERY = 1.0  # s
_CHECKSUM = 9 + 3 * 8  # bytes from the start of a chunk to its checksum
_FOREVER = QosTime(9223372036, 854775807)  # as rmw has it


class Offered(NamedTuple):
    """The quality of service a publisher offers, as far as a player of a recording needs it."""

    reliable: bool = True
    latched: bool = False


class _Storage(McapWriter):
    """The writer of rosbags, with the checksum that it leaves out."""

    def close_chunk(self) -> None:
        start, checksum = self.bio.tell(), zlib.crc32(self.chunk.bio.getbuffer())
        super().close_chunk()
        end = self.bio.tell()
        self.bio.seek(start + _CHECKSUM)
        self.bio.write(struct.pack('<I', checksum))
        self.bio.seek(end)


class Record(NamedTuple):
    """One message of a recording: the time it was recorded at, ns, and its fields."""

    topic: str
    typename: str
    time: int
    message: Any


class BagWriter:
    """Writes CDR messages to a new rosbag2 folder with one MCAP file; a context manager.

    Raises BagError where the folder exists or cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.count = 0
        try:
            self._writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
            self._writer.STORAGE_PLUGINS = {StoragePlugin.MCAP: _Storage}
            self._writer.open()
        except (WriterError, OSError) as cause:
            raise BagError(f'{path}: a recording cannot be written there ({cause})') from cause
        self._connections: dict[str, Connection] = {}
        self._flushed = time.monotonic()
        self._last = 0

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            self._writer.close()
        except OSError as cause:
            raise BagError(f'{self.path}: cannot be completed ({cause.strerror})') from cause

    def add(self, topic: str, typename: str, offered: Sequence[Offered] = (Offered(),)) -> None:
        """Begin a topic, so that whoever plays the recording offers what its publishers did.

        Raises BagError for a type that is not known.
        """
        try:
            self._connections[topic] = self._writer.add_connection(
                topic, typename, typestore=_types(),
                offered_qos_profiles=[_profile(one) for one in offered],
            )
        except Exception as cause:
            raise BagError(f'{topic}: {typename} cannot be recorded ({cause!r:.100})') from cause

    def write(self, topic: str, typename: str, data: bytes) -> None:
        """Write a message under the present time."""
        if topic not in self._connections:
            self.add(topic, typename)
        try:
            self._last = max(time.time_ns(), self._last)
            self._writer.write(self._connections[topic], self._last, data)
            self.count += 1
            if time.monotonic() - self._flushed > _FLUSH_EVERY:
                self.flush()
        except OSError as cause:
            raise BagError(f'{self.path}: cannot be written ({cause.strerror})') from cause

    def flush(self) -> None:
        """Hand to the operating system what has been written so far."""
        storage: Any = self._writer.storage
        # The writer keeps a chunk of a megabyte in memory; a crash would lose it.
        if storage.chunk.bio.tell():
            storage.close_chunk()
        storage.bio.flush()
        self._flushed = time.monotonic()


class Bag:
    """A recording to read; `damage` says what is wrong with it, empty for nothing."""

    def __init__(self, path: str | Path) -> None:
        """Find the recording; raise BagError where there is none."""
        self.path = Path(path)
        self.damage = ''
        if not self.path.exists():
            raise BagError(f'{path}: there is no such recording; check the path')
        if self.path.is_dir() and not self._files():
            raise BagError(f'{path}: no .mcap or .db3 file in this folder')

    def records(self, wanted: Callable[[str, str], bool]) -> Iterator[Record]:
        """Yield the messages for which `wanted(topic, typename)` holds, in the order of time.

        Of a recording that was cut short everything whole is yielded, and `damage` is set.
        Raises BagError where nothing can be read.
        """
        store = _types()
        for topic, typename, when, data in self._raw(wanted):
            try:
                message = store.deserialize_cdr(data, typename)
            except Exception as cause:
                self.damage = f'a message on {topic} cannot be read ({cause})'
                continue
            yield Record(topic, typename, when, message)

    def _files(self) -> list[Path]:
        return sorted([*self.path.glob('*.mcap'), *self.path.glob('*.db3')])

    def _raw(self, wanted: Callable[[str, str], bool]) -> Iterator[RawMessage]:
        """Yield messages one by one; from where an index fails on, what is whole."""
        known, last = _types().fielddefs, -1
        came: Counter[tuple[str, str]] = Counter()
        at_last = 0
        try:
            with Reader(self.path) as reader:
                connections = [
                    c for c in reader.connections
                    if c.msgtype in known and wanted(c.topic, c.msgtype)
                ]
                for connection, when, data in (
                    reader.messages(connections) if connections else ()
                ):
                    at_last = at_last + 1 if when == last else 1
                    last = when
                    came[connection.topic, connection.msgtype] += 1
                    yield RawMessage(connection.topic, connection.msgtype, when, bytes(data))
                missing = sum(c.msgcount for c in connections) - sum(came.values())
                if missing > 0:
                    self.damage = f'its index is damaged: {missing} messages are not found'
            return
        except Exception as cause:
            self.damage = f'it is damaged: only what is whole is read ({cause})'
        yield from self._whole(wanted, last, at_last)

    def _whole(
        self, wanted: Callable[[str, str], bool], last: int, at_last: int
    ) -> Iterator[RawMessage]:
        """Yield what is whole after the first `at_last` messages of the time `last`."""
        files = [self.path] if self.path.is_file() else self._files()
        notes: list[str] = []
        known = _types().fielddefs
        whole = [m for file in files if file.suffix == '.mcap'
                 for m in whole_messages(file, notes.append)]
        if not whole and last < 0:
            raise BagError(f'{self.path}: not a recording, or nothing in it is whole '
                           f'({self.damage})')
        if notes:
            self.damage = f'it is damaged: only what is whole is read; {"; ".join(notes[:3])}'
        chosen = sorted((m for m in whole if m.time >= last and m.typename in known
                         and wanted(m.topic, m.typename)), key=lambda m: m.time)
        yield from chosen[min(at_last, sum(m.time == last for m in chosen)):]


def _profile(offered: Offered) -> Qos:
    """Return a profile as a recording holds it; discovery does not tell of the history."""
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=1 if offered.latched else 100,
        reliability=QosReliability.RELIABLE if offered.reliable else QosReliability.BEST_EFFORT,
        durability=(QosDurability.TRANSIENT_LOCAL if offered.latched
                    else QosDurability.VOLATILE),
        deadline=_FOREVER, lifespan=_FOREVER, liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=_FOREVER, avoid_ros_namespace_conventions=False,
    )


@cache
def _types() -> Any:
    return get_typestore(Stores.ROS2_JAZZY)
