"""Many trials side by side, each in a process with one thread."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import TypeVar

from fisheye_svp_ros.reporting.terminal import progress

T = TypeVar('T')
R = TypeVar('R')


def in_processes(
    label: str, trial: Callable[[T], R], todo: Sequence[T], workers: int
) -> list[R]:
    """Return what a trial makes of each item, in their order; Ctrl-C keeps those that are done."""
    os.environ['OMP_NUM_THREADS'] = os.environ['OPENBLAS_NUM_THREADS'] = '1'
    context = multiprocessing.get_context('spawn')  # the number of threads is read at the start
    outcomes = []
    with (
        progress(label, len(todo)) as advance,
        ProcessPoolExecutor(workers, mp_context=context) as pool,
    ):
        try:
            for outcome in pool.map(trial, todo):
                outcomes.append(outcome)
                advance()
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
    return outcomes
