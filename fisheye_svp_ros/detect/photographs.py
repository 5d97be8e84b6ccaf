"""Photographs: from files, folders, videos and recordings; decoded to grey, one line if not."""

from __future__ import annotations

import itertools
import os
import re
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fisheye_svp_ros.detect.image_messages import image_pixels
from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.io.bags import Bag
from fisheye_svp_ros.io.files import read_bytes
from fisheye_svp_ros.io.recording_files import is_recording
from fisheye_svp_ros.scene.observations import STEREO

Pixels = NDArray[Any]  # (H, W), uint8 or uint16, grey

IMAGES = ('.png', '.jpg', '.jpeg', '.bmp', '.tif', '.tiff', '.pgm', '.ppm', '.webp', '.jp2')
VIDEOS = ('.mp4', '.avi', '.mov', '.mkv', '.webm', '.m4v')
# Files of a rig in one folder: left01.png, right01.png; cam0_0001.png, cam1_0001.png
_PREFIX = re.compile(r'(left|right|cam\d+)[_-]?(.+)', re.IGNORECASE)
_COMPRESSED_SUFFIX = '/compressed'
_MOST_SCANS = 32  # of a JPEG, each of which may take as long as the whole image; ten are usual
_PNG = b'\x89PNG\r\n\x1a\n'
# Tag 0x0112 of type 3 among the twelve-byte entries of an Exif block, in either byte order
_ORIENTATION = re.compile(
    rb'Exif\0\0(?:(II)|MM).{8}(?:.{12})*?(?:\x12\x01\x03\0.{4}|\x01\x12\0\x03.{4})(..)', re.DOTALL
)


@dataclass(frozen=True, eq=False)
class Photograph:
    """One photograph: its name for people, which instant and camera, t in s (NaN: unknown).

    data: a path or bytes of an image file, or pixels.
    """

    name: str
    key: str
    camera: str
    t: float
    data: Path | bytes | Pixels

    def pixels(self, color: bool = False) -> Pixels:
        """Return the image in grey; raise ObservationError, one line, where there is none.

        color: of a colored image file blue, green and red, (H, W, 3).
        """
        if isinstance(self.data, np.ndarray):
            return self.data
        data = self.data
        if isinstance(data, Path):
            data = read_bytes(data, ObservationError)
        return decode_image(data, self.name, color)


def find_photographs(paths: Sequence[str], every: int = 1) -> Iterator[Photograph]:
    """Yield the photographs of files, folders, videos and rosbag2 recordings, in their order.

    Subfolders such as left/ and right/, file names that begin so, or topics in such namespaces are
    the cameras of a rig; equal file names, and equal stamps, are the same instant.  A name that a
    camera had in an earlier path is another instant: the number of its path stands before it.
    every: take one of so many.
    Raises ObservationError for a path without any.
    """
    earlier: set[tuple[str, str]] = set()
    for place, path in enumerate(map(Path, paths)):
        number, own = -1, set()
        for number, photograph in enumerate(_source(path)):
            if number % every == 0:
                name = photograph.camera, photograph.key
                own.add(name)
                yield (
                    photograph
                    if name not in earlier
                    else replace(photograph, key=f'{place}/{photograph.key}')
                )
        earlier |= own
        if number < 0:
            raise ObservationError(
                f'{path}: it and its folders hold no photograph; images are {" ".join(IMAGES)}'
            )


def count_photographs(paths: Sequence[str], every: int = 1) -> int | None:
    """Return how many photographs `find_photographs` yields; None for videos and recordings."""
    count = 0
    for path in map(Path, paths):
        if path.suffix.lower() in VIDEOS or is_recording(path):
            return None
        count += -(-sum(1 for _ in _source(path)) // every)
    return count


def doubtful_folders(paths: Sequence[str]) -> Iterator[str]:
    """Yield what `find_photographs` makes of folders and may not be meant: a line each.

    Beside images of the folder itself those of its subfolders may be anything, pictures of results
    say; and files called after cameras are those of one where others are called otherwise.
    """
    given = [*map(Path, paths)]
    names = {folder: {p.stem for p in _images(folder)} for folder in given if folder.is_dir()}
    for before, after in itertools.pairwise(names):
        if names[before] & names[after]:
            yield (
                f'{before}, {after}: photographs of equal names are different frames of one '
                'camera; for the cameras of a rig give the folder above'
            )
    for folder in given:
        if not folder.is_dir() or is_recording(folder):
            continue
        files = _images(folder)
        for above in photograph_folders(folder):
            for sub in (p for p in sorted(above.iterdir()) if p.is_dir() and p not in given):
                if count := sum(len(_images(one)) for one in (sub, *_folders(sub))):
                    yield (
                        f'{sub}: its {count} images are skipped, since the folder above holds '
                        'images too; give it alone, or move the others into a subfolder'
                    )
        named = {p.name: match[1].lower() for p in files if (match := _PREFIX.fullmatch(p.stem))}
        other = next((p.name for p in files if p.name not in named), '')
        if other and len({*named.values()}) > 1:
            yield (
                f'{folder}: all images count as those of one camera, since {other} names none, '
                f'unlike {next(iter(named))}; rename or remove it'
            )


def is_photographs(path: Path) -> bool:
    """Say whether a path is taken for photographs rather than for observations."""
    if path.is_dir():
        return any(p.suffix.lower() in IMAGES for p in (*path.glob('*'), *path.glob('*/*')))
    return path.suffix.lower() in (*IMAGES, *VIDEOS)


def photograph_folders(path: Path) -> list[Path]:
    """Return the folders whose images are the photographs of a folder: itself, or those in it."""
    return [path] if _images(path) else _folders(path)


def decode_image(data: bytes, name: str, color: bool = False) -> Pixels:
    """Return an image file in grey, at its own depth and as its sensor lay: unturned.

    color: of a colored one blue, green and red, (H, W, 3).

    Raises ObservationError where it is none, or only part of one.
    """
    kind = cv2.IMREAD_ANYCOLOR if color else cv2.IMREAD_GRAYSCALE
    flags = kind | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    if data[:2] == b'\xff\xd8' and data.rfind(b'\xff\xd9') < data.rfind(b'\xff\xda'):
        raise ObservationError(f'{name}: the JPEG is incomplete; copy it again')
    if data[:2] == b'\xff\xd8' and data.count(b'\xff\xda') > _MOST_SCANS:
        raise ObservationError(f'{name}: a JPEG of more than {_MOST_SCANS} scans')
    if data[:8] == _PNG and not _whole_chunks(data):
        raise ObservationError(f'{name}: the PNG is incomplete; copy it again')
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    except cv2.error as cause:
        most = int(os.environ.get('OPENCV_IO_MAX_IMAGE_PIXELS', 1 << 30)) / 1e6
        raise ObservationError(
            f'{name}: larger than {most:.0f} megapixels, or broken; make it smaller'
        ) from cause
    if pixels is None:
        raise ObservationError(f'{name}: the image cannot be read; check the file')
    if pixels.dtype not in (np.uint8, np.uint16):
        raise ObservationError(f'{name}: pixels are {pixels.dtype}; 8 or 16 bit are needed')
    return np.asarray(pixels)


@contextmanager
def caught_stderr() -> Iterator[list[str]]:
    """Catch what libraries write to the standard error of this process, line by line at the end.

    Not for a process with other threads.
    """
    lines: list[str] = []
    before = os.dup(2)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 2)
        try:
            yield lines
        finally:
            os.dup2(before, 2)
            os.close(before)
            file.seek(0)
            lines += file.read().decode(errors='replace').splitlines()


def _whole_chunks(data: bytes) -> bool:
    """Whether the chunks of a PNG are within it; OpenCV makes room for what they announce."""
    place, kind = len(_PNG), b''
    while place + 12 <= len(data) and kind != b'IEND':
        kind = data[place + 4 : place + 8]
        place += 12 + int.from_bytes(data[place : place + 4], 'big')
    return kind == b'IEND' and place <= len(data)


def exif_turned(data: bytes) -> bool:
    """Say whether a JPEG asks viewers to turn it."""
    match = _ORIENTATION.search(data[:65536]) if data[:2] == b'\xff\xd8' else None
    return match is not None and int.from_bytes(match[2], 'little' if match[1] else 'big') > 1


def message_pixels(message: Any, typename: str, name: str) -> Pixels:
    """Return a sensor_msgs Image or CompressedImage in grey.

    Raises ObservationError for an encoding without brightness, or data that are too short.
    """
    if typename.endswith('CompressedImage'):
        return decode_image(bytes(message.data), name)
    return image_pixels(message, name)


def _source(path: Path) -> Iterator[Photograph]:
    if not path.exists():
        raise ObservationError(f'{path}: no such file or folder; check the path')
    if is_recording(path):
        return _recording(path)
    if path.is_dir():
        return _folder(path)
    return _video(path) if path.suffix.lower() in VIDEOS else iter([_file(path)])


def _file(path: Path, camera: str = '') -> Photograph:
    return Photograph(str(path), path.stem, camera, np.nan, path)


def _images(path: Path) -> list[Path]:
    return sorted((p for p in path.iterdir() if p.suffix.lower() in IMAGES), key=_natural)


def _folders(path: Path) -> list[Path]:
    return [p for p in sorted(path.iterdir()) if p.is_dir() and _images(p)]


def _folder(path: Path) -> Iterator[Photograph]:
    files = _images(path)
    folders = [] if files else photograph_folders(path)
    for folder in folders:
        camera = folder.name if len(folders) > 1 or folder.name in STEREO else ''
        yield from (_file(p, camera) for p in _images(folder))
    named = [_PREFIX.fullmatch(p.stem) for p in files]
    if len({match and match[1] for match in named}) > 1 and all(named):
        yield from (
            Photograph(str(p), match[2], match[1].lower(), np.nan, p)
            for p, match in zip(files, named, strict=True)
            if match
        )
    else:
        yield from map(_file, files)


def _natural(path: Path) -> list[tuple[int, str]]:
    return [(int(w), '') if w.isdigit() else (-1, w) for w in re.split(r'(\d+)', path.name)]


def _video(path: Path) -> Iterator[Photograph]:
    if not path.is_file():
        raise ObservationError(f'{path}: it must be a regular file')
    video = cv2.VideoCapture(str(path))
    rate = video.get(cv2.CAP_PROP_FPS) or 30.0
    number = 0
    while True:
        ok, image = video.read()
        if not ok:
            break
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        yield Photograph(f'{path} #{number}', f'{number:09d}', '', number / rate, grey)
        number += 1
    video.release()


def _recording(path: Path) -> Iterator[Photograph]:
    kinds = ('sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage')
    bag = Bag(path)
    topics = {topic for topic, kind in bag.topics() if kind in kinds}
    for record in bag.records(lambda _, kind: kind in kinds):
        if record.topic.removesuffix(_COMPRESSED_SUFFIX) in topics - {record.topic}:
            continue  # the same images once more
        stamp = record.message.header.stamp
        t = stamp.sec + 1e-9 * stamp.nanosec
        name = f'{path} {record.topic} {t:.9f}'
        camera = _camera(record.topic, topics)
        data = message_pixels(record.message, record.typename, name)
        yield Photograph(name, f'{stamp.sec:012d}.{stamp.nanosec:09d}', camera, t, data)


def _camera(topic: str, topics: set[str]) -> str:
    """Return the part of a topic that tells its camera from the recording's others."""
    words = topic.removesuffix(_COMPRESSED_SUFFIX).split('/')
    others = [other.removesuffix(_COMPRESSED_SUFFIX).split('/') for other in topics]
    own = [word for word in words if not all(word in other for other in others)]
    return '_'.join(own) or next((word for word in words if word in STEREO), '')
