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
from fisheye_svp_ros.detect.rig_photographs import alike_series, names_a_camera, split_names
from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.io.files import read_bytes
from fisheye_svp_ros.io.paths import visible_paths
from fisheye_svp_ros.io.recording_files import ROS1_SUFFIX, is_recording
from fisheye_svp_ros.io.streams import silent_libraries
from fisheye_svp_ros.scene.observations import STEREO

Pixels = NDArray[Any]  # (H, W), uint8 or uint16, grey

os.environ.setdefault('OPENCV_FFMPEG_LOGLEVEL', '-8')  # a broken video is named by its path

IMAGES = ('.png', '.jpg', '.jpeg', '.bmp', '.tif', '.tiff', '.pgm', '.ppm', '.webp', '.jp2')
VIDEOS = ('.mp4', '.avi', '.mov', '.mkv', '.webm', '.m4v')
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

    data: a path or bytes of an image file, pixels, or why there are none; part: which of how many
    cameras that lie side by side in it.
    """

    name: str
    key: str
    camera: str
    t: float
    data: Path | bytes | Pixels | ObservationError
    part: tuple[int, int] = (0, 1)

    def pixels(self, color: bool = False) -> Pixels:
        """Return the image in grey; raise ObservationError, one line, where there is none.

        color: of a colored image file blue, green and red, (H, W, 3).
        """
        data = self.data
        if isinstance(data, Path):
            data = read_bytes(data, ObservationError)
        if isinstance(data, ObservationError):
            raise data
        whole = data if isinstance(data, np.ndarray) else decode_image(data, self.name, color)
        part, count = self.part
        width = whole.shape[1] // count
        return np.ascontiguousarray(whole[:, part * width : (part + 1) * width])

    def split(self, count: int) -> Iterator[Photograph]:
        """Yield the photographs of so many cameras that lie side by side in this one."""
        if count == 1:
            yield self
            return
        for part in range(count):
            own = STEREO[part] if count == len(STEREO) else f'cam{part}'
            yield replace(
                self,
                name=f'{self.name}#{own}',
                camera='_'.join(filter(None, (self.camera, own))),
                part=(part, count),
            )


def find_photographs(paths: Sequence[str], every: int = 1, split: int = 1) -> Iterator[Photograph]:
    """Yield the photographs of files, folders, videos and recordings, in their order.

    Subfolders such as left/ and right/, names of files, folders and videos with such a word, or
    topics in such namespaces are the cameras of a rig; equal names, and equal stamps, are the same
    instant.  A name that a camera had in an earlier path is another instant: the number of its
    path stands before it.  every: take one of so many; split: cameras side by side in each.
    Raises ObservationError where no path has any.
    """
    earlier, empty = set[tuple[str, str]](), list[Path]()
    given = [*map(Path, paths)]
    named = _path_cameras(given)
    for place, path in enumerate(given):
        number, own = -1, set()
        for number, photograph in enumerate(_source(path, *named.get(path, ('', '')))):
            if number % every == 0:
                name = photograph.camera, photograph.key
                own.add(name)
                if name in earlier:
                    photograph = replace(photograph, key=f'{place}/{photograph.key}')
                yield from photograph.split(split)
        earlier |= own
        empty += [path] * (number < 0)
    if empty and len(empty) == len(given):
        raise ObservationError(_no_photograph(empty[0]))


def count_photographs(paths: Sequence[str], every: int = 1, split: int = 1) -> int | None:
    """Return how many photographs `find_photographs` yields; None for videos and recordings."""
    count = 0
    for path in map(Path, paths):
        folders = photograph_folders(path) if path.is_dir() else []
        files = [file for folder in folders for file in _media(folder)] or [path]
        if is_recording(path) or any(file.suffix.lower() in VIDEOS for file in files):
            return None
        count += split * -(-sum(1 for _ in _source(path)) // every)
    return count


def doubtful_folders(paths: Sequence[str]) -> Iterator[str]:
    """Yield what `find_photographs` makes of files and folders and may not be meant: a line each.

    Beside images of the folder itself those of its subfolders may be anything, pictures of results
    say; and files called after cameras are those of one where others are called otherwise.
    """
    given = [*map(Path, paths)]
    folders = [path for path in given if path.is_dir() and not is_recording(path)]
    if not split_names([_name(path) for path in given], False):
        yield from _equal_names(folders)
    loose = [path for path in given if not path.is_dir()]
    yield from _doubtful_names('the files', loose)
    for folder in folders:
        if len(given) > 1 and not any(map(_media, photograph_folders(folder))):
            yield _no_photograph(folder)
        yield from _unsearched_media(folder, given)
        yield from _doubtful_names(str(folder), _media(folder))


def _no_photograph(path: Path) -> str:
    bags = [p.name for p in visible_paths(path.glob(f'*{ROS1_SUFFIX}'))] if path.is_dir() else []
    if bags:
        return f'{path}: bags of ROS 1 are given as files, such as {path / bags[0]}'
    return f'{path}: it and its folders hold no photograph; images are {" ".join(IMAGES)}'


def _equal_names(folders: Sequence[Path]) -> Iterator[str]:
    names = {folder: {p.stem for p in _media(folder)} for folder in folders}
    for before, after in itertools.pairwise(names):
        if names[before] & names[after]:
            yield (
                f'{before}, {after}: photographs of equal names are different frames of one '
                'camera; for the cameras of a rig give the folder above'
            )


def _unsearched_media(folder: Path, given: Sequence[Path]) -> Iterator[str]:
    """Yield which subfolders, and videos beside images, are not searched."""
    for above in photograph_folders(folder):
        for sub in (p for p in visible_paths(above.iterdir()) if p.is_dir() and p not in given):
            if count := sum(len(_media(one)) for one in (sub, *_folders(sub))):
                yield (
                    f'{sub}: its {count} images are skipped, since the folder above holds '
                    'images too; give it alone, or move the others into a subfolder'
                )
        if (videos := _files(above, VIDEOS)) and _images(above):
            yield (
                f'{above}: its {len(videos)} videos are skipped, since it holds images too; give '
                'the videos themselves'
            )


def _doubtful_names(where: str, files: Sequence[Path]) -> Iterator[str]:
    """Yield why files count as those of one camera, where some or all may be those of several."""
    videos = [p for p in files if p.suffix.lower() in VIDEOS]
    if len(videos) > 1 and not split_names([p.stem for p in videos], False):
        yield (
            f'{", ".join(p.name for p in videos[:3])}: these videos count as those of one camera; '
            'call those of a rig left and right, or cam0, cam1, ...'
        )
    images = [p for p in files if p.suffix.lower() in IMAGES]
    stems = [p.stem for p in images]
    named = [stem for stem in stems if names_a_camera(stem)]
    others = [p.name for p in images if p.stem not in named]
    if others and split_names(named):
        first = next(p.name for p in images if p.stem in named)
        yield (
            f'{where}: all images count as those of one camera, since {others[0]} names none, '
            f'unlike {first}; rename or remove it'
        )
    elif not named and (series := alike_series(stems)):
        yield (
            f'{where}: images named {" and ".join(series[:3])} with equal numbers count as those '
            'of one camera; put those of a rig into a folder for each camera'
        )


def is_photographs(path: Path) -> bool:
    """Say whether a path is taken for photographs rather than for observations."""
    if path.is_dir():
        return bool(photograph_folders(path))
    return path.suffix.lower() in (*IMAGES, *VIDEOS)


def photograph_folders(path: Path) -> list[Path]:
    """Return the folders whose images are the photographs of a folder: itself, or those in it."""
    return [path] if _media(path) else _folders(path)


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


def _name(path: Path) -> str:
    return path.resolve().name if path.is_dir() else path.stem


def _path_cameras(given: Sequence[Path]) -> dict[Path, tuple[str, str]]:
    """Return camera, and what else its name says, of each path that is called after one.

    Images without a camera in their own names have that of their folders.
    """
    found: dict[Path, tuple[str, str]] = {}
    images = [p for p in given if p.suffix.lower() in IMAGES and not p.is_dir()]
    others = [p for p in given if p not in images]
    parents = [*dict.fromkeys(p.parent for p in images)]
    if parts := split_names([p.stem for p in images]):
        found |= zip(images, parts, strict=True)
    elif parts := split_names([_name(p) for p in parents], False):
        camera = dict(zip(parents, parts, strict=True))
        for path in images:
            own, rest = camera[path.parent]
            found[path] = own, '/'.join(filter(None, (rest, path.stem)))
    if parts := split_names([_name(p) for p in others], False):
        found |= zip(others, parts, strict=True)
    return found


def _source(path: Path, camera: str = '', rest: str = '') -> Iterator[Photograph]:
    """Yield the photographs of a path; camera, rest: what its name says, '' nothing."""
    if not path.exists():
        raise ObservationError(f'{path}: no such file or folder; check the path')
    if is_recording(path):
        found = _recording(path)
    elif path.is_dir():
        found = _folder(path)
    else:
        return _open(path, camera, rest)
    return (
        replace(
            one,
            camera=one.camera or camera,
            key='/'.join(filter(None, (rest, one.key))),
        )
        for one in found
    )


def _open(path: Path, camera: str = '', key: str = '') -> Iterator[Photograph]:
    """Yield the photographs of a file: itself, or those of a video."""
    if path.suffix.lower() in VIDEOS:
        return _video(path, camera, key)
    return iter([Photograph(str(path), key or path.stem, camera, np.nan, path)])


def _files(path: Path, kinds: Sequence[str]) -> list[Path]:
    return sorted(
        (p for p in visible_paths(path.iterdir()) if p.suffix.lower() in kinds), key=_natural
    )


def _images(path: Path) -> list[Path]:
    return _files(path, IMAGES)


def _media(path: Path) -> list[Path]:
    """Return the images of a folder, or else its videos."""
    return _images(path) or _files(path, VIDEOS)


def _folders(path: Path) -> list[Path]:
    return [p for p in visible_paths(path.iterdir()) if p.is_dir() and _media(p)]


def _folder(path: Path) -> Iterator[Photograph]:
    files = _media(path)
    folders = [] if files else photograph_folders(path)
    for folder in folders:
        camera = folder.name if len(folders) > 1 or folder.name in STEREO else ''
        own = _media(folder)
        for file in own:
            # Of a single video numbers tell which frames are simultaneous, whatever it is called.
            video = file.suffix.lower() in VIDEOS
            yield from _open(file, camera, '' if video and len(own) == 1 else file.stem)
    videos = bool(files) and files[0].suffix.lower() in VIDEOS
    named = split_names([p.stem for p in files], not videos) or [
        ('', p.stem if len(files) > 1 else '') for p in files
    ]
    for file, (camera, rest) in zip(files, named, strict=True):
        yield from _open(file, camera, rest)


def _natural(path: Path) -> list[tuple[int, str]]:
    return [(int(w), '') if w.isdigit() else (-1, w) for w in re.split(r'(\d+)', path.name)]


def _video(path: Path, camera: str = '', key: str = '') -> Iterator[Photograph]:
    """Yield the frames of a video; key: its name among others of its camera.

    Of one among others the time is not known, since nothing says when it began.
    """
    if not path.is_file():
        raise ObservationError(f'{path}: it must be a regular file')
    with silent_libraries():  # of the kinds of files that it may be, each tells why it is none
        video = cv2.VideoCapture(str(path))
    rate = video.get(cv2.CAP_PROP_FPS) or 30.0
    number = 0
    while True:
        ok, image = video.read()
        if not ok:
            break
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        t = np.nan if camera and key else number / rate
        name = '/'.join(filter(None, (key, f'{number:09d}')))
        yield Photograph(f'{path} #{number}', name, camera, t, grey)
        number += 1
    video.release()
    if not number:
        raise ObservationError(f'{path}: the video is empty or cannot be decoded')


def _recording(path: Path) -> Iterator[Photograph]:
    from fisheye_svp_ros.io.bags import Bag  # takes a while, and photographs do without

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
        data: Pixels | ObservationError
        try:
            data = message_pixels(record.message, record.typename, name)
        except ObservationError as error:
            data = error
        yield Photograph(name, f'{stamp.sec:012d}.{stamp.nanosec:09d}', camera, t, data)


def _camera(topic: str, topics: set[str]) -> str:
    """Return the part of a topic that tells its camera from the recording's others."""
    words = topic.removesuffix(_COMPRESSED_SUFFIX).split('/')
    others = [other.removesuffix(_COMPRESSED_SUFFIX).split('/') for other in topics]
    own = [word for word in words if not all(word in other for other in others)]
    return '_'.join(own) or next((word for word in words if word in STEREO), '')
