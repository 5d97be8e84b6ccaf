"""ament_flake8, where ROS 2 is installed."""

from __future__ import annotations

from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent


@pytest.mark.flake8
@pytest.mark.linter
def test_flake8() -> None:
    ament_flake8 = pytest.importorskip('ament_flake8.main')
    code, errors = ament_flake8.main_with_errors(
        argv=['--config', str(HERE / 'ament.ini'), str(HERE.parent)]
    )
    assert code == 0, '\n'.join(errors)
