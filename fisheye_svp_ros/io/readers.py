"""Readers: files of measured or simulated image points to one table of observations.

A new reader is one module with `read(path) -> Observations` and one line in READERS; another
distribution adds a `Reader` by an entry point in the group `fisheye_svp_ros.readers`.
Photographs and image sizes are read from what `detect` wrote beside its observations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

from fisheye_svp_ros.errors import LensError, ObservationError, ParameterError
from fisheye_svp_ros.io.csv_files import (
    FramePoses,
    read_poses,
    write_observations,
    write_poses,
)
from fisheye_svp_ros.io.files import read_json
from fisheye_svp_ros.io.paths import path_of, visible_paths
from fisheye_svp_ros.io.recording_files import is_recording
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.registry import Registry
from fisheye_svp_ros.scene.observations import Observations

Sizes = dict[str, tuple[int, int]]  # width and height, px, by camera
__all__ = [
    'READERS',
    'FramePoses',
    'Reader',
    'read_observations',
    'read_poses',
    'write_observations',
    'write_poses',
]


def photographs_beside(path: Path, cameras: Sequence[str]) -> tuple[tuple[int, str, str], ...]:
    """Return frame, camera and path of the photographs that `detect` wrote beside observations."""
    beside = path.with_suffix('.detect.json')
    if not beside.exists():
        return ()
    try:
        entries = [
            (int(entry['frame']), str(entry['camera']), str(entry['name']))
            for entry in read_json(beside, ObservationError).get('photographs', ())
        ]
    except (KeyError, TypeError, ValueError) as cause:
        raise ObservationError(
            f'{beside}: photographs is not a list of name, camera and frame '
            f'({cause}); run `fisheye-svp detect` again'
        ) from cause
    return tuple(entry for entry in entries if entry[0] >= 0 and entry[1] in cameras)


def sizes_beside(path: Path) -> Sizes:
    """Return the image size of each camera that `detect` wrote beside its observations."""
    beside = path.with_suffix('.detect.json')
    if not beside.exists():
        return {}
    document = read_json(beside, ObservationError)
    entries = document.get('image_sizes', {'': document.get('image_size')})
    sizes: Sizes = {}
    for camera, entry in entries.items() if isinstance(entries, dict) else ():
        match entry:
            case [int(width), int(height)] if width > 0 < height:
                sizes[camera] = width, height
    if not sizes:
        raise ObservationError(f'{beside}: image_sizes must be whole numbers; give --image-size')
    return sizes


def check_sizes(path: str, sizes: Sizes, lenses: Mapping[str, Lens]) -> None:
    """Raise LensError where images are of another size than their lens.

    sizes: as far as they are known from elsewhere than from what `detect` wrote.
    """
    sizes = sizes or sizes_beside(Path(path))
    for camera, lens in lenses.items():
        size = sizes.get(camera) or sizes.get('')
        if size and size != (lens.width, lens.height):
            raise LensError(
                f'{path}: images are {size[0]}x{size[1]} px, lens {lens.name!r} is '
                f'for {lens.width}x{lens.height} px; give the lens of this camera at '
                'this size'
            )


def check_size_given(path: str, sizes: Sizes, given: Sizes, name: str) -> None:
    """Raise ParameterError where images have another size than an argument; sizes: as above."""
    for camera, (width, height) in (sizes or sizes_beside(Path(path))).items():
        size = given.get(camera) or given.get('') or (width, height)
        if size != (width, height):
            raise ParameterError(
                f'{path}: images are {width}x{height} px, {name} is '
                f'{size[0]}x{size[1]}; give the size of the images'
            )


class Reader(NamedTuple):
    """One form of observations: its name for people, how to tell it, the module that reads it."""

    form: str
    recognises: Callable[[Path], bool]
    module: str


_PACKAGE = 'fisheye_svp_ros.io'
READERS: Registry[Reader] = Registry(
    'readers',
    {
        reader.form: reader
        for reader in (
            Reader(
                'a .csv file', lambda path: path.suffix.lower() == '.csv', f'{_PACKAGE}.csv_files'
            ),
            Reader('an .orpc file', lambda path: path.suffix == '.orpc', f'{_PACKAGE}.orpc'),
            Reader(
                'a folder of .orpc files',
                lambda path: path.is_dir() and bool(visible_paths(path.glob('*.orpc'))),
                f'{_PACKAGE}.orpc',
            ),
            Reader('a recording (rosbag2, ROS 1)', is_recording, f'{_PACKAGE}.recording'),
        )
    },
    Reader,
)


def read_observations(path: str | Path) -> Observations:
    """Read observations in whichever form they come: a CSV file, a folder of ORPC files.

    Raises ObservationError, naming file, line and field, for anything missing or malformed.
    """
    location = path_of(path)
    for reader in READERS.values():
        if reader.recognises(location):
            read: Callable[[Path], Observations] = import_module(reader.module).read
            return read(location)
    if not location.exists():
        raise ObservationError(f'{path}: no such file or folder; check the path')
    forms = ', '.join(reader.form for reader in READERS.values())
    raise ObservationError(f'{path}: not observations in a known form; these are {forms}')
