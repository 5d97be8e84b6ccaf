"""Where a command may write, checked before it computes, and its notes on standard error."""

from __future__ import annotations

import argparse
import os
import re
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from fisheye_svp_ros.errors import OutputError
from fisheye_svp_ros.scene.observations import Observations, frame_name, list_frames

if TYPE_CHECKING:
    from fisheye_svp_ros.solve.outliers import Outliers

_PHOTOGRAPHS = ('observations', 'photographs', 'inputs')  # arguments whose folders are read again
_OUTPUTS = {'-o': 'output', '--overlays': 'overlays'}  # options and their arguments
_MAX_SIMILAR_NOTES = 3  # frames whose reasons differ by numbers alone; of more, the first only
_DAY = 86_400.0  # s
_DIGITS = re.compile(r'\d')
_MAX_TARGET_SIZE = 20.0  # m; a target larger than this was measured in other units


def output_folder(text: str, option: str = '-o') -> Path:
    """Return the path of a folder that exists or can be made; raise OutputError otherwise."""
    path = output_path(text, option)
    if path.exists() and not path.is_dir():
        raise OutputError(f'{option} {text}: it is a file; name a folder')
    return path


def output_file(text: str) -> Path:
    """Return the path of a file that can be written; raise OutputError for a folder, too."""
    path = output_path(text)
    if path.is_dir():
        raise OutputError(f'-o {text}: it is a folder; name a file')
    return path


def output_path(text: str, option: str = '-o') -> Path:
    """Return a path whose parents are folders that can be written, or raise OutputError."""
    path = Path(text)
    parent = next(one for one in (path.absolute(), *path.absolute().parents) if one.exists())
    if parent != path.absolute() and not parent.is_dir():
        raise OutputError(f'{option} {text}: {parent} is not a folder; choose another')
    if not os.access(parent, os.W_OK):
        raise OutputError(f'{option} {text}: no permission to write in {parent}; choose another')
    return path


def check_output(args: argparse.Namespace) -> None:
    """Raise OutputError where an output is a file that is also an input, or among photographs."""
    for option, name in _OUTPUTS.items():
        output = getattr(args, name, None)
        if output is None or not output.exists():
            continue
        for given, path in _paths(args):
            if path.exists() and any(
                    one.samefile(output) for one in _files_to_keep(given, path, output, name)):
                raise OutputError(f'{option} {output}: this would overwrite the input {path}; '
                                  'choose another name')


def _files_to_keep(given: str, path: Path, output: Path, name: str) -> Iterator[Path]:
    """Yield the files and folders that an output must not be, for one of the inputs."""
    if output.is_file() or given in _PHOTOGRAPHS:
        yield path
    if given not in _PHOTOGRAPHS:
        return
    from fisheye_svp_ros.detect.photographs import IMAGES, photograph_folders

    if output.is_file():
        if path.is_dir() and output.suffix.lower() in IMAGES:
            yield from (folder / output.name for folder in photograph_folders(path))
    else:
        # `undistort` and overlays write PNG files under the names of the photographs.
        if path.is_dir():
            yield from photograph_folders(path)
        elif path.suffix == '.png' and (given == 'inputs' or name == 'overlays'):
            yield path.parent


def _paths(args: argparse.Namespace) -> Iterator[tuple[str, Path]]:
    """Yield the arguments that may be paths: name, path."""
    for name, value in vars(args).items():
        for one in value if isinstance(value, list) else [value]:
            if name not in _OUTPUTS.values() and isinstance(one, str | Path):
                yield name, Path(str(one).rpartition('=')[2])


def say(note: str) -> None:
    """Print a note."""
    print(f'fisheye-svp: note: {note}', file=sys.stderr)


def counted(count: int, noun: str) -> str:
    """Return a number of things, one of them in the singular."""
    return f'{count} {noun}' if count == 1 else f'{count} {noun}s'


def note_formats() -> None:
    """Say it where tables come in one form only, once a day."""
    from fisheye_svp_ros.io.columns import arrow

    _, problem = arrow()
    if not problem:
        return
    home = Path(os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache')
    mark = home / 'fisheye_svp_ros' / 'no_parquet.said'
    with suppress(OSError):  # said each time where no mark can be kept
        if mark.exists() and time.time() - mark.stat().st_mtime < _DAY:
            return
        mark.parent.mkdir(parents=True, exist_ok=True)
        mark.touch()
    say(problem)


def note_left_out(table: Observations, frames: Sequence[int]) -> None:
    """Name the frames of a table that could not be posed, if there are any."""
    if frames:
        say('left out, their points do not determine a pose (all near one line, or of another '
            f'lens?): {list_frames(table, frames)}')


def note_copies(table: Observations, frames: Sequence[int]) -> None:
    """Name the frames of a table that are other frames once more, if there are any."""
    if frames:
        say('left out, their image points repeat those of an earlier frame: '
            f'{list_frames(table, frames)}')


def note_huge(table: Observations) -> None:
    """Ask for the unit of a target that is larger than targets are."""
    across = float((table.xyz.max(axis=0) - table.xyz.min(axis=0)).max())
    if across > _MAX_TARGET_SIZE:
        say(f'the target is {across:.0f} m across; x, y, z must be in m, not in mm')


def note_gross_errors(table: Observations, gross: Outliers) -> None:
    """Say how many rows of a table are set aside, and which are furthest off."""
    if len(gross.rows):
        worst = ', '.join(
            f'{frame_name(table, int(table.frame[gross.rows[i]]))} landmark '
            f'{table.landmark[gross.rows[i]]} '
            f'({gross.px[i]:.1f} px)' for i in (-gross.px).argsort()[:3])
        frames = table.frame[gross.rows]
        whole = [frame for frame in dict.fromkeys(frames.tolist())
                 if (frames == frame).sum() == (table.frame == frame).sum()]
        views = (f'; all points of {list_frames(table, whole)} are outliers: check their order'
                 if whole else '')
        say(f'{len(gross.rows)} of {len(table)} points are outliers and are rejected, '
            f'furthest {worst}{views}')


def note_doubtful(
    table: Observations, frames: Sequence[int], reasons: Sequence[str]
) -> None:
    """Name the frames of a table whose poses should not be relied on as they are, and why."""
    alike: dict[str, list[tuple[int, str]]] = {}
    for frame, reason in zip(frames, reasons, strict=True):
        if reason:
            alike.setdefault(_DIGITS.sub('', reason), []).append((frame, reason))
    for doubtful in alike.values():
        shown = len(doubtful) if len(doubtful) <= _MAX_SIMILAR_NOTES else 1
        for frame, reason in doubtful[:shown]:
            say(f'{frame_name(table, frame)}: {reason}')
        if rest := [frame for frame, _ in doubtful[shown:]]:
            say(f'{list_frames(table, rest)}: likewise')


def note_unconnected(table: Observations) -> None:
    """Say which cameras share no frame with others, so that nothing relates them."""
    from fisheye_svp_ros.solve.rig_calibration import connected_cameras

    first, *others = connected_cameras(table)
    for group in others:
        say(f'{" and ".join(group)}: no frame shared with {" and ".join(first)}, so their '
            'relative pose is not estimated, and no rig.yaml is written')
        first += group
