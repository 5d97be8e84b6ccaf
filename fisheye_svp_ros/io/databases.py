"""The messages of a recording in SQLite, as rosbag2 writes it."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path
from urllib.parse import quote

from fisheye_svp_ros.errors import BagError
from fisheye_svp_ros.io.mcap import RawMessage

_MESSAGES = ('SELECT name, type, timestamp, data FROM messages CROSS JOIN topics '
             'ON topics.id = topic_id ORDER BY timestamp, messages.id')
_COMPUTED_CELLS = (
    'SELECT 1 FROM sqlite_master AS m, pragma_table_xinfo(m.name) AS c WHERE c.hidden '
    "OR m.type = 'view' OR m.sql LIKE 'CREATE VIRTUAL %' LIMIT 1")
_COLUMN_TYPES = [str, str, int, bytes]


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
        return {(str(topic), str(kind)) for topic, kind in
                database.execute('SELECT name, type FROM topics')}
    return set()


def _connect(path: Path) -> sqlite3.Connection:
    """Open a database; raise BagError for cells that are computed.

    A few bytes of SQL can stand for gigabytes.
    """
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
