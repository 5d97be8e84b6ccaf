"""Standard output and error that end no program: what nobody reads goes nowhere.

`| head -1` closes the pipe, `>&-` leaves no stream at all, a disk may be full, a terminal may know
no Greek.  A command goes on in each of these cases, and writes its files.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TextIO, cast

_STANDARD = (0, 1, 2)  # descriptors of input, output, error


class _Stream:
    """A text stream whose failures are kept in `error`; after the first, nothing is written."""

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = stream or Path(os.devnull).open('w')  # noqa: SIM115
        self.error: OSError | None = None

    def write(self, text: str) -> int:
        """Write a text; characters that the stream cannot hold are written as escapes."""
        try:
            self._attempt(lambda: self._stream.write(text))
        except UnicodeEncodeError as error:
            plain = text.encode(error.encoding, 'backslashreplace').decode(error.encoding)
            self._attempt(lambda: self._stream.write(plain))
        return len(text)

    def flush(self) -> None:
        """Write what is buffered."""
        self._attempt(self._stream.flush)

    def _attempt(self, call: Callable[[], object]) -> None:
        if self.error is not None:
            return
        try:
            call()
        except OSError as error:
            self.error = error
            with suppress(OSError):  # of a stream without a descriptor, too
                # What is buffered goes there when the interpreter ends.
                _open_nowhere(self._stream.fileno())

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def tolerant_streams() -> Iterator[Callable[[], OSError | None]]:
    """Have nothing in the block fail for want of a reader; yield what has become of the output.

    That is None, or the first error of standard output.
    """
    for descriptor in _STANDARD:
        try:
            os.fstat(descriptor)
        except OSError:  # else the next file that is opened would be taken for it
            _open_nowhere(descriptor)
    before = sys.stdout, sys.stderr
    output, error = _Stream(sys.stdout), _Stream(sys.stderr)
    sys.stdout, sys.stderr = cast('TextIO', output), cast('TextIO', error)

    def output_error() -> OSError | None:
        output.flush()
        return output.error

    try:
        yield output_error
    finally:
        output.flush()
        error.flush()
        sys.stdout, sys.stderr = before


@contextmanager
def silent_libraries() -> Iterator[None]:
    """Have nothing that a library of C writes to standard error in the block reach anybody."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        _open_nowhere(2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def _open_nowhere(descriptor: int) -> None:
    """Make a descriptor one of /dev/null, which child processes inherit."""
    nowhere = os.open(os.devnull, os.O_RDWR)
    if nowhere == descriptor:
        os.set_inheritable(descriptor, True)
    else:
        os.dup2(nowhere, descriptor)
        os.close(nowhere)
