"""Processes that a command starts, and files that it may replace."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.nodes import need_ros, until

from fisheye_svp_ros.cli import main
from fisheye_svp_ros.commands.node_sweeps import lens_folder, read_sweep
from fisheye_svp_ros.io.lens_files import load_lens, save_lens
from fisheye_svp_ros.io.share import lens_path

psutil = pytest.importorskip('psutil')

_PARENT = """
import sys, time
from pathlib import Path
from fisheye_svp_ros.commands import processes
sys.executable = sys.argv[1]  # a program that waits, whatever its arguments
with processes.Processes(Path(sys.argv[2])) as started:
    for name in ('one', 'other'):
        started.start(name, ['x'])
    print(*(p.pid for p in started._running.values()), flush=True)
    time.sleep(600)
"""


@pytest.mark.parametrize('number', [signal.SIGTERM, signal.SIGKILL])
def test_children_end_with_their_parent(tmp_path: Path, number: signal.Signals) -> None:
    waits = tmp_path / 'waits'
    waits.write_text('#!/bin/sh\nexec sleep 600\n')
    waits.chmod(0o755)
    parent = subprocess.Popen(
        [sys.executable, '-c', _PARENT, str(waits), str(tmp_path)],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert parent.stdout
    children = [int(word) for word in parent.stdout.readline().split()]
    assert len(children) == 2 and all(map(psutil.pid_exists, children))
    parent.send_signal(number)
    parent.wait()
    until(lambda: not any(map(_runs, children)), 20)


def _runs(pid: int) -> bool:
    return psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE


def test_a_demo_deletes_only_what_a_demo_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    need_ros()
    (tmp_path / 'recording').mkdir()
    (tmp_path / 'recording' / 'mine.txt').write_text('precious')
    assert main(['demo', '-o', str(tmp_path)]) == 2
    assert 'is not from an earlier demo' in capsys.readouterr().err
    assert (tmp_path / 'recording' / 'mine.txt').read_text() == 'precious'


def test_the_lenses_of_a_sweep_have_a_folder(tmp_path: Path) -> None:
    for name in ('a', 'b'):
        save_lens(load_lens(lens_path('fish180')), tmp_path / name / 'lens.yaml')
    sweep = tmp_path / 'sweep.yaml'
    text = '/**: {{ros__parameters: {{sweep.lens: [{}]}}}}'
    sweep.write_text(text.format(f'{tmp_path}/a/lens.yaml, {tmp_path}/b/lens.yaml'))
    assert lens_folder(read_sweep(sweep)) == str(tmp_path)
    sweep.write_text(text.format('fish180, fish214'))
    assert lens_folder(read_sweep(sweep)) == ''
