"""Memory that a process keeps for itself between large arrays."""

from __future__ import annotations

import ctypes
import sys

# Of malloc.h: no array has pages of its own, none of those on top goes back, one arena for all
# threads, steps of 64 MB.
_MMAP_MAX, _TRIM_THRESHOLD, _ARENA_MAX, _TOP_PAD = (-4, 0), (-1, 2**31 - 1), (-8, 1), (-2, 1 << 26)


def keep_memory() -> None:
    """Have malloc keep what is freed, for a process that makes large arrays and ends.

    Fresh pages cost about as much as sums over them.  Of glibc alone; does nothing elsewhere.
    """
    if sys.platform != 'linux':
        return
    mallopt = getattr(ctypes.CDLL(None), 'mallopt', None)
    if mallopt is not None:
        for option in (_MMAP_MAX, _TRIM_THRESHOLD, _ARENA_MAX, _TOP_PAD):
            mallopt(*option)
