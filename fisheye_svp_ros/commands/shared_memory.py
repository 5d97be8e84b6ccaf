"""Shared memory of Fast DDS, which a process that is killed leaves behind."""

from __future__ import annotations

import fcntl
import re
from collections.abc import Set
from contextlib import suppress
from pathlib import Path

_FOLDER = Path('/dev/shm')
# A segment of a participant or the port of a transport; locks and a semaphore lie beside them.
_NAME = re.compile(r'fastrtps_([0-9a-f]{16}|port\d+)')
_LOCKS = ('_el', '_sl')


def segments() -> set[str]:
    """Return the names of all segments and ports that are there."""
    try:
        return {path.name for path in _FOLDER.iterdir() if _NAME.fullmatch(path.name)}
    except OSError:  # of Linux
        return set()


def remove_orphans(before: Set[str]) -> None:
    """Remove those that were not there before and that no process holds."""
    for name in segments() - before:
        locks = [_FOLDER / f'{name}{lock}' for lock in _LOCKS]
        if any(map(_is_locked, locks)):
            continue
        for path in (_FOLDER / name, *locks, _FOLDER / f'sem.{name}_mutex'):
            with suppress(OSError):  # gone, or somebody else's
                path.unlink()


def _is_locked(path: Path) -> bool:
    """Say whether a living process holds the lock of a file."""
    try:
        with path.open('rb') as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # there is none
        return False
    return False
