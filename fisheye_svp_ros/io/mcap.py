"""What is whole in an MCAP file that was cut short or damaged.

Readers of MCAP trust the index at its end; here every chunk is looked at on its own, and believed
where its checksum fits.  Source: mcap.dev/spec.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import IO, Any, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk

_LARGEST = 1 << 30  # bytes of a record that is taken for one


class RawMessage(NamedTuple):
    """One recorded message: time in ns, data as CDR."""

    topic: str
    typename: str
    time: int
    data: bytes


def whole_messages(path: Path, note: Callable[[str], None]) -> Iterator[RawMessage]:
    """Yield every whole message of an MCAP file, in the order of the file.

    note: told what is damaged, and where.
    """
    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
    with path.open('rb') as stream:
        for record in _records(stream, note):
            if isinstance(record, Schema):
                schemas[record.id] = record.name
            elif isinstance(record, Channel):
                channels[record.id] = record.topic, schemas.get(record.schema_id, '')
            elif isinstance(record, Message) and record.channel_id in channels:
                yield RawMessage(*channels[record.channel_id], record.log_time, record.data)


def _records(stream: IO[bytes], note: Callable[[str], None]) -> Iterator[Any]:
    place = 0
    try:
        for record in StreamReader(stream, emit_chunks=True, record_size_limit=_LARGEST).records:
            if isinstance(record, Chunk):
                yield from _contents(record, f'the chunk that ends at byte {stream.tell()}', note)
            else:
                yield record
            place = stream.tell()
        return
    except Exception as cause:
        note(f'from byte {place} on it cannot be followed ({cause or "its end is missing"})')
    for start in sorted({place, *(s for s in _indexed_chunks(stream) if s > place)}):
        stream.seek(start)
        if stream.read(9)[:1] != bytes([Opcode.CHUNK]):
            continue
        where = f'the chunk at byte {start}'
        try:
            chunk = Chunk.read(ReadDataStream(stream))
        except Exception as cause:
            note(f'{where} cannot be read ({cause})')
            continue
        yield from _contents(chunk, where, note)


def _indexed_chunks(stream: IO[bytes]) -> list[int]:
    """Return where the index at the end of a file says that chunks start; empty without one."""
    try:
        stream.seek(0)
        summary = make_reader(stream).get_summary()
    except Exception:
        return []
    return sorted(c.chunk_start_offset for c in summary.chunk_indexes) if summary else []


def _contents(chunk: Chunk, where: str, note: Callable[[str], None]) -> list[Any]:
    """Return the records of a chunk; of one that is cut short, where it is not compressed."""
    try:
        if chunk.compression or len(chunk.data) == chunk.uncompressed_size:
            return breakup_chunk(chunk, validate_crc=True)
    except Exception as cause:
        note(f'{where} is damaged ({cause})')
        return []
    note(f'{where} is cut short')
    data, records = ReadDataStream(BytesIO(chunk.data)), []
    kinds: dict[int, Any] = {Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel}
    while data.count + 9 <= len(chunk.data):
        kind, size = data.read1(), data.read8()
        if data.count + size > len(chunk.data):
            break
        if kind == Opcode.MESSAGE:
            records.append(Message.read(data, size))
        elif kind in kinds:
            records.append(kinds[kind].read(data))
        else:
            data.read(size)
    return records
