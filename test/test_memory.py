"""Memory is kept between arrays where there is glibc."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

from fisheye_svp_ros.process import keep_memory

_FAULTS = """
import resource
import numpy as np
from fisheye_svp_ros.process import keep_memory
keep_memory()
np.ones(4_000_000)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
np.ones(4_000_000)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != 'glibc', reason='malloc of glibc')
def test_an_array_takes_the_pages_of_the_one_before() -> None:
    run = subprocess.run(
        [sys.executable, '-c', _FAULTS], capture_output=True, text=True, check=True
    )
    assert int(run.stdout) < 100  # of 7813


def test_other_systems_are_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr('sys.platform', 'win32')
    monkeypatch.setattr('ctypes.CDLL', None)
    keep_memory()
