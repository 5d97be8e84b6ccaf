"""What is whole in an MCAP file that was cut short: by a crash, a full disk, a broken copy.

Readers of MCAP start from the index at the end; here the file is read from its beginning up to the
first record that is not whole.  Source: mcap.dev/spec.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from rosbags.rosbag2.storage_mcap import DECOMPRESSORS

_MAGIC = b'\x89MCAP0\r\n'
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 0x03, 0x04, 0x05, 0x06
_RECORD = struct.Struct('<BQ')
_CHUNK_HEAD = struct.Struct('<QQQI')


class RawMessage(NamedTuple):
    """One recorded message: time in ns, data as CDR."""

    topic: str
    typename: str
    time: int
    data: bytes


def whole_messages(path: Path) -> Iterator[RawMessage]:
    """Yield every whole message of an MCAP file, in the order of the file."""
    data = path.read_bytes()
    if not data.startswith(_MAGIC):
        return
    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
    for kind, body in _records(data[len(_MAGIC):]):
        if kind == _SCHEMA:
            (number,) = struct.unpack_from('<H', body)
            schemas[number] = _string(body, 2)[0]
        elif kind == _CHANNEL:
            number, schema = struct.unpack_from('<HH', body)
            channels[number] = _string(body, 4)[0], schemas.get(schema, '')
        elif kind == _MESSAGE:
            number, _, time = struct.unpack_from('<HIQ', body)
            if number in channels:
                yield RawMessage(*channels[number], time, bytes(body[22:]))


def _records(data: bytes | memoryview) -> Iterator[tuple[int, memoryview]]:
    """Yield the whole records, those inside chunks included."""
    view, place = memoryview(data), 0
    while place + _RECORD.size <= len(view):
        kind, size = _RECORD.unpack_from(view, place)
        start, place = place + _RECORD.size, place + _RECORD.size + size
        if kind == _CHUNK:
            yield from _records(_chunk(view[start:place]))
        elif place <= len(view):
            yield kind, view[start:place]


def _chunk(body: memoryview) -> bytes | memoryview:
    """Return the records of a chunk; of one that is cut short only where it is not compressed."""
    if len(body) < _CHUNK_HEAD.size + 4:
        return b''
    _, _, size, _ = _CHUNK_HEAD.unpack_from(body)
    compression, end = _string(body, _CHUNK_HEAD.size)
    content = body[end + 8:]
    if not compression:
        return content
    try:
        return DECOMPRESSORS[compression](bytes(content), size)
    except Exception:
        return b''


def _string(body: memoryview, place: int) -> tuple[str, int]:
    (size,) = struct.unpack_from('<I', body, place)
    end = place + 4 + size
    return bytes(body[place + 4:end]).decode('utf-8', 'replace'), end
