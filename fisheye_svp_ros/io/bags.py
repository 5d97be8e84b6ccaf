"""rosbag2 recordings (MCAP): written so that a crash loses a second at most, read even then."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader, StoragePlugin, Writer, WriterError
from rosbags.typesys import Stores, get_typestore

from fisheye_svp_ros.errors import BagError
from fisheye_svp_ros.io.mcap import RawMessage, whole_messages

_FLUSH_EVERY = 1.0  # s


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

    def write(self, topic: str, typename: str, data: bytes) -> None:
        """Write a message under the present time."""
        try:
            if topic not in self._connections:
                self._connections[topic] = self._writer.add_connection(
                    topic, typename, typestore=_types()
                )
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
        raw = self._raw(wanted)
        store = _types()
        for topic, typename, when, data in raw:
            try:
                message = store.deserialize_cdr(data, typename)
            except Exception as cause:
                self.damage = f'a message on {topic} cannot be read ({cause})'
                continue
            yield Record(topic, typename, when, message)

    def _files(self) -> list[Path]:
        return sorted([*self.path.glob('*.mcap'), *self.path.glob('*.db3')])

    def _raw(self, wanted: Callable[[str, str], bool]) -> list[RawMessage]:
        known = _types().fielddefs
        try:
            with Reader(self.path) as reader:
                connections = [
                    c for c in reader.connections
                    if c.msgtype in known and wanted(c.topic, c.msgtype)
                ]
                return [
                    RawMessage(connection.topic, connection.msgtype, when, bytes(data))
                    for connection, when, data in (
                        reader.messages(connections) if connections else ()
                    )
                ]
        except Exception as cause:
            files = [self.path] if self.path.is_file() else self._files()
            whole = [m for file in files if file.suffix == '.mcap' for m in whole_messages(file)]
            if not whole:
                raise BagError(f'{self.path}: not a recording, or nothing in it is whole '
                               f'({cause})') from cause
            self.damage = f'it was cut short: only what is whole is read ({cause})'
            chosen = [m for m in whole if m.typename in known and wanted(m.topic, m.typename)]
            return sorted(chosen, key=lambda m: m.time)


@cache
def _types() -> Any:
    return get_typestore(Stores.ROS2_JAZZY)
