"""The files of a rosbag2 recording, by their names and what its metadata says of it."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path

from fisheye_svp_ros.errors import BagError
from fisheye_svp_ros.io.files import read_yaml
from fisheye_svp_ros.io.paths import visible_paths

ROS1_SUFFIX = '.bag'
_SUFFIXES = ('.mcap', '.db3', '.mcap.zstd', '.db3.zstd')


def is_recording(path: Path) -> bool:
    """Say whether a path is called as a file of a recording is, or a folder with one in it.

    Bags of ROS 1 are files; in a folder they are nobody's parts.
    """
    if path.is_dir():
        return bool(_files_in(path))
    return path.name.lower().endswith((*_SUFFIXES, ROS1_SUFFIX))


def recording_files(path: Path) -> list[Path]:
    """Return the files of a recording, by the numbers in their names; a file is one, whatever."""
    return sorted(
        _files_in(path) if path.is_dir() else [path],
        key=lambda file: [
            (int(word), '') if word.isdecimal() else (0, word)
            for word in re.split(r'(\d+)', file.name)
        ],
    )


def metadata_topics(folder: Path) -> set[tuple[str, str]]:
    """Return the topics and types that the metadata of a recording lists; empty without."""
    with suppress(BagError, KeyError, TypeError):
        information = read_yaml(folder / 'metadata.yaml', BagError)['rosbag2_bagfile_information']
        topics = [topic['topic_metadata'] for topic in information['topics_with_message_count']]
        return {(str(topic['name']), str(topic['type'])) for topic in topics}
    return set()


def _files_in(folder: Path) -> list[Path]:
    """Return the files of a recording; of one that is there both ways, as it plays, the plain."""
    files = [file for file in visible_paths(folder.iterdir()) if file.name.endswith(_SUFFIXES)]
    return [file for file in files if file.suffix != '.zstd' or file.with_suffix('') not in files]
