"""Recordings in SQLite, and databases that only look like one."""

from __future__ import annotations

import resource
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from fisheye_svp_ros.errors import BagError
from fisheye_svp_ros.io.bags import Bag


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Return the database of a recording of two messages."""
    store = get_typestore(Stores.ROS2_JAZZY)
    text = store.types['std_msgs/msg/String']
    with Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        topic = writer.add_connection('/text', text.__msgtype__, typestore=store)
        for when in (1, 2):
            writer.write(topic, when, store.serialize_cdr(text(data='a'), text.__msgtype__))
    found, = (tmp_path / 'bag').glob('*.db3')
    return found


def texts(path: Path) -> list[str]:
    return [record.message.data for record in Bag(path).records(lambda *_: True)]


def test_a_recording_in_sqlite_is_read(recording: Path) -> None:
    assert texts(recording) == texts(recording.parent) == ['a', 'a']


COMPUTED = """
CREATE TABLE new(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,
                 data BLOB GENERATED ALWAYS AS (zeroblob(900000000)) VIRTUAL);
INSERT INTO new SELECT id, topic_id, timestamp FROM messages;
DROP TABLE messages;
ALTER TABLE new RENAME TO messages;
"""


@pytest.mark.parametrize('change', [
    COMPUTED,
    'UPDATE messages SET data = 900000000',
    "CREATE VIEW more AS SELECT 1; UPDATE messages SET data = 'a'",
])
def test_what_a_few_bytes_stand_for_is_not_made_up(recording: Path, change: str) -> None:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with closing(sqlite3.connect(recording)) as database:
        database.executescript(change)
    with pytest.raises(BagError, match='its tables hold what no recording does'):
        texts(recording)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000
