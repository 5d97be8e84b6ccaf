"""Where a command may write: checked before it computes."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from pathlib import Path

from fisheye_svp_ros.errors import OutputError
from fisheye_svp_ros.io.paths import final_path

_PHOTOGRAPHS = ('observations', 'photographs', 'inputs')  # arguments whose folders are read again
_OUTPUTS = {'-o': 'output', '--overlays': 'overlays'}  # options and their arguments


def add_output_folder(
    parser: argparse.ArgumentParser, text: str, default: str | None = None, required: bool = False
) -> None:
    """Declare `-o`, the folder that a command writes to; text: what it says in `--help`."""
    parser.add_argument(
        '-o',
        '--output',
        type=output_folder,
        default=default and Path(default),
        required=required,
        metavar='DIR',
        help=text,
    )


def output_folder(text: str, option: str = '-o') -> Path:
    """Return the path of a folder that exists or can be made; raise OutputError otherwise."""
    path = output_path(text, option)
    if path.exists() and not path.is_dir():
        raise OutputError(f'{option} {text}: it is a file; name a folder')
    return final_path(path) if path.is_symlink() and not path.exists() else path


def output_file(text: str) -> Path:
    """Return the path of a file that can be written; raise OutputError for a folder, too."""
    path = output_path(text)
    if path.is_dir():
        raise OutputError(f'-o {text}: it is a folder; name a file')
    return path


def output_path(text: str, option: str = '-o') -> Path:
    """Return a path whose parents are folders that can be written, or raise OutputError."""
    path, whole = Path(text), final_path(text)
    parent = next(one for one in (whole, *whole.parents) if one.exists())
    if parent != whole and not parent.is_dir():
        raise OutputError(f'{option} {text}: {parent} is not a folder; choose another')
    if not os.access(parent, os.W_OK):
        raise OutputError(f'{option} {text}: no permission to write in {parent}; choose another')
    return path


def check_output(args: argparse.Namespace) -> None:
    """Raise OutputError where an output is a file that is also an input, or among photographs."""
    for option, name in _OUTPUTS.items():
        output = getattr(args, name, None)
        if output is None or not output.exists():
            continue
        for given, path in _paths(args):
            if path.exists() and any(
                one.samefile(output) for one in _files_to_keep(given, path, output, name)
            ):
                raise OutputError(
                    f'{option} {output}: this would overwrite the input {path}; '
                    'choose another name'
                )


def _files_to_keep(given: str, path: Path, output: Path, name: str) -> Iterator[Path]:
    """Yield the files and folders that an output must not be, for one of the inputs."""
    if output.is_file() or given in _PHOTOGRAPHS:
        yield path
    if given not in _PHOTOGRAPHS:
        return
    from fisheye_svp_ros.detect.photographs import IMAGES, photograph_folders

    if output.is_file():
        if path.is_dir() and output.suffix.lower() in IMAGES:
            yield from (folder / output.name for folder in photograph_folders(path))
    else:
        # `undistort` and overlays write PNG files under the names of the photographs.
        if path.is_dir():
            yield from photograph_folders(path)
        elif path.suffix == '.png' and (given == 'inputs' or name == 'overlays'):
            yield path.parent


def _paths(args: argparse.Namespace) -> Iterator[tuple[str, Path]]:
    """Yield the arguments that may be paths: name, path."""
    for name, value in vars(args).items():
        for one in value if isinstance(value, list) else [value]:
            if name not in _OUTPUTS.values() and isinstance(one, str | Path):
                yield name, Path(str(one).rpartition('=')[2])
