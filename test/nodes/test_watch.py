"""The live view of running nodes."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from helpers import graph  # noqa: F401 - skips where there is no rclpy
from helpers.nodes import ROOT, TIMEOUT, hears_sigint
from rich.console import Console

from fisheye_svp_ros.commands import watch


@pytest.mark.parametrize(('width', 'shown'), [
    (24, 'a terminal 64 columns wide is needed; this one has 24'),
    (64, '-0.0123457 -0.0123457 0.0123457')])
def test_a_terminal_that_is_too_narrow_is_told_so(width: int, shown: str) -> None:
    from fisheye_svp_ros.nodes.watcher import MetricHistory, Results

    results = Results(sets=3, lost=1, note='few', metrics={'position_error_x_m': MetricHistory()})
    results.metrics['position_error_x_m'].add(-1.23456789e-5)
    watcher = SimpleNamespace(results={'/here/localizer': results})
    out = Console(width=width, file=io.StringIO(), record=True)
    out.print(watch._result_table(cast('Any', watcher), width))
    assert shown in ' '.join(out.export_text().split())


def test_results_are_shown_with_their_metrics(ros_domain: int, tmp_path: Path) -> None:
    env = os.environ | {'PYTHONPATH': os.pathsep.join(
        [str(ROOT), *filter(None, [os.environ.get('PYTHONPATH')])])}
    processes = []

    def start(*arguments: str) -> subprocess.Popen[str]:
        processes.append(subprocess.Popen(
            [sys.executable, '-m', 'fisheye_svp_ros.cli', *arguments], env=env, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, preexec_fn=hears_sigint))
        return processes[-1]

    few = tmp_path / 'few.csv'
    few.write_text('landmark,x,y,z\n1,0,0,-1\n2,1,0,-1\n3,0,1,-1\n')
    try:
        start('run', 'localizer', '--ros-args', '-r', '__ns:=/here', '-p',
              'wait_for_subscribers:=2')
        shown = start('watch')
        camera = start(
            'run', 'synthetic_camera', '--ros-args', '-r', '__ns:=/here', '-p',
            f'sweep.environment:=[whole, {few}]', '-p', 'wait_for_subscribers:=1', '-p',
            'repeat:=false', '-p', 'lock_step:=localizer/result')
        assert camera.wait(TIMEOUT) == 0
        time.sleep(0.5)
        shown.send_signal(signal.SIGINT)
        text, _ = shown.communicate(timeout=TIMEOUT)
    finally:
        for process in processes:
            process.kill()
            process.wait()
    assert shown.returncode == 0, text
    assert '/here/localizer' in text and '2 sets, 1 not solved' in text
    assert 'position_error_m' in text
