"""Where a command may write: checked before it computes, and never over its own input."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from pathlib import Path

from fisheye_svp_ros.errors import OutputError

_PHOTOGRAPHS = ('observations', 'photographs', 'inputs')  # arguments whose folders are read again


def output_folder(text: str) -> Path:
    """Return the path of a folder that exists or can be made; raise OutputError otherwise."""
    path = output_path(text)
    if path.exists() and not path.is_dir():
        raise OutputError(f'-o {text}: it is a file; name a folder')
    return path


def output_path(text: str) -> Path:
    """Return a path whose parents are folders that can be written, or raise OutputError."""
    path = Path(text)
    parent = next(one for one in (path.absolute(), *path.absolute().parents) if one.exists())
    if parent != path.absolute() and not parent.is_dir():
        raise OutputError(f'-o {text}: {parent} is not a folder; choose another')
    if not os.access(parent, os.W_OK):
        raise OutputError(f'-o {text}: no permission to write in {parent}; choose another')
    return path


def check_output(args: argparse.Namespace) -> None:
    """Raise OutputError where `-o` is a file that is also an input, or holds the photographs."""
    output = getattr(args, 'output', None)
    if output is None or not output.exists():
        return
    for name, path in _paths(args):
        # `undistort` writes PNG files under the names of the photographs.
        taken = path.parent if name == 'inputs' and path.suffix == '.png' else path
        if path.exists() and taken.samefile(output) and (
                output.is_file() or name in _PHOTOGRAPHS):
            raise OutputError(f'-o {output}: this would overwrite the input {path}; choose '
                              'another name')


def _paths(args: argparse.Namespace) -> Iterator[tuple[str, Path]]:
    """Yield the arguments that may be paths: name, path."""
    for name, value in vars(args).items():
        for one in value if isinstance(value, list) else [value]:
            if name != 'output' and isinstance(one, str | Path):
                yield name, Path(str(one).rpartition('=')[2])
