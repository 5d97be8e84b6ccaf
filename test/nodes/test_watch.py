"""The live view of running nodes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from helpers.nodes import ROOT, TIMEOUT, hears_sigint

from fisheye_svp_ros import standalone

if not standalone.is_genuine():
    pytest.importorskip('cyclonedds')


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
        watch = start('watch')
        camera = start(
            'run', 'synthetic_camera', '--ros-args', '-r', '__ns:=/here', '-p',
            f'sweep.environment:=[whole, {few}]', '-p', 'wait_for_subscribers:=1', '-p',
            'repeat:=false', '-p', 'lock_step:=localizer/result')
        assert camera.wait(TIMEOUT) == 0
        time.sleep(0.5)
        watch.send_signal(signal.SIGINT)
        text, _ = watch.communicate(timeout=TIMEOUT)
    finally:
        for process in processes:
            process.kill()
            process.wait()
    assert watch.returncode == 0, text
    assert '/here/localizer' in text and '2 sets, 1 not solved' in text
    assert 'position_error_m' in text
