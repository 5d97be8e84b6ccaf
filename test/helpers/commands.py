"""Commands run in this process."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from fisheye_svp_ros import cli
from fisheye_svp_ros.io.lens_files import save_lens
from fisheye_svp_ros.optics.lens import Lens


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Return the one line with which a command refuses what it is given, exit status 2."""
    capsys.readouterr()
    assert cli.main([str(argument) for argument in arguments]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    said = [line for line in lines if not line.endswith('%)')]  # without progress
    assert len(said) == 1
    return said[0]


def convert_lens(lens: Lens, folder: Path, name: str, form: str) -> None:
    """Have `lens` write a lens into a file of another tool, and lens.yaml beside it."""
    save_lens(lens, folder / 'lens.yaml')
    files = [str(folder / 'lens.yaml'), '-o', str(folder / name)]
    assert cli.main(['lens', *files, '--format', form]) == 0


@contextmanager
def unread(name: str = 'stdout') -> Iterator[None]:
    """Have standard output, or `stderr`, be a pipe whose reader has gone, as after `| head -1`."""
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, 'w', 1) as stream, pytest.MonkeyPatch.context() as patched:
        patched.setattr(sys, name, stream)
        yield
