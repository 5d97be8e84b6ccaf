"""Paths, before anything is read or written there."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from fisheye_svp_ros.errors import OutputError, ParameterError


def path_of(given: str | Path) -> Path:
    """Return a path; raise ParameterError for what is none."""
    if not isinstance(given, str | os.PathLike):
        raise ParameterError(f'a {type(given).__name__} is no path; the name of a file is needed')
    return Path(given)


def visible_paths(paths: Iterable[Path]) -> list[Path]:
    """Return the paths, in order, whose names do not begin with a dot, as temporary ones do."""
    return sorted(path for path in paths if not path.name.startswith('.'))


def final_path(path: str | Path) -> Path:
    """Return where a path leads, through all symbolic links; raise OutputError for a circle."""
    resolved = Path(os.path.realpath(path_of(path)))
    if resolved.is_symlink():
        raise OutputError(f'{path}: its symbolic links lead in a circle; choose another name')
    return resolved
