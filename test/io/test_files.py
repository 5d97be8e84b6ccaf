"""Files are written whole, and never over what is not a file."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

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
