"""What nodes that tests kill leave in shared memory; users have `fastdds shm clean`."""

from __future__ import annotations

import fcntl
import re
import time
from collections.abc import Set
from contextlib import suppress
from pathlib import Path

_SHARED_MEMORY = Path('/dev/shm')
# A segment of a participant or the port of a transport; locks and a semaphore lie beside them.
_SEGMENT = re.compile(r'fastrtps_([0-9a-f]{16}|port\d+)')
_SETTLING_TIME = 0.2  # s, more than a process takes from making a segment to locking it


def segments() -> set[str]:
    """Return the names of all segments and ports of shared memory that are there."""
    with suppress(OSError):  # of Linux
        return {path.name for path in _SHARED_MEMORY.iterdir() if _SEGMENT.fullmatch(path.name)}
    return set()


def remove_orphans(before: Set[str]) -> None:
    """Remove shared memory that was not there before and that no process holds."""
    found = segments() - before
    if found:
        time.sleep(_SETTLING_TIME)
    held = _locked_inodes()
    for name in found:
        locks = [_SHARED_MEMORY / f'{name}{lock}' for lock in ('_el', '_sl')]
        # To try a lock is to take it for a moment, in which its process might want it.
        if any(_inode(lock) in held for lock in locks) or any(map(_is_locked, locks)):
            continue
        for path in (_SHARED_MEMORY / name, *locks, _SHARED_MEMORY / f'sem.{name}_mutex'):
            with suppress(OSError):  # gone, or somebody else's
                path.unlink()


def _locked_inodes() -> set[int]:
    """Return the inodes of all files that processes of this namespace hold locked."""
    with suppress(OSError):  # of Linux
        return {
            int(inode)
            for inode in re.findall(
                r'FLOCK .* [0-9a-f]+:[0-9a-f]+:(\d+) ', Path('/proc/locks').read_text()
            )
        }
    return set()


def _inode(path: Path) -> int:
    with suppress(OSError):
        return path.stat().st_ino
    return 0


def _is_locked(path: Path) -> bool:
    """Say whether a living process holds the lock of a file; it may be of another namespace."""
    try:
        with path.open('rb') as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # there is none
        return False
    return False
