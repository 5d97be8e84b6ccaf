"""The rig file of this package: each camera in the next one, and no lenses."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.files import parse_yaml
from fisheye_svp_ros.io.lens_formats import Foreign, fields

SEPARATOR = '_in_'
_POSE_KEY = re.compile(r'^\w+_in_\w+ *:', re.MULTILINE)


def recognises(text: str) -> bool:
    """Say whether a text is such a file."""
    if SEPARATOR not in text:
        return False
    try:
        document = parse_yaml(text, '', LensError)
    except LensError:  # `read` names the line that is broken
        return _POSE_KEY.search(text) is not None
    return bool(_steps(document))


def read(text: str, where: str) -> Foreign:
    """Read position, m, and quaternion x, y, z, w; raises LensError, naming the field."""
    names, rigs = _steps(parse_yaml(text, where, LensError)), []
    for name, entry in names.items():
        place = f'{where}: {name}'
        rigs.append(
            fields.pose(
                fields.numbers(entry, 'position', 3, place),
                fields.numbers(entry, 'quaternion', 4, place),
                place,
            )
        )
    cameras = cameras_of(list(names))
    if not cameras:
        raise LensError(
            f'{where}: {", ".join(names)} are no chain; each must begin with the '
            'camera in which the one before ends'
        )
    return Foreign('rig', {}, tuple(rigs), {}, cameras)


def pose_keys(cameras: Sequence[str]) -> list[str]:
    """Return the key of each camera in the next one."""
    return [f'{camera}{SEPARATOR}{other}' for camera, other in pairwise(cameras)]


def cameras_of(keys: Sequence[str]) -> tuple[str, ...]:
    """Return the cameras of a chain of such keys, none where the keys are no chain.

    A camera may have `_in_` in its name: the first division with which all keys agree counts.
    """
    first, *names = keys
    for place in (match.start() for match in re.finditer(f'(?={SEPARATOR})', first)):
        cameras = [first[:place], first[place + len(SEPARATOR) :]]
        for key in names:
            if not key.startswith(cameras[-1] + SEPARATOR):
                break
            cameras.append(key.removeprefix(cameras[-1] + SEPARATOR))
        else:
            return tuple(cameras)
    return ()


def _steps(document: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the entries that hold a pose."""
    return {
        str(name): entry
        for name, entry in document.items()
        if SEPARATOR in str(name) and isinstance(entry, dict) and 'position' in entry
    }
