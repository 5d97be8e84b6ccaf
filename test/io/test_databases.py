"""Recordings in SQLite, recordings that rosbag2 compressed, and what only looks like one."""

from __future__ import annotations

import resource
import sqlite3
import tempfile
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
import zstandard
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from fisheye_svp_ros.errors import BagError, ObservationError
from fisheye_svp_ros.io import bags
from fisheye_svp_ros.io.bags import Bag
from fisheye_svp_ros.io.readers import read_observations

PLUGINS = list(StoragePlugin)
TEXT = 'std_msgs/msg/String'


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Return a function that records two messages and returns the recording's only file."""

    def record(plugin: StoragePlugin, mode: CompressionMode = CompressionMode.NONE) -> Path:
        store = get_typestore(Stores.ROS2_JAZZY)
        text = store.types[TEXT]
        writer = Writer(tmp_path / 'bag', version=9, storage_plugin=plugin)
        writer.set_compression(mode, CompressionFormat.ZSTD)
        with writer:
            topic = writer.add_connection('/text', TEXT, typestore=store)
            for when in (1, 2):
                writer.write(topic, when, store.serialize_cdr(text(data='a'), TEXT))
        (found,) = (path for path in (tmp_path / 'bag').iterdir() if path.name != 'metadata.yaml')
        return found

    return record


@pytest.fixture
def recording(write: Callable[..., Path]) -> Path:
    """Return the database of a recording of two messages."""
    return write(StoragePlugin.SQLITE3)


def texts(path: Path) -> list[str]:
    bag = Bag(path)
    found = [record.message.data for record in bag.records(lambda *_: True)]
    assert not bag.damage
    return found


@pytest.mark.parametrize(
    'mode', [CompressionMode.NONE, CompressionMode.MESSAGE, CompressionMode.FILE]
)
@pytest.mark.parametrize('plugin', PLUGINS)
def test_a_recording_is_read_however_it_is_stored_and_without_its_metadata(
    write: Callable[..., Path], plugin: StoragePlugin, mode: CompressionMode
) -> None:
    file = write(plugin, mode)
    assert texts(file) == texts(file.parent) == ['a', 'a']
    (file.parent / 'metadata.yaml').unlink()
    assert texts(file.parent) == ['a', 'a']
    assert Bag(file.parent).topics() == {('/text', TEXT)}
    passed: list[int] = []
    assert len(list(Bag(file).records(lambda *_: True, passed.append))) == 2
    assert 0 < sum(passed) <= Bag(file).size


@pytest.mark.parametrize(('metadata', 'times'), [('', 0), ('rosbag2_bagfile_information: 3', 1)])
def test_a_compressed_file_is_not_unpacked_to_list_topics_that_its_metadata_lists(
    write: Callable[..., Path], monkeypatch: pytest.MonkeyPatch, metadata: str, times: int
) -> None:
    file, unpack = write(StoragePlugin.MCAP, CompressionMode.FILE), bags._decompress
    unpacked: list[Path] = []
    monkeypatch.setattr(
        bags, '_decompress', lambda packed, whole: (unpacked.append(packed), unpack(packed, whole))
    )
    if metadata:
        (file.parent / 'metadata.yaml').write_text(metadata)
    assert Bag(file.parent).topics() == Bag(file).topics() == {('/text', TEXT)}
    assert len(unpacked) == 2 * times


def test_what_was_decompressed_beside_the_compressed_file_is_not_read_twice(
    write: Callable[..., Path],
) -> None:
    file = write(StoragePlugin.MCAP, CompressionMode.FILE)
    plain = zstandard.ZstdDecompressor().stream_reader(file.read_bytes()).read()
    file.with_suffix('').write_bytes(plain)
    assert texts(file.parent) == ['a', 'a']


def test_a_compressed_file_that_was_cut_short_yields_what_is_whole(
    write: Callable[..., Path],
) -> None:
    file = write(StoragePlugin.MCAP, CompressionMode.FILE)
    plain = zstandard.ZstdDecompressor().stream_reader(file.read_bytes()).read()
    file.write_bytes(zstandard.ZstdCompressor().compress(plain[:-50]))
    assert len(list((bag := Bag(file)).records(lambda *_: True))) == 2
    assert 'only its intact parts are read' in bag.damage
    file.write_bytes(bytes(100))
    with pytest.raises(BagError, match=r'bag.mcap.zstd is damaged'):
        list(Bag(file).records(lambda *_: True))


def test_observations_are_looked_for_in_every_kind_of_recording(recording: Path) -> None:
    for path in (recording, recording.parent):
        with pytest.raises(ObservationError, match='observations need image_points and landmarks'):
            read_observations(path)


COMPUTED = """
CREATE TABLE new(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,
                 data BLOB GENERATED ALWAYS AS (zeroblob(900000000)) VIRTUAL);
INSERT INTO new SELECT id, topic_id, timestamp FROM messages;
DROP TABLE messages;
ALTER TABLE new RENAME TO messages;
"""


@pytest.mark.parametrize(
    'change',
    [
        COMPUTED,
        'UPDATE messages SET data = 900000000',
        'UPDATE topics SET name = zeroblob(9)',
        "CREATE VIEW more AS SELECT 1; UPDATE messages SET data = 'a'",
    ],
)
def test_what_a_few_bytes_stand_for_is_not_made_up(recording: Path, change: str) -> None:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with closing(sqlite3.connect(recording)) as database:
        database.executescript(change)
    with pytest.raises(BagError, match='its tables hold what no recording does'):
        texts(recording)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000


@pytest.mark.slow
def test_a_small_file_that_stands_for_gigabytes_is_not_decompressed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, 'tempdir', str(tmp_path))
    path, size = tmp_path / 'bag_0.mcap.zstd', 1 << 28
    path.write_bytes(zstandard.ZstdCompressor().compress(bytes(size)))
    with pytest.raises(BagError, match='more than 1000 times its size comes out of it'):
        list(Bag(path).records(lambda *_: True))
    assert list(tmp_path.iterdir()) == [path]


def test_a_small_message_that_stands_for_gigabytes_is_not_decompressed(recording: Path) -> None:
    claims = b'\x28\xb5\x2f\xfd\xe0' + (1 << 40).to_bytes(8, 'little')
    with closing(sqlite3.connect(recording)) as database:
        database.execute('UPDATE messages SET data = ? WHERE timestamp = 1', [claims])
        database.commit()
    bag = Bag(recording)
    assert len(list(bag.records(lambda *_: True))) == 1
    assert 'it is compressed from more than 268435456 bytes' in bag.damage
