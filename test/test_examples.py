"""The example scripts and notebooks run; the notebooks print what is stored in them."""

from __future__ import annotations

import contextlib
import io
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import matplotlib as mpl
import matplotlib.pyplot as plt
import pytest
from helpers.data import DATA, NO_DATA
from helpers.nodes import ROOT, TIMEOUT, NodeProcess

EXAMPLES = ROOT / 'examples'
# By script, a line of its output and the files that it writes.
SCRIPTS = {
    'svp_error_by_range': ('range [m]', ['svp_error_by_range.png']),
    'diagnose_observations': ('viewpoint_shift: p = ', ['extended.yaml']),
    'stereo_depth_error': ('full lens: baseline 150.0', []),
}
ROBOT = 'where_is_my_robot'
NODE_SCRIPTS = {'publish_image_points', 'compose_nodes', 'localizer_launch_test'}
NOTEBOOKS = ('viewpoint_shift', 'diagnosis', 'paper_result', 'real_data')


def test_every_example_is_tested() -> None:
    assert {path.stem for path in EXAMPLES.glob('*.py')} == {*SCRIPTS, ROBOT, *NODE_SCRIPTS}
    assert {path.stem for path in EXAMPLES.glob('*.ipynb')} == {*NOTEBOOKS}


@pytest.mark.parametrize('name', SCRIPTS)
def test_a_script_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv('PYTHONPATH', str(ROOT), prepend=':')
    monkeypatch.setenv('MPLBACKEND', 'agg')
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / f'{name}.py')],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    line, files = SCRIPTS[name]
    assert done.returncode == 0, done.stderr
    assert line in done.stdout
    assert sorted(path.name for path in tmp_path.iterdir()) == files


@pytest.mark.skipif(not hasattr(cv2, 'aruco'), reason='this OpenCV has no markers')
def test_a_robot_knows_how_wrong_its_map_and_poses_are(tmp_path: Path) -> None:
    environment = os.environ | {'PYTHONPATH': str(ROOT), 'MPLBACKEND': 'agg'}
    script, python = str(EXAMPLES / f'{ROBOT}.py'), [sys.executable]
    board = ['--board', 'tags:36h11:300mm', '--lens', 'robot/lens.yaml', '--origin', '0']
    mapping = ['-m', 'fisheye_svp_ros.cli', 'map', 'robot/walk', *board, '-o', 'robot/tags.yaml']
    for command in ([script], mapping, [script, '--map', 'robot/tags.yaml']):
        subprocess.run([*python, *command], cwd=tmp_path, env=environment, check=True)
    figures = json.loads((tmp_path / 'robot' / 'figures.json').read_text())
    assert figures['tags_mapped'] == 12
    assert figures['map_error_mm'] < 2 * figures['map_stderr_mm'] < 40
    assert 2 < figures['base_nees_of_6'] < 12


def test_poses_come_for_published_points(
    start_process: Callable[..., NodeProcess], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip('rclpy', reason='needs ROS 2 (rclpy)')
    monkeypatch.setenv('PYTHONPATH', str(ROOT), prepend=':')
    localizer = start_process(
        [
            sys.executable,
            '-m',
            'fisheye_svp_ros.cli',
            'run',
            'localizer',
            '--ros-args',
            '-p',
            'lens:=fish214',
        ],
        {**os.environ},
    )
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / 'publish_image_points.py')],
        capture_output=True,
        text=True,
        timeout=TIMEOUT,
    )
    assert done.returncode == 0, (done.stderr, localizer.lines)
    poses = [line for line in done.stdout.splitlines() if line.startswith('x = ')]
    assert len(poses) == 10


def test_nodes_are_composed(ros_domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip('rclpy', reason='needs ROS 2 (rclpy)')
    monkeypatch.setenv('PYTHONPATH', str(ROOT), prepend=':')
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / 'compose_nodes.py')],
        capture_output=True,
        text=True,
        timeout=TIMEOUT,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == 5 * [done.stdout.splitlines()[0]]
    assert done.stdout.startswith('x -0.0') or done.stdout.startswith('x 0.0')


@pytest.mark.parametrize('name', NOTEBOOKS)
def test_a_notebook_prints_what_it_shows(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if name == 'real_data' and not (DATA / 'ov_plane').exists():
        pytest.skip(NO_DATA)
    monkeypatch.setenv('FISHEYE_SVP_DATA', str(DATA))
    monkeypatch.chdir(tmp_path)
    notebook = json.loads((EXAMPLES / f'{name}.ipynb').read_text(encoding='utf-8'))
    names: dict[str, Any] = {}
    with mpl.rc_context({'backend': 'agg'}):
        for cell in notebook['cells']:
            if cell['cell_type'] != 'code':
                continue
            printed = io.StringIO()
            with contextlib.redirect_stdout(printed):
                exec(''.join(cell['source']), names)
            plt.close('all')
            assert printed.getvalue() == ''.join(
                ''.join(output['text'])
                for output in cell['outputs']
                if output['output_type'] == 'stream'
            )
