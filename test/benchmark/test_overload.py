"""Sets that come faster than they are solved, between processes."""

from __future__ import annotations

import subprocess
import sys

import pytest
from helpers.nodes import ROOT, need_ros

need_ros()


@pytest.mark.slow
def test_at_any_rate_every_set_taken_has_one_result_or_is_counted(ros_domain: int) -> None:
    command = [sys.executable, '-m', 'benchmark.speed.overload', '--seconds', '0.4']
    told = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    rows = [line.strip('| ').split(' | ') for line in told.stdout.splitlines()[2:]]
    assert [row[0] for row in rows] == ['10', '30', '100', '300', '1000'], told
    assert all(row[-1] == 'yes' for row in rows), told.stdout
