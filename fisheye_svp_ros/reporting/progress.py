"""Progress of long work on standard error: a bar on a terminal, elsewhere a line now and then."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

from rich.console import Console
from rich.progress import Progress

_INTERVAL = 5.0  # seconds between lines where there is no terminal


@contextmanager
def progress(description: str, total: int | None = None) -> Iterator[Callable[..., None]]:
    """Show a bar while the block runs; call what it yields after one of `total` steps, or more.

    Without a total the bar only says that the work goes on.
    """
    with _bar(description, total) as update:
        yield lambda count=1: update(advance=count)


@contextmanager
def stages(description: str) -> Iterator[Callable[[str, float], None]]:
    """Show a bar while the block runs; call what it yields with the stage and the share done."""
    with _bar(description, 1) as update:
        yield lambda stage, done: update(description=f'{description}: {stage}', completed=done)


@contextmanager
def _bar(description: str, total: int | None) -> Iterator[Callable[..., None]]:
    if not sys.stderr.isatty():
        yield _Lines(description, total).update
        return
    with Progress(console=Console(stderr=True), transient=True) as bar:
        yield partial(bar.update, bar.add_task(description, total=total))


class _Lines:
    """Progress as plain lines: none for work that is done within the interval."""

    def __init__(self, description: str, total: int | None) -> None:
        self._description, self._total = description, total
        self._done, self._next = 0.0, time.monotonic() + _INTERVAL

    def update(
        self, advance: float = 0.0, completed: float | None = None, description: str | None = None
    ) -> None:
        """Take over what `rich.progress.Progress.update` is told; print a line when it is due."""
        self._done = self._done + advance if completed is None else completed
        self._description = description or self._description
        if time.monotonic() >= self._next:
            share = f' ({self._done / self._total:.0%})' if self._total else ''
            print(f'{self._description}{share}', file=sys.stderr, flush=True)
            self._next = time.monotonic() + _INTERVAL
