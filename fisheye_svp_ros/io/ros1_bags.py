"""Bags of ROS 1: their topics and messages, read."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from rosbags.typesys import Stores, get_typestore

from fisheye_svp_ros.errors import BagError
from fisheye_svp_ros.io.mcap import Record

_REMEDY = 'copy it again, or run `rosbag reindex`'


@cache
def ros1_types() -> Any:
    """Return the types of ROS 1 Noetic."""
    return get_typestore(Stores.ROS1_NOETIC)


def ros1_topics(path: Path) -> set[tuple[str, str]]:
    """Return the topics and types of a bag; raise BagError where it cannot be read."""
    with _open_ros1(path) as reader:
        return {(connection.topic, connection.msgtype) for connection in reader.connections}


def ros1_messages(
    path: Path, note: Callable[[str], None], passed: Callable[[int], None]
) -> Iterator[Record]:
    """Yield the messages of a bag by time, as ROS 1 serializes them.

    note: told what is damaged; passed: told how many bytes more have been read.  Raises BagError
    where nothing can be read.
    """
    with _open_ros1(path) as reader:
        messages = reader.messages()
        while True:
            try:
                connection, when, data = next(messages)
            except StopIteration:
                break
            except Exception as cause:  # of whatever a damaged file leads a parser to
                note(f'{path.name} is damaged ({cause!r:.100})')
                break
            yield Record(connection.topic, connection.msgtype, when, data)
    passed(path.stat().st_size)


@contextmanager
def _open_ros1(path: Path) -> Iterator[Any]:
    from rosbags.rosbag1 import Reader  # where a bag is read alone

    reader = Reader(path)
    try:
        reader.open()
    except Exception as cause:  # of whatever a damaged file leads a parser to
        raise BagError(f'{path}: not a whole ROS 1 bag ({cause!s:.100}); {_REMEDY}') from cause
    with closing(reader):
        yield reader
