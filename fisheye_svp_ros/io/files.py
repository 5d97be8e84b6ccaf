"""Files: read YAML with errors that name the file, write so that nothing is left half-written."""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from fisheye_svp_ros.errors import FisheyeSvpError, OutputError


class _Loader(yaml.SafeLoader):
    """YAML 1.1 as PyYAML reads it, but with 1e-3 as the number that it is in ROS and YAML 1.2."""


_Loader.add_implicit_resolver(
    'tag:yaml.org,2002:float', re.compile(r'[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+$'),
    list('-+0123456789'),
)


def read_yaml(path: str | Path, error: type[FisheyeSvpError]) -> dict[str, Any]:
    """Return the mapping a YAML file holds; raise `error`, naming file and line, if it cannot."""
    try:
        document = yaml.load(Path(path).read_text(encoding='utf-8'), _Loader)
    except OSError as cause:
        raise error(f'{path}: cannot be read ({cause.strerror}); check the path') from cause
    except UnicodeDecodeError as cause:
        raise error(f'{path}: not a text file; a YAML file in UTF-8 is expected') from cause
    except yaml.YAMLError as cause:
        mark = getattr(cause, 'problem_mark', None)
        line = f' at line {mark.line + 1}' if mark else ''
        problem = getattr(cause, 'problem', None) or 'cannot be parsed'
        raise error(f'{path}: broken YAML{line}: {problem}') from cause
    if not isinstance(document, dict):
        raise error(f'{path}: a YAML mapping is expected, found {type(document).__name__}')
    return document


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; rename it to `path` when the block succeeds.

    Raises OutputError, naming the path, where it cannot be written.
    """
    target = Path(path)
    if target.exists() and not target.is_file():
        raise OutputError(f'{path}: it is there and not a regular file; choose another name')
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(
            prefix=f'.{target.name}.', suffix=target.suffix, dir=target.parent
        )
        os.close(handle)
    except OSError as cause:
        raise OutputError(f'{path}: cannot be written ({cause.strerror})') from cause
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o666 & ~_umask())
        with temporary.open('rb') as written:
            os.fsync(written)  # else a power cut leaves the new name with no content
        temporary.replace(target)
    except OSError as cause:
        raise OutputError(f'{path}: cannot be written ({cause.strerror or cause})') from cause
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write a text file whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding='utf-8')


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
