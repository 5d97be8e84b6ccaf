"""Who works on a sweep: processes of this machine, or an existing Dask cluster."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from fisheye_svp_ros.commands.notes import say
from fisheye_svp_ros.errors import SweepError

if TYPE_CHECKING:
    from distributed import Client

T = TypeVar('T')
R = TypeVar('R')

_TASKS_PER_WORKER = 3  # tasks under way for each worker: none waits for the next
_PATIENCE, _WORKER_PATIENCE = 10, 60  # s for a scheduler to answer, and for a worker to come
_CHECK_INTERVAL = 10  # s without a result after which somebody must still be at work


class Workers(NamedTuple):
    """An executor, how many tasks to hand to it at once, and what fails if nobody works on them.

    check_alive: raises SweepError; called where no result has come for some seconds.
    """

    executor: Executor
    ahead: int
    check_alive: Callable[[], object] = lambda: None


def completed_tasks(
    work: Callable[[T], R], tasks: Iterable[T], workers: Workers
) -> Iterator[tuple[T, R]]:
    """Yield tasks and what work makes of them, as they are done; few are under way at once."""
    under_way: dict[Future[R], T] = {}

    def results_so_far() -> Iterator[tuple[T, R]]:
        while not (done := wait(under_way, _CHECK_INTERVAL, FIRST_COMPLETED).done):
            workers.check_alive()
        for future in done:
            yield under_way.pop(future), future.result()

    for task in tasks:
        under_way[workers.executor.submit(work, task)] = task
        if len(under_way) >= workers.ahead:
            yield from results_so_far()
    while under_way:
        yield from results_so_far()


@contextmanager
def process_pool(count: int) -> Iterator[Workers]:
    """Yield processes here; raise SweepError when one of them dies.

    Their results share one pipe: a long one of a process that is killed meanwhile would leave
    this program waiting for its rest, so what a task makes should go to a file of its own.
    """
    executor = ProcessPoolExecutor(
        count, multiprocessing.get_context('spawn'), initializer=_end_with_parent
    )
    try:
        yield Workers(executor, _TASKS_PER_WORKER * count)
    except BrokenExecutor as cause:
        raise SweepError(
            'a worker process died (out of memory?); finished parts are kept; '
            'continue with --resume and fewer --workers'
        ) from cause
    except (KeyboardInterrupt, SystemExit, GeneratorExit):
        # Nobody waits any longer for what they are at.
        for process in multiprocessing.active_children():
            process.terminate()
        raise
    finally:
        executor.shutdown(cancel_futures=True)


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
        count = _wait_for_workers(client, address)
        try:
            yield Workers(
                client.get_executor(pure=False),
                _TASKS_PER_WORKER * count,
                partial(_wait_for_workers, client, address),
            )
        except (distributed.KilledWorker, CommClosedError, CancelledError) as cause:
            reason = str(cause) or 'its scheduler is gone'
            raise SweepError(
                f'{address}: the Dask cluster gave up ({reason}); finished parts are kept; '
                'continue with --resume'
            ) from cause


def _wait_for_workers(client: Client, address: str) -> int:
    """Return the number of threads of the workers of a cluster, once there are any.

    Raises SweepError where none comes in time: tasks would wait for one without end.
    """
    try:
        if not client.nthreads():
            say(
                f'{address}: the cluster has no worker; waiting up to {_WORKER_PATIENCE} s for one'
            )
            client.wait_for_workers(1, timeout=_WORKER_PATIENCE)
        return sum(client.nthreads().values())
    except (OSError, CancelledError) as cause:
        raise SweepError(
            f'{address}: no worker came to the Dask cluster in {_WORKER_PATIENCE} s; '
            'start one, then continue with --resume'
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
