"""What frames are called: by the photographs that they were read from, else by number."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import PurePath

import numpy as np

from fisheye_svp_ros.scene.observations import Observations


def photograph_names(table: Observations) -> dict[tuple[int, str], str]:
    """Return the file name of each photograph by frame and camera, unique among them.

    All keep their folder where photographs in several folders have one file name.
    """
    paths = {(frame, camera): PurePath(path) for frame, camera, path in table.photographs}
    parts = 1 if len({path.name for path in paths.values()}) == len(paths) else 2
    return {key: '/'.join(path.parts[-parts:]) for key, path in paths.items()}


def frame_names(table: Observations, frame: int, camera: str | None = None) -> list[str]:
    """Return what a frame is called: its photographs, of one camera or of all that took it.

    Without photographs: `frame 3`, or `frame 3 of left`.
    """
    names = photograph_names(table)
    here = (table.cameras[i] for i in np.unique(table.camera))
    cameras = here if camera is None else (camera,)
    found = [names[frame, one] for one in cameras if (frame, one) in names]
    return found or [f'frame {frame}' + (f' of {camera}' if camera else '')]


def frame_name(table: Observations, frame: int, camera: str | None = None) -> str:
    """Return what a frame is called in one word or two."""
    return ' and '.join(frame_names(table, frame, camera))


def list_frames(table: Observations, frames: Sequence[int], most: int = 10) -> str:
    """Return frames as one enumerates them, at most so many and the count of the others.

    Photographs by name; `frames 1, 2 and 3` where no photograph is known.
    """
    each = [dict.fromkeys(frame_names(table, frame)) for frame in dict.fromkeys(frames)]
    names = list(dict.fromkeys(name for group in each for name in group))
    head = ''
    if names and all(name.startswith('frame ') for name in names):
        head = 'frames ' if len(names) > 1 else 'frame '
        names = [name.removeprefix('frame ') for name in names]
    if len(names) > most:
        return f'{head}{", ".join(names[:most])} and {len(names) - most} more'
    return head + ' and '.join(filter(None, (', '.join(names[:-1]), *names[-1:])))


def photograph_entry(table: Observations, frame: int, camera: str | None = None) -> dict[str, str]:
    """Return what JSON holds beside a frame's number: its photograph, where it is known."""
    name = frame_name(table, frame, camera)
    return {} if name.startswith('frame ') else {'photograph': name}
