"""Files, YAML, JSON: read whole and within bounds, written so that nothing is half-written.

YAML and JSON are read whatever they hold, with errors that name the line.  Refused beside what is
broken: aliases, of which a few lines can stand for gigabytes; keys that stand twice, of which one
would be lost; nesting and counts of values beyond any use.
"""

from __future__ import annotations

import filecmp
import json
import math
import os
import platform
import re
import signal
import stat
import tempfile
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import cache
from pathlib import Path
from typing import IO, Any, ClassVar

import numpy as np
import yaml

from fisheye_svp_ros.errors import FisheyeSvpError, OutputError
from fisheye_svp_ros.io.paths import final_path

MAX_BYTES = 1 << 30  # bytes of a table or a photograph

_BLOCK_BYTES = 1 << 20  # bytes
_HOST = re.sub(r'\W', '', platform.node())[:16]
_TEMPORARY = re.compile(r'\..+\.(\w*)-(\d+)\.\w{8}(\.\w+)?')  # host and process that wrote it
_waiting: ContextVar[dict[Path, Path] | None] = ContextVar('_waiting', default=None)
_keeping: ContextVar[bool] = ContextVar('_keeping', default=False)
LARGEST_YAML = 1 << 22  # characters
_MOST_VALUES, _DEEPEST = 100_000, 50

# LibYAML, where PyYAML was built with it, takes a tenth of the time.
_Base: Any = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)
_BaseDumper: Any = getattr(yaml, 'CSafeDumper', yaml.SafeDumper)
_INT, _FLOAT, _TIMESTAMP = (f'tag:yaml.org,2002:{kind}' for kind in ('int', 'float', 'timestamp'))


@contextmanager
def open_bytes(path: str | Path, error: type[FisheyeSvpError]) -> Iterator[IO[bytes]]:
    """Yield the stream of a regular file; raise `error` for any other."""
    try:
        # Unlike Path.open, this does not wait for whoever writes into a pipe.
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), 'rb') as stream:
            if not stat.S_ISREG(os.fstat(stream.fileno()).st_mode):
                raise error(f'{path}: it must be a regular file')
            yield stream
    except (OSError, ValueError) as cause:
        reason = getattr(cause, 'strerror', None) or cause
        raise error(f'{path}: cannot be read ({reason}); check the path') from cause


def read_bytes(path: str | Path, error: type[FisheyeSvpError], most: int = MAX_BYTES) -> bytes:
    """Return what a regular file holds; raise `error` for any other, and above `most` bytes."""
    with open_bytes(path, error) as stream:
        size, data = os.fstat(stream.fileno()).st_size, bytearray()
        while size <= most and (piece := stream.read(_BLOCK_BYTES)):
            data += piece
            size = max(size, len(data))
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

    In a block of `write_together`, when that succeeds.  A symbolic link stays one: the file that
    it leads to is written.  Raises OutputError, naming the path, where it cannot be written.
    """
    target, waiting = final_path(path), _waiting.get()
    if target.exists() and not target.is_file():
        raise OutputError(f'{path}: it exists and is not a regular file; choose another name')
    temporary = None
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        _remove_leftovers(target.parent)
        handle, name = tempfile.mkstemp(
            prefix=f'.{target.name}.{_HOST}-{os.getpid()}.',
            suffix=target.suffix,
            dir=target.parent,
        )
        os.close(handle)
        temporary = Path(name)
        yield temporary
        temporary.chmod(0o666 & ~_umask())
        with temporary.open('rb') as written:
            os.fsync(written)  # else a power cut leaves the new name with no content
        if _keeping.get() and target.exists() and not filecmp.cmp(temporary, target, False):
            raise OutputError(
                f'{path}: another file is there; choose another folder, or remove it'
            )
        if waiting is None:
            temporary.replace(target)
        else:
            waiting[target], temporary = temporary, waiting.pop(target, None)
    except OSError as cause:
        raise OutputError(f'{path}: cannot be written ({cause.strerror or cause})') from cause
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


@cache
def _remove_leftovers(folder: Path) -> None:
    """Remove the temporary files of processes of this machine that were killed."""
    with suppress(OSError):
        for path in folder.iterdir():
            match = _TEMPORARY.fullmatch(path.name)
            if match and match[1] == _HOST and not _runs(int(match[2])):
                path.unlink()


def _runs(process: int) -> bool:
    """Whether a process of this machine runs, be it another user's."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        pass
    return True


@contextmanager
def keep_existing(keep: bool = True) -> Iterator[None]:
    """Have no file with another content be replaced in the block; raise OutputError instead."""
    token = _keeping.set(keep)
    try:
        yield
    finally:
        _keeping.reset(token)


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
    """Return where a file is that was written before, if need be in this `write_together`."""
    return (_waiting.get() or {}).get(final_path(path), path)


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


def as_read(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a document as it is read back from what `write_json` writes."""
    plain: dict[str, Any] = json.loads(json.dumps(_finite(document)))
    return plain


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


class _Loader(_Base):  # type: ignore[misc]
    """YAML 1.1 as PyYAML reads it, but for dates, and with the numbers of YAML 1.2.

    So 1e-3 is one, 0800 is eight hundred, and 1:30 is not 90.
    """

    # A date is nothing that any file here has; 2001-99-99 may be a name.
    yaml_implicit_resolvers: ClassVar = {
        first: [
            (tag, pattern) for tag, pattern in resolvers if tag not in (_INT, _FLOAT, _TIMESTAMP)
        ]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }


_Loader.add_implicit_resolver(
    _INT, re.compile(r'[-+]?(0|[1-9][0-9]*|0x[0-9a-fA-F]+)$'), list('-+0123456789')
)
_Loader.add_implicit_resolver(
    _FLOAT,
    re.compile(
        r'[-+]?((\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|\.(inf|Inf|INF))$'
        r'|\.(nan|NaN|NAN)$'
    ),
    list('-+.0123456789'),
)
# OpenCV's matrices are mappings; those of other types are none that a lens has.
for _kind in ('opencv-matrix', 'opencv-nd-matrix'):
    _Loader.add_constructor(f'tag:yaml.org,2002:{_kind}', _Loader.construct_yaml_map)


class _Dumper(_BaseDumper):  # type: ignore[misc]
    """A dumper that writes every value out, since aliases are not read."""

    def ignore_aliases(self, _: Any) -> bool:
        return True


# Whoever builds a lens or a scenario in Python computes with numpy.
for _scalar in (np.bool_, np.integer, np.floating):
    _Dumper.add_multi_representer(
        _scalar, lambda dumper, value: dumper.represent_data(value.item())
    )


def read_yaml(path: str | Path, error: type[FisheyeSvpError]) -> dict[str, Any]:
    """Return the mapping a YAML file holds; raise `error`, naming file and line, if it cannot."""
    return parse_yaml(read_text(path, error, LARGEST_YAML), path, error)


def parse_yaml(text: str, where: str | Path, error: type[FisheyeSvpError]) -> dict[str, Any]:
    """Return the mapping a YAML text holds; raise `error`, naming `where` and line."""
    node = compose_yaml(text, where, error)
    loader = _Loader('')
    try:
        with _convert_errors(where, error):
            document = loader.construct_document(node) if node else None
    finally:
        loader.dispose()
    if not isinstance(document, dict):
        raise error(f'{where}: a YAML mapping is expected, found {type(document).__name__}')
    return document


def compose_yaml(text: str, where: str | Path, error: type[FisheyeSvpError]) -> yaml.Node | None:
    """Return the nodes of a YAML text, None for an empty one; raise `error` as `parse_yaml`."""
    if len(text) > LARGEST_YAML:
        raise error(f'{where}: above {LARGEST_YAML >> 20} MB, the largest YAML file that is read')
    depth = values = 0
    with _convert_errors(where, error):
        for event in yaml.parse(text, _Loader):
            opens = isinstance(event, yaml.CollectionStartEvent)
            depth += opens - isinstance(event, yaml.CollectionEndEvent)
            values += opens or isinstance(event, yaml.ScalarEvent)
            if isinstance(event, yaml.AliasEvent):
                raise _yaml_error('an alias; YAML aliases are not supported', event)
            if depth > _DEEPEST or values > _MOST_VALUES:
                raise _yaml_error(
                    f'more than {_MOST_VALUES} values, or nested deeper than {_DEEPEST}', event
                )
        node: yaml.Node | None = yaml.compose(text, _Loader)
        _refuse_repeated_keys(node)
    return node


def dump_yaml(document: Any, **style: Any) -> str:
    """Return a document as YAML that `parse_yaml` reads back."""
    text: str = yaml.dump(document, Dumper=_Dumper, sort_keys=False, **style)
    return text


def parse_number(text: str) -> float:
    """Return the number that a word of a data file is; raise ValueError for any other word."""
    if '_' in text or not text.isascii():  # Python alone reads 1_00, and digits of all scripts
        raise ValueError(f'could not convert to a number: {text!r}')
    return float(text)


def parse_json(text: str, where: str | Path, error: type[FisheyeSvpError]) -> dict[str, Any]:
    """Return the object a JSON text holds; raise `error`, naming `where`."""
    try:
        document = json.loads(text, object_pairs_hook=_object)
    except (ValueError, RecursionError) as cause:
        raise error(f'{where}: broken JSON ({cause})') from cause
    if not isinstance(document, dict):
        raise error(f'{where}: a JSON object is expected, found {type(document).__name__}')
    return document


def read_json(path: str | Path, error: type[FisheyeSvpError]) -> dict[str, Any]:
    """Return the object a JSON file holds; raise `error`, naming the file."""
    return parse_json(read_text(path, error), path, error)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    mapping = dict(pairs)
    if len(mapping) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f'{next(n for n in names if names.count(n) > 1)!r} is listed twice')
    return mapping


def _refuse_repeated_keys(node: yaml.Node | None) -> None:
    nodes = [node]
    while nodes:
        one = nodes.pop()
        if isinstance(one, yaml.SequenceNode):
            nodes += one.value
        if not isinstance(one, yaml.MappingNode):
            continue
        seen = set()
        for key, value in one.value:
            name = key.value if isinstance(key, yaml.ScalarNode) else id(key)
            if name in seen:
                raise _yaml_error(f'the key {name!r} a second time', key)
            seen.add(name)
            nodes += (key, value)


def _yaml_error(what: str, place: Any) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=f'there is {what}', problem_mark=place.start_mark)


@contextmanager
def _convert_errors(where: str | Path, error: type[FisheyeSvpError]) -> Iterator[None]:
    try:
        yield
    except yaml.YAMLError as cause:
        mark = getattr(cause, 'problem_mark', None)
        line = f' at line {mark.line + 1}' if mark else ''
        problem = getattr(cause, 'problem', None) or f'cannot be parsed ({cause})'
        raise error(f'{where}: broken YAML{line}: {problem}') from cause
    except (ValueError, TypeError, KeyError, AttributeError, IndexError, RecursionError) as cause:
        # What PyYAML lets out for a value that is none of its own tag
        raise error(
            f'{where}: broken YAML: a value does not match its tag, or has too many digits '
            f'({cause})'
        ) from cause
