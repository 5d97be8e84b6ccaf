"""What a terminal shows: tables on standard output, progress of long work on standard error.

Progress is a bar on a terminal, elsewhere a line now and then.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console, JustifyMethod
from rich.padding import Padding
from rich.progress import Progress
from rich.table import Table

from fisheye_svp_ros.errors import FisheyeSvpError, one_line

UNITS = {  # of the parameters of a lens; 1 where there is none
    **dict.fromkeys(('f', 'fx', 'fy', 'cx', 'cy'), 'px'),
    **dict.fromkeys(('s0', 'e0', 'e1', 'e2', 'thickness'), 'm'),
    **dict.fromkeys(
        ('port_distance', 'port_thickness', 'port_radius', 'port_x', 'port_y', 'port_z'), 'm'
    ),
    **dict.fromkeys(('port_tilt_x', 'port_tilt_y'), 'rad'),
}
_DEFAULT_WIDTH = 200  # columns where no terminal says how many it has
_MIN_WIDTH = 10  # columns that text is broken into at the narrowest
_MAX_REASON = 200  # characters of an error
_ROUNDING, _ALL_DIGITS = 1e-9, 1e4  # what rounding leaves; from where all digits are shown
_INTERVAL = 5.0  # seconds between lines where there is no terminal


def print_table(
    title: str, header: Sequence[str], rows: Iterable[Sequence[str]], words: Sequence[str] = ()
) -> None:
    """Print a table: the first column flush left, the others, numbers, flush right.

    words: further columns that hold text; it is broken into lines where the table is too wide.
    Numbers are never cut: a terminal that is too narrow folds the lines.
    """
    table = Table(box=box.SIMPLE_HEAD)
    cells, least = [header, *rows], 1
    for i, name in enumerate(header):
        text = name in words
        justify: JustifyMethod = 'right' if i and not text else 'left'
        widest = max(len(row[i]) for row in cells)
        table.add_column(
            name, justify=justify, no_wrap=not text, min_width=None if text else widest
        )
        least += 3 + (_MIN_WIDTH if text else widest)
    for row in cells[1:]:
        table.add_row(*row)
    out = console()
    out.print(title)
    out.width = max(out.width, least)  # in less room rich leaves out whole columns
    out.print(table, crop=False, overflow='ignore')


def print_note(note: str) -> None:
    """Print what there is to say beside the results, on standard error, as one line."""
    print(f'fisheye-svp: note: {one_line(note)}', file=sys.stderr, flush=True)


def draw_or_note(path: Path, draw: Callable[..., None], *arguments: Any) -> bool:
    """Call draw(path, *arguments); return whether the picture was drawn, with a note if not.

    Numbers do not depend on their pictures.  Raises OutputError where a file cannot be written.
    """
    try:
        draw(path, *arguments)
    except FisheyeSvpError:
        raise
    except Exception as error:
        print_note(
            f'{path} cannot be drawn ({type(error).__name__}: {str(error)[:_MAX_REASON]!r}); '
            'all other results are written'
        )
        return False
    return True


def print_lines(lines: Iterable[str]) -> None:
    """Print sentences, the first as a title, those that are too long for a line hanging."""
    out = console()
    title, *body = lines
    out.print(title)
    for line in body:
        if not line:
            out.print()  # padding alone prints nothing
            continue
        out.print(Padding(line, (0, 0, 0, 2), expand=False))


def console() -> Console:
    """Return the console of standard output, wide enough for a table when it is a file."""
    return Console(
        width=None if sys.stdout.isatty() else _DEFAULT_WIDTH,
        highlight=False,
        markup=False,
        emoji=False,
    )


def with_error(value: float, standard_error: float) -> tuple[str, str]:
    """Return a value and its standard error as text, to two digits of the error."""
    if not (math.isfinite(standard_error) and standard_error > 0):
        return f'{value:.6g}', '-'
    digits = 1 - math.floor(math.log10(standard_error))
    decimals = max(0, digits)
    if decimals > 9:
        return f'{value:.6g}', f'{standard_error:.1e}'
    text = f'{round(value, digits):.{decimals}f}'
    return without_minus_zero(text), f'{round(standard_error, digits):.{decimals}f}'


def short_number(value: float) -> str:
    """Return a number for people: to four digits, what rounding leaves as 0."""
    if abs(value) < _ROUNDING:
        return '0'
    whole = abs(value) >= _ALL_DIGITS or float(value).is_integer()
    return f'{value:.0f}' if math.isfinite(value) and whole else f'{value:.4g}'


def without_minus_zero(text: str) -> str:
    """Return a number as text, without the sign of a negative one that is rounded to zero."""
    return text.removeprefix('-') if float(text) == 0 else text


def range_text(range_m: float) -> str:
    """Return a range for people, to three digits."""
    return f'{range_m:.3g} m' if math.isfinite(range_m) else 'infinity'


def interval(low: float, high: float) -> str:
    """Return an interval as text, to two digits of its width."""
    width = 0.1 * (high - low)
    return ' … '.join(with_error(end, width)[0] for end in (low, high))


def noise_text(sigma: float | None) -> str:
    """Say what noise the standard errors rest on: sigma, px, estimated, or None if given."""
    if sigma is None:
        return 'They follow from the sigma of the observations'
    return (
        f'They follow from a noise of {sigma:.4f} px in u and in v, estimated from the residuals'
    )


@contextmanager
def progress(description: str, total: int | None = None) -> Iterator[Callable[..., None]]:
    """Show a bar while the block runs; call what it yields after one of `total` steps, or more.

    Without a total the bar only says that the work goes on.
    """
    with _bar(description, total) as update:
        yield lambda count=1: update(advance=count)


class Stages:
    """Progress of work in stages: called with the stage and the share done."""

    def __init__(self, description: str, update: Callable[..., None]) -> None:
        self._lines, self._description, self._update = ['', ''], description, update

    def __call__(self, stage: str, done: float) -> None:
        """Show a stage."""
        self._lines[1] = f'{self._description}: {stage}'
        self._update(description='\n'.join(filter(None, self._lines)), completed=done)

    def announce(self, news: str) -> None:
        """Show a line above the stage from now on."""
        self._lines[0] = news
        self._update(description='\n'.join(filter(None, self._lines)))


@contextmanager
def stages(description: str) -> Iterator[Stages]:
    """Show a bar while the block runs; call what it yields with the stage and the share done."""
    with _bar(description, 1) as update:
        yield Stages(description, update)


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
