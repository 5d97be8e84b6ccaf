"""Readers: files of measured or simulated image points to one table of observations.

A new reader is one module with `read(path) -> Observations` and one line in READERS; another
distribution adds a `Reader` by an entry point in the group `fisheye_svp_ros.readers`.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.io.csv_files import (
    FramePoses,
    read_poses,
    write_observations,
    write_poses,
)
from fisheye_svp_ros.io.files import path_of
from fisheye_svp_ros.io.recording_files import is_recording
from fisheye_svp_ros.registry import Registry
from fisheye_svp_ros.scene.observations import Observations

__all__ = [
    'READERS', 'FramePoses', 'Reader', 'read_observations', 'read_poses', 'write_observations',
    'write_poses',
]


class Reader(NamedTuple):
    """One form of observations: its name for people, how to tell it, the module that reads it."""

    form: str
    recognises: Callable[[Path], bool]
    module: str


_PACKAGE = 'fisheye_svp_ros.io'
READERS: Registry[Reader] = Registry('readers', {
    reader.form: reader for reader in (
        Reader('a .csv file', lambda path: path.suffix.lower() == '.csv',
               f'{_PACKAGE}.csv_files'),
        Reader('an .orpc file', lambda path: path.suffix == '.orpc', f'{_PACKAGE}.orpc'),
        Reader('a folder of .orpc files',
               lambda path: path.is_dir() and any(path.glob('*.orpc')), f'{_PACKAGE}.orpc'),
        Reader('a rosbag2 recording', is_recording, f'{_PACKAGE}.recording'),
    )
}, Reader)


def read_observations(path: str | Path) -> Observations:
    """Read observations in whichever form they come: a CSV file, a folder of ORPC files.

    Raises ObservationError, naming file, line and field, for anything missing or malformed.
    """
    given = path_of(path)
    for reader in READERS.values():
        if reader.recognises(given):
            read: Callable[[Path], Observations] = import_module(reader.module).read
            return read(given)
    if not given.exists():
        raise ObservationError(f'{path}: no such file or folder; check the path')
    forms = ', '.join(reader.form for reader in READERS.values())
    raise ObservationError(f'{path}: not observations in a known form; these are {forms}')
