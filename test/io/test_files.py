"""Files are written whole, and never over what is not a file."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from fisheye_svp_ros.detect.photographs import find_photographs, is_photographs
from fisheye_svp_ros.errors import OutputError
from fisheye_svp_ros.io.files import replacing, write_text


@pytest.mark.parametrize('make', [os.mkfifo, Path.mkdir])
def test_what_is_no_regular_file_is_not_replaced(
    make: Callable[[Path], None], tmp_path: Path
) -> None:
    make(tmp_path / 'there')
    with pytest.raises(OutputError, match='not a regular file'):
        write_text(tmp_path / 'there', 'text')
    assert not (tmp_path / 'there').is_file()
    with pytest.raises(OutputError, match='/dev/null: it exists and is not a regular file'):
        write_text('/dev/null', 'text')
    assert Path('/dev/null').is_char_device()


def test_a_block_that_fails_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / 'a'
    write_text(path, 'old')
    with pytest.raises(ZeroDivisionError), replacing(path) as temporary:
        temporary.write_text('new')
        raise ZeroDivisionError
    assert path.read_text() == 'old' and list(tmp_path.iterdir()) == [path]


_KILLED = """
import os, signal, sys
from fisheye_svp_ros.io.files import replacing
with replacing(sys.argv[1]) as temporary:
    temporary.write_text('half')
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_what_a_killed_command_has_left_goes_with_the_next_one(tmp_path: Path) -> None:
    killed = subprocess.run([sys.executable, '-c', _KILLED, tmp_path / '000.png'], check=False)
    assert killed.returncode == -signal.SIGKILL
    others = ['.hidden.png', '.000.png.here-1.abcdefgh.png']  # of a user, of another machine
    for name in others:
        (tmp_path / name).write_text('')
    left = {path.name for path in tmp_path.iterdir()}
    assert len(left) == 3
    with replacing(tmp_path / '001.png') as mine:  # of a process that runs
        write_text(tmp_path / 'new', 'text')
        assert {path.name for path in tmp_path.iterdir()} == {*others, 'new', mine.name}


def test_hidden_files_are_no_photographs(tmp_path: Path) -> None:
    (tmp_path / '.git').mkdir()
    for name in ('.000.png.x-1.abcdefgh.png', '._001.jpg', '.git/a.png'):
        (tmp_path / name).write_text('')
    assert not is_photographs(tmp_path)
    write_text(tmp_path / '000.png', '')
    assert [one.name for one in find_photographs([str(tmp_path)])] == [str(tmp_path / '000.png')]
