"""Progress of long work, on standard error and only where that is a terminal."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

from rich.console import Console
from rich.progress import Progress


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
        yield lambda **_: None
        return
    with Progress(console=Console(stderr=True), transient=True) as bar:
        yield partial(bar.update, bar.add_task(description, total=total))
