"""The messages of a recording's file as far as they can be read.

MCAP is read from its beginning by the reader of the package `mcap`, chunk by chunk: readers that
trust the index at its end get nothing of a recording that was cut short.  SQLite is read as
rosbag2 writes it.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import IO, Any, NamedTuple
from urllib.parse import quote

import lz4.frame
import zstandard
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Message, Schema, Statistics
from mcap.stream_reader import StreamReader, breakup_chunk

from fisheye_svp_ros.errors import BagError

MAX_BYTES = 1 << 28  # bytes of a chunk or a message, decompressed

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


class Record(NamedTuple):
    """One message of a recording: the time it was recorded at, ns, and its CDR, or its fields."""

    topic: str
    typename: str
    time: int
    message: Any


def whole_messages(path: Path, note: _Note, passed: _Passed = lambda _: None) -> Iterator[Record]:
    """Yield every whole message of an MCAP file; by time, within chunks that follow each other.

    note: told what is damaged, and where; passed: told how many bytes more have been read.
    """
    held: list[Record] = []
    for batch in _chunk_messages(path, note, passed):
        first = min(message.time for message in batch)
        yield from (message for message in held if message.time <= first)
        remaining = (message for message in held if message.time > first)
        held = sorted((*remaining, *batch), key=lambda message: message.time)
    yield from held


def listed_topics(path: Path) -> set[tuple[str, str]]:
    """Return the topics and types that the summary of an MCAP file lists; empty without one."""
    try:
        with path.open('rb') as stream:
            summary = make_reader(stream).get_summary()
    except Exception:  # whatever mcap makes of what is damaged, or no MCAP file at all
        return set()
    if summary is None:
        return set()
    return {
        (channel.topic, schema.name)
        for channel in summary.channels.values()
        if (schema := summary.schemas.get(channel.schema_id))
    }


def _chunk_messages(path: Path, note: _Note, passed: _Passed) -> Iterator[list[Record]]:
    """Yield the messages of each chunk that holds any."""
    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
    count, promised, place = 0, None, 0
    with path.open('rb') as stream:
        for records in _groups(stream, path, note):
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
                elif isinstance(record, Message) and record.channel_id in channels:
                    where = channels[record.channel_id]
                    batch.append(Record(*where, record.log_time, record.data))
            count += len(batch)
            if batch:
                yield batch
    if promised not in (None, count):
        note(f'{promised} messages were written, {count} can be read')


def _groups(stream: IO[bytes], path: Path, note: _Note) -> Iterator[list[Any]]:
    """Yield the records of each chunk, and each record that is in none, as lists."""
    whole: Any = _WholeReads(stream, path.stat().st_size)
    records, place = iter(StreamReader(whole, emit_chunks=True).records), 0
    while True:
        try:
            record = next(records)
        except StopIteration:
            return
        except Exception as cause:  # of whatever a damaged file leads a parser to
            note(
                f'{path.name} cannot be read from byte {place} on ({cause!s:.100}); '
                f'`mcap recover {path.name} -o FILE` may save more'
                if place
                else f'{path.name} is empty, or no MCAP file'
            )
            return
        try:
            group = _contents(record) if isinstance(record, Chunk) else [record]
        except Exception as cause:
            note(f'the chunk at byte {place} of {path.name} is damaged ({cause!s:.100})')
        else:
            yield group
        place = stream.tell()


class _WholeReads:
    """A stream that raises EndOfFile where it ends, in place of returning less than was asked."""

    def __init__(self, stream: IO[bytes], size: int) -> None:
        self._stream, self._size = stream, size

    def read(self, length: int) -> bytes:
        """Return so many bytes; a length that is damaged takes no memory."""
        data = self._stream.read(min(length, self._size))
        if len(data) < length:
            raise EndOfFile('it ends early')
        return data


def _contents(chunk: Chunk) -> list[Any]:
    """Return the records of a chunk; raise ValueError and others for one that is damaged."""
    data = _decompress(chunk)
    return breakup_chunk(replace(chunk, compression='', data=data), validate_crc=True)


def _decompress(chunk: Chunk) -> bytes:
    """Return the data of a chunk; raise ValueError for more than was announced."""
    size: int = chunk.uncompressed_size
    if size > MAX_BYTES:
        raise ValueError(f'it has {size} bytes; up to {MAX_BYTES} are read')
    data = bytes(chunk.data)
    if chunk.compression == 'zstd':
        with zstandard.ZstdDecompressor().stream_reader(chunk.data) as stream:
            data = stream.read(size + 1)
    elif chunk.compression == 'lz4':
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    elif chunk.compression:
        raise ValueError(f'compression {chunk.compression!r} is unknown')
    if len(data) != size:
        raise ValueError('its size is not the announced one')
    return data


def database_messages(
    path: Path, note: Callable[[str], None], passed: Callable[[int], None] = lambda _: None
) -> Iterator[Record]:
    """Yield the messages of a database, by time, as far as it can be read.

    note: told why not further; passed: told how many bytes more have been read.
    """
    try:
        with closing(_connect(path)) as database:
            for row in database.execute(_MESSAGES):
                _refuse_unless([type(cell) for cell in row] == _COLUMN_TYPES)
                passed(len(row[-1]))
                yield Record(*row)
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
