"""Where compiled code is kept from one start to the next."""

from __future__ import annotations

import hashlib
import os
import platform
from contextlib import suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path

_SOURCES = (
    'optics/formulas.py',
    'optics/rays.py',
    'optics/engines/kernels.py',
    'optics/engines/adjustment.py',
    'optics/engines/entries.py',
    'optics/engines/marquardt.py',
)


@cache
def folder() -> Path:
    """Return the folder for these sources, this Numba, this Python and this kind of machine."""
    package = Path(__file__).parents[2]
    told = [version('numba'), platform.python_version(), platform.machine(), platform.node()]
    digest = hashlib.sha256('\n'.join(told).encode())
    for name in _SOURCES:
        digest.update((package / name).read_bytes())
    root = os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache'
    return Path(root) / 'fisheye_svp_ros' / digest.hexdigest()[:16]


def is_compiled() -> bool:
    """Say whether all of it has been compiled before, by this installation."""
    return _mark().exists()


@cache
def mark_filled() -> None:
    """Remember that all of it has been compiled, where that can be kept."""
    with suppress(OSError):
        _mark().touch()


def _mark() -> Path:
    # Numba finds what it compiled by the place and the time of the source.
    source = Path(__file__).with_name('entries.py')
    told = f'{source} {source.stat().st_mtime_ns}'
    return folder() / f'complete-{hashlib.sha256(told.encode()).hexdigest()[:16]}'
