"""Work on many items in processes of their own, each item bounded in time."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple

_START = 60.0  # s a process may take to start
_PARENT_INTERVAL = 1.0  # s
# bytes; arrays come and go, and memory that glibc gave back would be cleared again, page by page
_MALLOC_LIMITS = {'MALLOC_MMAP_THRESHOLD_': str(2**25), 'MALLOC_TRIM_THRESHOLD_': str(2**27)}
# No process of multiprocessing, which would run a caller's script anew from its first line.
_PROGRAM = (
    'import sys; sys.path[:] = sys.argv[3:]; '
    'from fisheye_svp_ros.detect.workers import serve; serve(*map(int, sys.argv[1:3]))'
)


class TimedOut(NamedTuple):
    """What comes in place of a result: the item took too long, or its process died."""

    timed_out: bool


class _Worker:
    def __init__(self, function: Callable[[Any], Any]) -> None:
        ours, theirs = socket.socketpair()
        self.pipe = Connection(ours.detach())
        # Ctrl-C is for whoever waits for the work.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            with theirs:
                numbers = theirs.fileno(), os.getpid()
                self.process = subprocess.Popen(
                    [sys.executable, '-c', _PROGRAM, *map(str, numbers), *sys.path],
                    env=_MALLOC_LIMITS | os.environ,
                    pass_fds=[theirs.fileno()],
                    stdin=subprocess.DEVNULL,
                )
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        self.pipe.send(function)
        self.number, self.deadline = -1, 0.0

    def assign_item(self, number: int, item: Any, seconds: float) -> None:
        self.number, self.deadline = number, time.monotonic() + seconds
        with suppress(ConnectionError):  # of a process that has died; whoever listens hears so
            self.pipe.send(item)

    def receive_result(self) -> Any:
        """Return what came of the item, TimedOut where the process has died over it."""
        try:
            return self.pipe.recv()
        except (EOFError, OSError):
            return TimedOut(False)

    def stop(self) -> None:
        self.pipe.close()
        self.process.kill()
        self.process.wait()


def bounded_map(
    function: Callable[[Any], Any], items: Iterable[Any], seconds: float
) -> Iterator[tuple[int, Any]]:
    """Yield (number of the item, function(item)) as they are done, or (number, TimedOut).

    function: importable; a process that takes longer than `seconds` over an item is replaced.
    """
    waiting = enumerate(items)
    fresh = seconds + _START
    busy: list[_Worker] = []
    try:
        while True:
            while len(busy) < (os.cpu_count() or 1) and (item := next(waiting, None)):
                busy.append(_Worker(function))
                busy[-1].assign_item(*item, fresh)
            if not busy:
                return
            remaining = min(worker.deadline for worker in busy) - time.monotonic()
            ready = wait([worker.pipe for worker in busy], max(remaining, 0.0))
            for worker in list(busy):
                late = time.monotonic() > worker.deadline
                if worker.pipe not in ready and not late:
                    continue
                result = worker.receive_result() if worker.pipe in ready else TimedOut(late)
                yield worker.number, result
                following = None if isinstance(result, TimedOut) else next(waiting, None)
                if following is None:
                    busy.remove(worker)
                    worker.stop()
                else:
                    worker.assign_item(*following, seconds)
    finally:
        for worker in busy:
            worker.stop()


class BoundedCalls:
    """A function in a process of its own, one call at a time, each bounded in time.

    busy: a call is under way, or the process is not ready yet.
    """

    def __init__(self, function: Callable[[Any], Any], first: Any) -> None:
        """Start the process; function: importable; first: small, for a call that warms it up."""
        self._function, self._first = function, first
        self._replace()

    def start(self, item: Any, seconds: float) -> None:
        """Start a call, which may take so long; none may be under way."""
        self._worker.assign_item(self._worker.number + 1, item, seconds)
        self.busy = True

    def result(self) -> Any:
        """Return the result of a call, or TimedOut; None while there is nothing new."""
        worker, result = self._worker, None
        if not self.busy:
            return None
        try:
            if worker.pipe.poll():
                result, self.busy = worker.pipe.recv(), False
        except (EOFError, OSError):
            result = TimedOut(False)
        if result is None and time.monotonic() > worker.deadline:
            result = TimedOut(True)
        if isinstance(result, TimedOut):
            worker.stop()
            self._replace()
        # The result of the warming up is nobody's.
        return None if worker.number == 0 and not isinstance(result, TimedOut) else result

    def stop(self) -> None:
        """End the process."""
        self._worker.stop()

    def _replace(self) -> None:
        self._worker = _Worker(self._function)
        self._worker.assign_item(0, self._first, _START)
        self.busy = True


def _end_with(parent: int) -> None:
    """End this process once its parent is gone: one that was killed bounds no item in time."""
    while os.getppid() == parent:
        time.sleep(_PARENT_INTERVAL)
    os._exit(1)


def serve(number: int, parent: int) -> None:
    """Do in this process what comes by the connection with that file number, until it ends.

    parent: the process that waits for it.
    """
    import cv2

    cv2.setNumThreads(1)  # the processes share the cores
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    pipe = Connection(number)
    try:
        function = pipe.recv()
        while True:
            pipe.send(function(pipe.recv()))
    except (EOFError, OSError, KeyboardInterrupt):
        return
