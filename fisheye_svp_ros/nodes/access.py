"""Which files others may have a node read: what comes over the network names no other."""

from __future__ import annotations

import re
from pathlib import Path

from fisheye_svp_ros.errors import ParameterError

MAX_FILE_BYTES = 1 << 26  # bytes of a file that somebody else names
_NAME = re.compile(r'[\w-]{0,100}')


def check_access(name: str, folder: str, what: str) -> str:
    """Return a name in config/, or a file, as given; raise ParameterError if it is out of bounds.

    folder: below which a file must lie, symbolic links followed; empty: no file at all.
    """
    if _NAME.fullmatch(name) and not Path(name).is_file():
        return name
    if not folder:
        raise ParameterError(f'{what}: {name[:100]!r} is a file, but a running node takes only '
                             'names in config/; start it with folder:=DIR')
    try:
        path = Path(name).resolve()
        inside = path.is_relative_to(Path(folder).resolve())
        size = path.stat().st_size if inside and (path.is_file() or path.is_dir()) else -1
    except (OSError, ValueError) as cause:
        raise ParameterError(f'{what}: {name[:100]!r} is not a path ({cause})') from cause
    if not inside:
        raise ParameterError(f'{what}: {name[:100]!r} is not below {folder}, the folder of this '
                             'node')
    if not 0 <= size <= MAX_FILE_BYTES:
        raise ParameterError(
            f'{what}: {name[:100]!r} is no file, or above {MAX_FILE_BYTES >> 20} MB')
    return name
