"""Where the package's own files (lenses, environments, parameter files) are installed."""

from __future__ import annotations

from functools import cache
from pathlib import Path


@cache
def share_directory() -> Path:
    """Return the directory that holds config/: the source tree, or <prefix>/share/<package>."""
    package = Path(__file__).resolve().parents[1]
    source = package.parent
    if (source / 'package.xml').is_file():
        return source
    return package.parents[3] / 'share' / package.name


def config_path(name: str) -> Path:
    """Return the path of a file below config/."""
    return share_directory() / 'config' / name


def lens_path(name: str) -> Path:
    """Return the path of a lens: a file as given, or the name of one in config/lenses."""
    return _given_or_named(name, 'lenses')


def sweep_path(name: str) -> Path:
    """Return the path of a sweep file: a file as given, or the name of one in config/sweeps."""
    return _given_or_named(name, 'sweeps')


def _given_or_named(name: str, folder: str) -> Path:
    given = Path(name)
    if given.suffix in ('.yaml', '.yml') or given.is_file():
        return given
    return config_path(f'{folder}/{name}.yaml')
