"""What a process asks of its system: threads of linear algebra, memory, pictures in files.

One thread, unless the environment says otherwise.  The matrices here are small.  Threads of BLAS
that wait for each other at every product cost several times what they bring, and some BLAS returns
other last digits on more of them.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable
from functools import wraps
from importlib.util import find_spec
from typing import ParamSpec, TypeVar

VARIABLES = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS')

_P = ParamSpec('_P')
_R = TypeVar('_R')
# Of malloc.h: no array has pages of its own, none of those on top goes back, one arena for all
# threads, steps of 64 MB.
_MMAP_MAX, _TRIM_THRESHOLD, _ARENA_MAX, _TOP_PAD = (-4, 0), (-1, 2**31 - 1), (-8, 1), (-2, 1 << 26)


def set_thread_count() -> None:
    """Ask for one thread in this process and its workers; call it before NumPy is imported."""
    os.environ.setdefault(VARIABLES[0], '1')


def draw_to_files() -> None:
    """Have Matplotlib draw into files alone, in this process and its workers.

    A backend that the environment names, as that of a notebook, need not be installed here; call
    it before Matplotlib is imported.
    """
    os.environ['MPLBACKEND'] = 'agg'


def limit_threads(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return the function with BLAS on one thread while it runs, in a process of somebody else's.

    A number that the environment sets stays as it is, and so does BLAS after the call.  Without
    threadpoolctl, which Ubuntu's ROS 2 does not bring, nothing is limited.
    """

    @wraps(function)
    def wrapper(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        if any(os.environ.get(name) for name in VARIABLES) or not find_spec('threadpoolctl'):
            return function(*args, **kwargs)
        import scipy.linalg  # noqa: F401 (BLAS of its own: loaded later it would have all threads)
        from threadpoolctl import threadpool_limits

        with threadpool_limits(1, user_api='blas'):
            return function(*args, **kwargs)

    return wrapper


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
