"""Who works on a sweep: this process, local processes, or an existing Dask cluster."""

from __future__ import annotations

import logging
import multiprocessing
import os
import pickle
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import (
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
)
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from fisheye_svp_ros.errors import SweepError
from fisheye_svp_ros.study.sweep import InProcess

_TASKS_PER_WORKER = 3  # tasks under way for each worker: none waits for the next
_PATIENCE = 10  # s for a scheduler to answer, and for its first worker


class Workers(NamedTuple):
    """An executor, and how many tasks to hand to it at once."""

    executor: Executor
    ahead: int


@contextmanager
def process_pool(count: int) -> Iterator[Workers]:
    """Yield processes here, 0: this one itself; raise SweepError when one of them dies."""
    if not count:
        yield Workers(InProcess(), 1)
        return
    with tempfile.TemporaryDirectory(prefix='fisheye_svp_') as folder:
        executor = _Processes(count, folder)
        try:
            yield Workers(executor, _TASKS_PER_WORKER * count)
        except BrokenExecutor as cause:
            raise SweepError(
                'a worker process died (out of memory?); finished parts are kept; '
                'continue with --resume and fewer --workers'
            ) from cause
        except (KeyboardInterrupt, SystemExit):
            # Nobody waits any longer for what they are at.
            for process in multiprocessing.active_children():
                process.terminate()
            raise
        finally:
            executor.shutdown(cancel_futures=True)


class _Processes(ProcessPoolExecutor):
    """Processes whose results come in files of a folder.

    All write to one pipe.  One that is killed in the middle of a long result would leave this
    program waiting for the rest of it; the name of a file is written at once or not at all.
    """

    def __init__(self, count: int, folder: str) -> None:
        super().__init__(count, multiprocessing.get_context('spawn'), initializer=_end_with_parent)
        self._folder = folder

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Return the future result of a function."""
        result: Future[Any] = Future()

        def pass_on(written: Future[Path]) -> None:
            try:
                path = written.result()
                value = pickle.loads(path.read_bytes())
                path.unlink()
                result.set_result(value)
            except Exception as error:
                result.set_exception(error)

        super().submit(_written, self._folder, fn, *args, **kwargs).add_done_callback(pass_on)
        return result


def _written(folder: str, fn: Callable[..., Any], *args: Any, **kwargs: Any) -> Path:
    with tempfile.NamedTemporaryFile(dir=folder, delete=False) as file:
        pickle.dump(fn(*args, **kwargs), file)
    return Path(file.name)


@contextmanager
def dask(address: str) -> Iterator[Workers]:
    """Yield the workers of a Dask cluster, which outlives the sweep.

    Raises SweepError where there is none, where it goes away or gives up on a task.
    """
    try:
        import distributed
        from distributed.comm import CommClosedError
    except ModuleNotFoundError as cause:
        raise SweepError(
            'dask.distributed is not installed; install the extra `dask` of this package'
        ) from cause
    with ExitStack() as stack:
        try:
            client = distributed.Client(address, timeout=_PATIENCE, set_as_default=False)
        except (OSError, ValueError) as cause:
            raise SweepError(f'{address}: no Dask scheduler answers there ({cause})') from cause
        stack.enter_context(_no_logging())  # what it tells of a scheduler that died, one line says
        stack.enter_context(client)
        try:
            client.wait_for_workers(1, timeout=_PATIENCE)
            ahead = _TASKS_PER_WORKER * sum(client.nthreads().values())
        except (OSError, CancelledError) as cause:
            raise SweepError(f'{address}: the Dask cluster has no worker; start one') from cause
        try:
            yield Workers(client.get_executor(pure=False), ahead)
        except (distributed.KilledWorker, CommClosedError, CancelledError) as cause:
            reason = str(cause) or 'its scheduler is gone'
            raise SweepError(
                f'{address}: the Dask cluster gave up ({reason}); finished parts are kept; '
                'continue with --resume'
            ) from cause


@contextmanager
def _no_logging() -> Iterator[None]:
    before = logging.root.manager.disable
    logging.disable()
    try:
        yield
    finally:
        logging.disable(before)


def _end_with_parent() -> None:
    """Make a worker end when this program is killed, and leave Ctrl-C to this program."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
