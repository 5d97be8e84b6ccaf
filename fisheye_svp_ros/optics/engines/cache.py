"""Compiled code: where it is kept from one start to the next, and compiling while work goes on.

That is done in a process of its own, which takes no time from this one.  Several that start at
once wait for the first, and find what it has compiled.
"""

from __future__ import annotations

import atexit
import fcntl
import hashlib
import os
import platform
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path
from threading import Thread

_SOURCES = (
    'optics/formulas.py',
    'optics/rays.py',
    'optics/engines/kernels.py',
    'optics/engines/adjustment.py',
    'optics/engines/entries.py',
    'optics/engines/marquardt.py',
)
_NICENESS = 19  # niceness: whoever has work to do goes first
_CODE = 'from fisheye_svp_ros.optics.engines import cache; cache.compile_all()'


@cache
def folder() -> Path:
    """Return the folder for these sources, this Numba, this Python and this kind of machine."""
    package = Path(__file__).parents[2]
    told = [version('numba'), platform.python_version(), platform.machine(), platform.node()]
    digest = hashlib.sha256('\n'.join(told).encode())
    for name in _SOURCES:
        digest.update((package / name).read_bytes())
    root = os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache'
    return Path(root) / 'fisheye_svp_ros' / digest.hexdigest()[:16]


def is_compiled() -> bool:
    """Say whether all of it has been compiled before, by this installation."""
    return _mark().exists()


@cache
def mark_filled() -> None:
    """Remember that all of it has been compiled, where that can be kept."""
    with suppress(OSError):
        _mark().touch()


def _mark() -> Path:
    # Numba finds what it compiled by the place and the time of the source.
    source = Path(__file__).with_name('entries.py')
    told = f'{source} {source.stat().st_mtime_ns}'
    return folder() / f'complete-{hashlib.sha256(told.encode()).hexdigest()[:16]}'


class Compilation:
    """Compiles in the background, then calls `take`.

    state: 'compiling', 'compiled', or why there is no compiled code.
    """

    def __init__(self, take: Callable[[], None], variable: str) -> None:
        self.state = 'compiling'
        self._take = take
        self._process = subprocess.Popen(
            [sys.executable, '-c', _CODE],
            env={**os.environ, variable: 'auto'},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,  # a signal from the terminal is for who waits, who ends this
        )
        atexit.register(self.stop)
        Thread(target=self._wait, daemon=True).start()

    def stop(self) -> None:
        """End it, wherever it is."""
        if self._process.poll() is None:
            self._process.kill()

    def _wait(self) -> None:
        _, told = self._process.communicate()
        if self._process.returncode:
            self.state = (told.strip().splitlines() or ['it was ended'])[-1]
            return
        try:
            self._take()
        except Exception as error:  # such as a Numba that is gone by now
            self.state = str(error)
        else:
            self.state = 'compiled'


def compile_all() -> None:
    """Compile, unless another process does or has: then wait for it."""
    from fisheye_svp_ros.optics import engines

    os.nice(_NICENESS)
    kept = folder()
    kept.mkdir(parents=True, exist_ok=True)
    with (kept / 'lock').open('w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        engines.use('numba')
