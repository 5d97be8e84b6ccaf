"""The files of a rosbag2 recording: which they are, and what is compressed in or around them."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import zstandard

from fisheye_svp_ros.errors import BagError
from fisheye_svp_ros.io.documents import read_yaml

MAX_BYTES = 1 << 28  # bytes of a chunk or a message, decompressed

_SUFFIXES = ('.mcap', '.db3', '.mcap.zstd', '.db3.zstd')
_ZSTD = b'\x28\xb5\x2f\xfd'  # CDR begins with 0
_EXPANDS = 1000  # times the size of a file, at most
_BLOCK_BYTES = 1 << 20  # bytes


def is_recording(path: Path) -> bool:
    """Say whether a path is called as a file of a recording is, or a folder with one in it."""
    return bool(_files_in(path)) if path.is_dir() else path.name.lower().endswith(_SUFFIXES)


def recording_files(path: Path) -> list[Path]:
    """Return the files of a recording, by the numbers in their names; a file is one, whatever."""
    return sorted(_files_in(path) if path.is_dir() else [path], key=lambda file: [
        (int(word), '') if word.isdecimal() else (0, word)
        for word in re.split(r'(\d+)', file.name)])


def metadata_topics(folder: Path) -> set[tuple[str, str]]:
    """Return the topics and types that the metadata of a recording lists; empty without."""
    with suppress(BagError, KeyError, TypeError):
        known = read_yaml(folder / 'metadata.yaml', BagError)['rosbag2_bagfile_information']
        topics = [topic['topic_metadata'] for topic in known['topics_with_message_count']]
        return {(str(topic['name']), str(topic['type'])) for topic in topics}
    return set()


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
            _unpack(file, whole)
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


def _files_in(folder: Path) -> list[Path]:
    """Return the files of a recording; of one that is there both ways, as it plays, the plain."""
    files = [file for file in folder.iterdir() if file.name.endswith(_SUFFIXES)]
    return [file for file in files if file.suffix != '.zstd' or file.with_suffix('') not in files]


def _unpack(file: Path, whole: Path) -> None:
    most, size = _EXPANDS * file.stat().st_size, 0
    reader = zstandard.ZstdDecompressor().stream_reader
    with file.open('rb') as packed, reader(packed) as stream, whole.open('wb') as output:
        while piece := stream.read(_BLOCK_BYTES):
            size += output.write(piece)
            if size > most:
                raise ValueError(f'more than {_EXPANDS} times its size comes out of it')
