"""The messages of a recording's file as far as they are whole: cut short, damaged or neither.

Readers of MCAP trust the index at its end, which has no checksum in many a file; here the file is
read from its beginning, and a chunk is believed where its checksum fits.  Source: mcap.dev/spec.
SQLite is read as rosbag2 writes it.
"""

from __future__ import annotations

import sqlite3
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from io import BytesIO
from pathlib import Path
from typing import IO, Any, NamedTuple
from urllib.parse import quote

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Message, Schema, Statistics

from fisheye_svp_ros.errors import BagError

MAX_BYTES = 1 << 28  # bytes of a chunk or a message, decompressed
_MAGIC = b'\x89MCAP0\r\n'
_HEAD = struct.Struct('<BQ')  # of a record: opcode, length

_Note = Callable[[str], None]
_Passed = Callable[[int], None]
_MESSAGES = (
    'SELECT name, type, timestamp, data FROM messages CROSS JOIN topics '
    'ON topics.id = topic_id ORDER BY timestamp, messages.id'
)
_COMPUTED_CELLS = (
    'SELECT 1 FROM sqlite_master AS m, pragma_table_xinfo(m.name) AS c WHERE c.hidden '
    "OR m.type = 'view' OR m.sql LIKE 'CREATE VIRTUAL %' LIMIT 1"
)
_COLUMN_TYPES = [str, str, int, bytes]


class RawMessage(NamedTuple):
    """One recorded message: time in ns, data as CDR."""

    topic: str
    typename: str
    time: int
    data: bytes


def whole_messages(
    path: Path, note: _Note, passed: _Passed = lambda _: None
) -> Iterator[RawMessage]:
    """Yield every whole message of an MCAP file; by time, within chunks that follow each other.

    note: told what is damaged, and where; passed: told how many bytes more have been read.
    """
    held: list[RawMessage] = []
    for batch in _batches(path, note, passed):
        first = min(message.time for message in batch)
        yield from (message for message in held if message.time <= first)
        rest = (message for message in held if message.time > first)
        held = sorted((*rest, *batch), key=lambda message: message.time)
    yield from held


def listed_topics(path: Path) -> set[tuple[str, str]]:
    """Return the topics and types that the summary of an MCAP file lists; empty without one."""
    with path.open('rb') as stream:
        summary = _summary(stream)
    if summary is None:
        return set()
    return {
        (channel.topic, schema.name)
        for channel in summary.channels.values()
        if (schema := summary.schemas.get(channel.schema_id))
    }


def _batches(path: Path, note: _Note, passed: _Passed) -> Iterator[list[RawMessage]]:
    """Yield the messages of each chunk that holds any."""
    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
    count, promised, place = 0, None, 0
    with path.open('rb') as stream:
        for records in _groups(stream, path.stat().st_size, note):
            passed(stream.tell() - place)
            place = stream.tell()
            batch = []
            for record in records:
                if isinstance(record, Schema):
                    schemas[record.id] = record.name
                elif isinstance(record, Channel):
                    channels[record.id] = record.topic, schemas.get(record.schema_id, '')
                elif isinstance(record, Statistics):
                    promised = record.message_count
                elif record.channel_id in channels:
                    where = channels[record.channel_id]
                    batch.append(RawMessage(*where, record.log_time, record.data))
            count += len(batch)
            if batch:
                yield batch
    if promised not in (None, count):
        note(f'{promised} messages were written, {count} are found')


def _groups(stream: IO[bytes], size: int, note: _Note) -> Iterator[list[Any]]:
    """Yield the records of each chunk, and each record that is in none, as lists."""
    place, data = len(_MAGIC), True
    if stream.read(place) != _MAGIC:
        note('it does not begin as an MCAP file does')
    while head := stream.read(_HEAD.size):
        opcode, length = _HEAD.unpack(head.ljust(_HEAD.size, b'\0'))
        body = stream.read(min(length, size))
        if len(body) < length or len(head) < _HEAD.size:
            if opcode == Opcode.CHUNK:
                yield _contents(body, f'the chunk at byte {place}', note)
            break
        if opcode == Opcode.FOOTER:
            if stream.read(len(_MAGIC) + 1) == _MAGIC:
                return
            break
        # What the summary repeats of the data is not looked at.
        data = data and opcode != Opcode.DATA_END
        if opcode == Opcode.CHUNK and data:
            yield _contents(body, f'the chunk at byte {place}', note)
        elif opcode == Opcode.STATISTICS or data:
            yield _parse_record(opcode, body, f'the record at byte {place}', note)
        place = stream.tell()
    note(f'it cannot be read from byte {place} on')
    summary = _summary(stream)
    chunks = summary.chunk_indexes if summary else ()
    for start in sorted(chunk.chunk_start_offset for chunk in chunks):
        if place < start < size:
            stream.seek(start)
            opcode, length = _HEAD.unpack(stream.read(_HEAD.size).ljust(_HEAD.size, b'\0'))
            if opcode == Opcode.CHUNK:
                body = stream.read(min(length, size))
                yield _contents(body, f'the chunk at byte {start}', note)


def _summary(stream: IO[bytes]) -> Any:
    try:
        stream.seek(0)
        return make_reader(stream).get_summary()
    except Exception:  # whatever mcap makes of what is damaged, or no MCAP file at all
        return None


def _contents(body: bytes, where: str, note: _Note) -> list[Any]:
    """Return the records of a chunk; of one that is cut short, where it is not compressed."""
    try:
        chunk = Chunk.read(ReadDataStream(BytesIO(body)))
        data = _decompress(chunk)
    except Exception as cause:
        note(f'{where} is damaged ({cause or type(cause).__name__})')
        return []
    if len(data) < chunk.uncompressed_size and not chunk.compression:
        note(f'{where} is cut short')
    elif chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        note(f'{where} is damaged (its checksum does not fit)')
        return []
    records, place = [], 0
    while place + _HEAD.size <= len(data):
        opcode, length = _HEAD.unpack_from(data, place)
        place += _HEAD.size + length
        if place <= len(data):
            records += _parse_record(opcode, data[place - length : place], where, note)
    return records


def _decompress(chunk: Chunk) -> bytes:
    """Return the data of a chunk; raise ValueError for more than was announced."""
    size: int = chunk.uncompressed_size
    if size > MAX_BYTES:
        raise ValueError(f'it has {size} bytes; up to {MAX_BYTES} are read')
    if not chunk.compression:
        return bytes(chunk.data)
    data: bytes
    if chunk.compression == 'zstd':
        with zstandard.ZstdDecompressor().stream_reader(chunk.data) as stream:
            data = stream.read(size + 1)
    elif chunk.compression == 'lz4':
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    else:
        raise ValueError(f'compression {chunk.compression!r} is unknown')
    if len(data) != size:
        raise ValueError('its size is not the announced one')
    return data


def _parse_record(opcode: int, body: bytes, where: str, note: _Note) -> list[Any]:
    """Return the record of a body in a list; empty for one that tells nothing of messages."""
    stream = ReadDataStream(BytesIO(body))
    kinds: dict[int, Any] = {
        Opcode.SCHEMA: Schema,
        Opcode.CHANNEL: Channel,
        Opcode.STATISTICS: Statistics,
    }
    try:
        if opcode == Opcode.MESSAGE:
            return [Message.read(stream, len(body))]
        return [kinds[opcode].read(stream)] if opcode in kinds else []
    except Exception as cause:
        note(f'{where} is damaged ({cause or type(cause).__name__})')
        return []


def database_messages(
    path: Path, note: Callable[[str], None], passed: Callable[[int], None] = lambda _: None
) -> Iterator[RawMessage]:
    """Yield the messages of a database, by time, as far as it can be read.

    note: told why not further; passed: told how many bytes more have been read.
    """
    try:
        with closing(_connect(path)) as database:
            for row in database.execute(_MESSAGES):
                _refuse_unless([type(cell) for cell in row] == _COLUMN_TYPES)
                passed(len(row[-1]))
                yield RawMessage(*row)
    except (sqlite3.Error, BagError) as cause:
        note(f'it cannot be read on ({cause})')


def database_topics(path: Path) -> set[tuple[str, str]]:
    """Return the topics and types that a database lists; empty where it cannot be read."""
    with suppress(sqlite3.Error, BagError), closing(_connect(path)) as database:
        return {
            (str(topic), str(kind))
            for topic, kind in database.execute('SELECT name, type FROM topics')
        }
    return set()


def _connect(path: Path) -> sqlite3.Connection:
    """Open a database; raise BagError for computed cells, of which few bytes make gigabytes."""
    database = sqlite3.connect(f'file:{quote(str(path.absolute()))}?mode=ro', uri=True)
    try:
        _refuse_unless(not database.execute(_COMPUTED_CELLS).fetchone())
    except BaseException:
        database.close()
        raise
    return database


def _refuse_unless(usual: bool) -> None:
    if not usual:
        raise BagError('its tables hold what no recording does')
