"""Which camera of a rig a file is of, by its name: left01.png, cam1_0001.png, video_right.mp4."""

from __future__ import annotations

import re
from collections.abc import Sequence

_MAX_CAMERAS = 16  # of more names each counts a photograph
_SIDES = {'l': 'left', 'r': 'right'}
# A word of its own, in CamelCase too; a letter alone stands between separators.
_CAMERA = re.compile(
    r'(?:(?<![A-Za-z])|(?<=[a-z])(?=[A-Z]))'
    r'((?:[Ll]eft|LEFT|[Rr]ight|RIGHT)(?![a-z])|(?:cam(?:era)?|CAM(?:ERA)?|Cam(?:era)?)[_-]?\d+)'
    r'|(?<![A-Za-z0-9])([LRlr])(?=[_\-\d]|$)'
)
_NAME_PARTS = re.compile(r'\d+|[A-Za-z]+')
_MIN_SHARED = 3  # names of two kinds that go on alike, before they look like two cameras'


def split_names(names: Sequence[str], rest_needed: bool = True) -> list[tuple[str, str]] | None:
    """Return camera and rest of each name; None unless all name one of two cameras or more.

    rest_needed: what is left of a name must tell the photographs of a camera apart.
    """
    found = [_split(name) for name in names]
    parts = [one for one in found if one is not None]
    cameras = {camera for camera, _ in parts}
    if len(parts) < len(names) or not 2 <= len(cameras) <= _MAX_CAMERAS:
        return None
    return None if rest_needed and not all(rest for _, rest in parts) else parts


def names_a_camera(name: str) -> bool:
    """Say whether a name names a camera."""
    return _split(name) is not None


def alike_series(names: Sequence[str]) -> tuple[str, ...]:
    """Return words by which names fall into series with the same numbers: infra1_ and infra2_.

    Files of two cameras may be called so, and others, too; empty for one series.
    """
    series: dict[str, set[str]] = {}
    for name in names:
        words = [*_NAME_PARTS.finditer(name)]
        if not words or not words[-1][0].isdigit():
            return ()
        series.setdefault(name[: words[-1].start()], set()).add(words[-1][0])
    if len(series) < 2 or len(series) > _MAX_CAMERAS:
        return ()
    first, *others = series.values()
    alike = all(len(first & one) >= max(_MIN_SHARED, 0.9 * len(first | one)) for one in others)
    return tuple(series) if alike else ()


def _split(name: str) -> tuple[str, str] | None:
    match = _CAMERA.search(name)
    if match is None:
        return None
    word = (match[1] or match[2]).lower()
    before, after = name[: match.start()].rstrip('_-. '), name[match.end() :].lstrip('_-. ')
    camera = re.sub('[_-]', '', _SIDES.get(word, word))
    return camera, '_'.join(filter(None, (before, after)))
