"""ament_pep257, where ROS 2 is installed."""

from __future__ import annotations

from pathlib import Path

import pytest

# Beyond ament's own: where a docstring's first line stands and how it is worded.
IGNORED = ['D213', 'D401', 'D402', 'D415']


@pytest.mark.pep257
@pytest.mark.linter
def test_pep257() -> None:
    ament_pep257 = pytest.importorskip('ament_pep257.main')
    root = str(Path(__file__).resolve().parent.parent)
    assert ament_pep257.main(argv=[root, '--add-ignore', *IGNORED]) == 0
