"""The live view of running nodes."""

from __future__ import annotations

import io
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from helpers import graph  # noqa: F401 - skips where there is no rclpy
from helpers.nodes import ROOT, NodeProcess
from rich.console import Console

from fisheye_svp_ros.commands import watch


@pytest.mark.parametrize(
    ('width', 'shown'),
    [
        (24, 'the terminal must be 64 columns wide; this one has 24'),
        (64, '-0.0001235 -0.0001235 0.0001235'),
    ],
)
def test_a_terminal_that_is_too_narrow_is_told_so(width: int, shown: str) -> None:
    from fisheye_svp_ros.nodes.watcher import MetricHistory, SolverResults

    results = SolverResults(
        sets=3, lost=1, note='few', metrics={'position_error_x_m': MetricHistory()}
    )
    results.metrics['position_error_x_m'].add(-1.23456789e-7)
    watcher = SimpleNamespace(results={'/here/localizer': results})
    out = Console(width=width, file=io.StringIO(), record=True)
    out.print(watch._result_table(cast('Any', watcher), width))
    assert shown in ' '.join(out.export_text().split())


def test_results_are_shown_with_their_metrics(
    start_process: Callable[..., NodeProcess], tmp_path: Path
) -> None:
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get('PYTHONPATH')])])
    env = os.environ | {'PYTHONPATH': path, 'FORCE_COLOR': '1', 'COLUMNS': '120'}

    def start(*arguments: str) -> NodeProcess:
        return start_process([sys.executable, '-m', 'fisheye_svp_ros.cli', *arguments], env)

    few = tmp_path / 'few.csv'
    few.write_text('landmark,x,y,z\n1,0,0,-1\n2,1,0,-1\n3,0,1,-1\n')
    start('run', 'localizer', '--ros-args', '-r', '__ns:=/here', '-p', 'wait_for_subscribers:=2')
    shown = start('watch')
    camera = start(
        'run',
        'synthetic_camera',
        '--ros-args',
        '-r',
        '__ns:=/here',
        '-p',
        f'sweep.environment:=[whole, {few}]',
        '-p',
        'wait_for_subscribers:=1',
        '-p',
        'repeat:=false',
        '-p',
        'lock_step:=localizer/result',
    )
    assert camera.finish() == 0
    shown.wait_for('2 sets, 1 not solved; the latest: ')
    assert shown.finish(signal.SIGINT) == 0
    text = '\n'.join(shown.lines)
    assert '/here/localizer' in text and 'position_error_m' in text
