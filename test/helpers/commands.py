"""Commands run in this process."""

from __future__ import annotations

import pytest

from fisheye_svp_ros import cli


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Return the one line with which a command refuses what it is given, exit status 2."""
    capsys.readouterr()
    assert cli.main([str(argument) for argument in arguments]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1
    return said[0]
