"""Processes that work on items end with the one that waits for them."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

_PROGRAM = """
import time
from fisheye_svp_ros.detect.workers import bounded_map
for _ in bounded_map(time.sleep, [0.0, 300.0], 600.0):
    print('one', flush=True)
"""


def test_no_worker_outlives_a_killed_parent() -> None:
    """A search without anybody to bound it in time may take forever."""
    with subprocess.Popen([sys.executable, '-c', _PROGRAM], stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None and parent.stdout.readline() == b'one\n'
        children = Path(f'/proc/{parent.pid}/task/{parent.pid}/children')
        workers = [Path('/proc', pid) for pid in children.read_text().split()]
        parent.kill()
    assert workers
    until = time.monotonic() + 120
    while any(worker.exists() for worker in workers) and time.monotonic() < until:
        time.sleep(0.2)
    assert not [worker for worker in workers if worker.exists()]
