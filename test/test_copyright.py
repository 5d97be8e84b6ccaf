"""ament_copyright, where ROS 2 is installed."""

from __future__ import annotations

import pytest


@pytest.mark.skip(reason='files carry no header: LICENSE, in the root folder, holds for all')
@pytest.mark.copyright
@pytest.mark.linter
def test_copyright() -> None:
    from ament_copyright.main import main

    assert main(argv=['.', 'test']) == 0
