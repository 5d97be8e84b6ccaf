"""Compiling while work goes on: in a process of its own, which takes no time from this one.

Several that start at once wait for the first, and find what it has compiled.
"""

from __future__ import annotations

import atexit
import fcntl
import os
import subprocess
import sys
from collections.abc import Callable
from threading import Thread

from fisheye_svp_ros.optics.engines import cache

_IDLE = 19  # niceness: whoever has work to do goes first
_CODE = 'from fisheye_svp_ros.optics.engines import compilation; compilation.compile_all()'


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

    os.nice(_IDLE)
    folder = cache.folder()
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / 'lock').open('w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        engines.use('numba')
