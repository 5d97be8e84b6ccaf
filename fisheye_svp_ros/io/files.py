"""Files: read whole and within bounds, written so that nothing is left half-written."""

from __future__ import annotations

import json
import math
import os
import signal
import stat
import tempfile
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from fisheye_svp_ros.errors import FisheyeSvpError, OutputError, ParameterError

MAX_BYTES = 1 << 30  # bytes of a table or a photograph

_BLOCK_BYTES = 1 << 20  # bytes
_waiting: ContextVar[dict[Path, Path] | None] = ContextVar('_waiting', default=None)


def path_of(given: str | Path) -> Path:
    """Return a path; raise ParameterError for what is none."""
    if not isinstance(given, str | os.PathLike):
        raise ParameterError(f'a {type(given).__name__} is no path; the name of a file is needed')
    return Path(given)


def read_bytes(path: str | Path, error: type[FisheyeSvpError], most: int = MAX_BYTES) -> bytes:
    """Return what a regular file holds; raise `error` for any other, and above `most` bytes."""
    try:
        # Unlike Path.open, this does not wait for whoever writes into a pipe.
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), 'rb') as stream:
            found = os.fstat(stream.fileno())
            if not stat.S_ISREG(found.st_mode):
                raise error(f'{path}: it must be a regular file')
            size, data = found.st_size, bytearray()
            while size <= most and (piece := stream.read(_BLOCK_BYTES)):
                data += piece
                size = max(size, len(data))
    except (OSError, ValueError) as cause:
        reason = getattr(cause, 'strerror', None) or cause
        raise error(f'{path}: cannot be read ({reason}); check the path') from cause
    if size > most:
        raise error(f'{path}: above {most / (1 << 20):g} MB, the largest size that is read')
    return bytes(data)


def read_text(path: str | Path, error: type[FisheyeSvpError], most: int = MAX_BYTES) -> str:
    """Return the text of a regular file in UTF-8; raise `error` as `read_bytes` does."""
    try:
        return read_bytes(path, error, most).decode('utf-8-sig')
    except UnicodeDecodeError as cause:
        raise error(f'{path}: not a text file; one in UTF-8 is expected') from cause


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; rename it to `path` when the block succeeds.

    In a block of `together`, when that succeeds.  Raises OutputError, naming the path, where it
    cannot be written.
    """
    target, waiting = path_of(path), _waiting.get()
    if target.exists() and not target.is_file():
        raise OutputError(f'{path}: it exists and is not a regular file; choose another name')
    temporary = None
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(
            prefix=f'.{target.name}.', suffix=target.suffix, dir=target.parent
        )
        os.close(handle)
        temporary = Path(name)
        yield temporary
        temporary.chmod(0o666 & ~_umask())
        with temporary.open('rb') as written:
            os.fsync(written)  # else a power cut leaves the new name with no content
        if waiting is None:
            temporary.replace(target)
        else:
            waiting[target], temporary = temporary, waiting.pop(target, None)
    except OSError as cause:
        raise OutputError(f'{path}: cannot be written ({cause.strerror or cause})') from cause
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


@contextmanager
def write_together() -> Iterator[None]:
    """Have all files that are written in the block appear when it succeeds, or none of them."""
    if _waiting.get() is not None:
        yield
        return
    waiting: dict[Path, Path] = {}
    token = _waiting.set(waiting)
    try:
        yield
        with _defer_signals():
            for target, temporary in waiting.items():
                try:
                    temporary.replace(target)
                except OSError as cause:
                    raise OutputError(f'{target}: cannot be written ({cause.strerror})') from cause
    finally:
        _waiting.reset(token)
        for temporary in waiting.values():
            temporary.unlink(missing_ok=True)


@contextmanager
def _defer_signals() -> Iterator[None]:
    """Keep SIGINT and SIGTERM back until the block is done."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    late: list[int] = []
    kept = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(one, lambda number, _: late.append(number)) for one in kept]
    try:
        yield
    finally:
        for one, handler in zip(kept, before, strict=True):
            signal.signal(one, handler)
        for number in late:
            signal.raise_signal(number)


def written(path: Path) -> Path:
    """Return where a file is that was written before, if need be in this block of `together`."""
    return (_waiting.get() or {}).get(path, path)


def write_text(path: str | Path, text: str) -> None:
    """Write a text file whole or not at all."""
    write_bytes(path, text.encode())


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write a file whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def write_json(path: str | Path, document: Mapping[str, Any]) -> None:
    """Write a JSON file whole or not at all; a number that is not finite becomes null."""
    write_text(path, json.dumps(_finite(document), indent=2, allow_nan=False) + '\n')


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
