"""Recordings: their files, compressed or not, and the messages in them, read and written.

They are written so that a crash loses what came since the last flush only.
"""

from __future__ import annotations

import struct
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import zstandard
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
from rosbags.rosbag2.storage_mcap import McapWriter, write_channel, write_string
from rosbags.typesys import Stores, get_typestore

from fisheye_svp_ros.errors import BagError
from fisheye_svp_ros.io.mcap import (
    MAX_BYTES,
    Record,
    database_messages,
    database_topics,
    listed_topics,
    whole_messages,
)
from fisheye_svp_ros.io.paths import final_path
from fisheye_svp_ros.io.recording_files import ROS1_SUFFIX, metadata_topics, recording_files
from fisheye_svp_ros.io.ros1_bags import ros1_messages, ros1_topics, ros1_types

_ZSTD = b'\x28\xb5\x2f\xfd'  # CDR begins with 0
_EXPANDS = 1000  # times the size of a file, at most
_BLOCK_BYTES = 1 << 20  # bytes
_MAX_LISTED = 3  # places of damage
_DEPTH = 100  # messages that a player offers to send again, of latched topics as well
_CHECKSUM = 9 + 3 * 8  # bytes from the start of a chunk to its checksum
_UNLIMITED_TIME = QosTime(9223372036, 854775807)  # as rmw has it


_READERS = {'.db3': database_messages, ROS1_SUFFIX: ros1_messages}  # others are MCAP


@contextmanager
def decompress_file(file: Path, note: Callable[[str], None]) -> Iterator[Path]:
    """Yield a file as it was before rosbag2 compressed it: itself, or a temporary one.

    note: told what is damaged.  Raises BagError where there is no room for it.
    """
    if file.suffix != '.zstd':
        yield file
        return
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / file.stem
        try:
            _decompress(file, whole)
        except (zstandard.ZstdError, ValueError) as cause:
            note(f'{file.name} is damaged ({cause})')
        except OSError as cause:
            raise BagError(f'{file}: cannot be decompressed ({cause.strerror})') from cause
        yield whole


def unpacked_message(data: bytes) -> bytes:
    """Return a message as it was before rosbag2 compressed it, if it did.

    Raises ValueError for more than is read, ZstdError for one that is damaged.
    """
    if not data.startswith(_ZSTD):
        return data
    if zstandard.frame_content_size(data) > MAX_BYTES:
        raise ValueError(f'it is compressed from more than {MAX_BYTES} bytes')
    return zstandard.ZstdDecompressor().decompress(data, max_output_size=MAX_BYTES)


def _decompress(file: Path, whole: Path) -> None:
    most, size = _EXPANDS * file.stat().st_size, 0
    reader = zstandard.ZstdDecompressor().stream_reader
    with file.open('rb') as packed, reader(packed) as stream, whole.open('wb') as output:
        while piece := stream.read(_BLOCK_BYTES):
            size += output.write(piece)
            if size > most:
                raise ValueError(f'more than {_EXPANDS} times its size comes out of it')


class OfferedQos(NamedTuple):
    """The quality of service a publisher offers, as far as a player of a recording needs it."""

    reliable: bool = True
    latched: bool = False


class _Storage(McapWriter):
    """The writer of rosbags, with the checksums and hashes of types that it leaves out.

    The file has the name that rosbag2 gives it; `ros2 bag reindex` looks for no other.
    """

    def __init__(self, path: Path, compression: Any) -> None:
        super().__init__(path, compression)
        self.path = self.path.rename(path / f'{path.name}_0.mcap')

    def add_connection(self, connection: Connection, offered_qos_profiles: str) -> None:
        place, more = self.chunk.bio.tell(), BytesIO()
        super().add_connection(connection, offered_qos_profiles)
        # `ros2 bag reindex` knows the hash from nowhere else.
        write_string(more, 'topic_type_hash')
        write_string(more, connection.digest)
        channel = self.channels[-1]
        self.channels[-1] = channel._replace(metadata=channel.metadata + more.getvalue())
        self.chunk.bio.seek(place)
        write_channel(self.chunk.bio, self.channels[-1], self.schemas)

    def close_chunk(self) -> None:
        if not self.chunk.msgs:  # rosbag2 plays nothing of a file that begins with such a chunk
            return
        start, checksum = self.bio.tell(), zlib.crc32(self.chunk.bio.getbuffer())
        super().close_chunk()
        end = self.bio.tell()
        self.bio.seek(start + _CHECKSUM)
        self.bio.write(struct.pack('<I', checksum))
        self.bio.seek(end)


class BagWriter:
    """Writes CDR messages to a new rosbag2 folder with one MCAP file; a context manager.

    Raises BagError where the folder exists or cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path = final_path(path)
        self.count = 0
        try:
            self._writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
            self._writer.STORAGE_PLUGINS = {StoragePlugin.MCAP: _Storage}
            self._writer.open()
        except (WriterError, OSError) as cause:
            raise BagError(f'{path}: a recording cannot be written there ({cause})') from cause
        self._connections: dict[str, Connection] = {}
        self._last = 0

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._writer.close()
        except OSError as cause:
            raise BagError(f'{self.path}: cannot be completed ({cause.strerror})') from cause

    def add(
        self, topic: str, typename: str, offered: Sequence[OfferedQos] = (OfferedQos(),)
    ) -> None:
        """Begin a topic, so that whoever plays the recording offers what its publishers did.

        Raises BagError for a type that is not known.
        """
        try:
            self._connections[topic] = self._writer.add_connection(
                topic,
                typename,
                typestore=_types(),
                offered_qos_profiles=[_profile(profile) for profile in offered],
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
        except OSError as cause:
            raise BagError(f'{self.path}: cannot be written ({cause.strerror})') from cause

    def flush(self) -> None:
        """Hand to the operating system what has been written so far."""
        storage: Any = self._writer.storage
        try:
            # The writer keeps a chunk of a megabyte in memory; a crash would lose it.
            if storage.chunk.bio.tell():
                storage.close_chunk()
            storage.bio.flush()
        except OSError as cause:
            raise BagError(f'{self.path}: cannot be written ({cause.strerror})') from cause


class Bag:
    """A recording to read; `damage` says what is wrong with it, empty for nothing."""

    def __init__(self, path: str | Path) -> None:
        """Find the recording; raise BagError where there is none."""
        self.path = Path(path)
        self.damage = ''
        if not self.path.exists():
            raise BagError(f'{path}: no such recording; check the path')
        if self.path.is_dir() and not self._files():
            raise BagError(f'{path}: no .mcap or .db3 file in this folder')
        if odd := [file for file in self._files() if not file.is_file()]:
            raise BagError(f'{odd[0]}: not a regular file')

    @property
    def size(self) -> int:
        """The size of all its files, bytes."""
        return sum(file.stat().st_size for file in self._files())

    def records(
        self, wanted: Callable[[str, str], bool], passed: Callable[[int], None] = lambda _: None
    ) -> Iterator[Record]:
        """Yield the messages for which `wanted(topic, typename)` holds, in the order of time.

        passed: told how many bytes more have been read, of `size`.

        Of a recording that was cut short or damaged everything whole is yielded, and in the end
        `damage` says so.  Raises BagError where nothing can be read.
        """
        store = ros1_types() if self._is_ros1 else _types()
        notes: list[str] = []
        for topic, typename, when, data in self._raw(notes.append, passed):
            if typename not in store.fielddefs or not wanted(topic, typename):
                continue
            try:
                if self._is_ros1:
                    message = store.deserialize_ros1(data, typename)
                else:
                    message = store.deserialize_cdr(unpacked_message(data), typename)
            except Exception as cause:
                notes.append(f'a message on {topic} cannot be read ({cause})')
                continue
            yield Record(topic, typename, when, message)
        if notes:
            more = f' and {len(notes) - _MAX_LISTED} more' if len(notes) > _MAX_LISTED else ''
            self.damage = (
                'it is damaged, and only its intact parts are read; '
                + '; '.join(notes[:_MAX_LISTED])
                + more
            )

    def topics(self) -> set[tuple[str, str]]:
        """Return the topics and their types; raise BagError where nothing can be read."""
        listed = [_list_topics(file) for file in self._files()]
        if all(listed):
            return set().union(*listed)
        return {(message.topic, message.typename) for message in self._raw(_ignore, _ignore)}

    @property
    def _is_ros1(self) -> bool:
        return self.path.suffix.lower() == ROS1_SUFFIX

    def _files(self) -> list[Path]:
        return recording_files(self.path)

    def _raw(self, note: Callable[[str], None], passed: Callable[[int], None]) -> Iterator[Record]:
        """Yield all messages; raise BagError where nothing is whole."""
        problems, count = list[str](), 0

        def say(problem: str) -> None:
            problems.append(problem)
            note(problem)

        for file in self._files():
            with decompress_file(file, say) as plain:
                read = _READERS.get(plain.suffix.lower(), whole_messages)
                for message in read(plain, say, passed if plain == file else _ignore):
                    count += 1
                    yield message
            if plain != file:
                passed(file.stat().st_size)
        if problems and not count:
            raise BagError(
                f'{self.path}: not a recording, or no part of it is intact '
                f'({"; ".join(problems[:_MAX_LISTED])})'
            )


def _list_topics(file: Path) -> set[tuple[str, str]]:
    """Return the topics and types that a file, or the metadata beside it, lists; empty if not."""
    if file.suffix == '.zstd':
        return metadata_topics(file.parent)  # it is not unpacked for this alone
    if file.suffix.lower() == ROS1_SUFFIX:
        return ros1_topics(file)
    return database_topics(file) if file.suffix == '.db3' else listed_topics(file)


def _ignore(_: object) -> None:
    pass


def _profile(offered: OfferedQos) -> Qos:
    """Return a profile as a recording holds it; discovery does not tell of the history."""
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=_DEPTH,
        reliability=QosReliability.RELIABLE if offered.reliable else QosReliability.BEST_EFFORT,
        durability=(QosDurability.TRANSIENT_LOCAL if offered.latched else QosDurability.VOLATILE),
        deadline=_UNLIMITED_TIME,
        lifespan=_UNLIMITED_TIME,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=_UNLIMITED_TIME,
        avoid_ros_namespace_conventions=False,
    )


@cache
def _types() -> Any:
    return get_typestore(Stores.ROS2_JAZZY)
