"""What the commands that are nodes do before they start, with ROS 2 and without it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.nodes import ROOT, need_ros

from fisheye_svp_ros.cli import main
from fisheye_svp_ros.commands import processes

SWEEP = 'synthetic_camera: {ros__parameters: {sweep.radius: [1.0, 2.0]}}'


@pytest.mark.parametrize(
    'words',
    [
        ['run', 'localizer'],
        ['run', 'localizer', '--help'],
        ['watch'],
        ['record', '-o', 'BAG'],
        ['record', '-o', 'BAG', '--sweep', 'FILE'],
    ],
)
def test_without_ros_a_command_says_the_ways_to_get_it(
    words: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / 'sweep.yaml').write_text(SWEEP)
    places = {'BAG': str(tmp_path / 'bag'), 'FILE': str(tmp_path / 'sweep.yaml')}
    monkeypatch.setitem(sys.modules, 'rclpy', None)
    assert main([places.get(word, word) for word in words]) == 2
    told = capsys.readouterr().err
    assert told.count('\n') == 1 and 'nodes need ROS 2' in told
    assert 'apt install ros-jazzy-ros-base' in told and 'the extra `ros`' in told
    assert [path.name for path in tmp_path.iterdir()] == ['sweep.yaml']


def test_a_ros_of_another_python_is_none(tmp_path: Path) -> None:
    (tmp_path / 'rclpy').mkdir()
    (tmp_path / 'rclpy' / '__init__.py').touch()
    (tmp_path / 'rclpy' / 'node.py').write_text(
        'raise ImportError("no C extension for this Python\\nPlease refer to ...")'
    )
    code = 'from fisheye_svp_ros.nodes import executables; print(executables.missing_rclpy())'
    env = os.environ | {'PYTHONPATH': f'{tmp_path}{os.pathsep}{ROOT}'}
    done = subprocess.run([sys.executable, '-c', code], env=env, capture_output=True, text=True)
    assert done.stdout == 'no C extension for this Python\n', done.stderr
    script = 'import sys; from fisheye_svp_ros.nodes.executables import localizer; localizer()'
    script = script.replace('localizer()', 'sys.exit(localizer())')
    done = subprocess.run([sys.executable, '-c', script], env=env, capture_output=True, text=True)
    assert done.returncode == 2 and done.stderr.count('\n') == 1
    assert 'localizer: nodes need ROS 2' in done.stderr and 'the extra `ros`' in done.stderr


def test_rclpy_without_the_messages_of_nodes_is_one_line(tmp_path: Path) -> None:
    need_ros()
    (tmp_path / 'visualization_msgs').mkdir()
    (tmp_path / 'visualization_msgs' / '__init__.py').write_text(
        "raise ModuleNotFoundError('No module named visualization_msgs')"
    )
    env = os.environ | {'PYTHONPATH': f'{tmp_path}{os.pathsep}{ROOT}'}
    script = 'import sys; from fisheye_svp_ros.nodes import executables as e; sys.exit(e.{}())'
    for command in (
        ['-c', script.format('localizer')],
        ['-m', 'fisheye_svp_ros.cli', 'run', 'localizer'],
    ):
        done = subprocess.run([sys.executable, *command], env=env, capture_output=True, text=True)
        assert done.returncode == 2 and done.stderr.count('\n') == 1
        assert 'nodes need ROS 2' in done.stderr and 'visualization_msgs' in done.stderr


@pytest.mark.parametrize(
    ('given', 'taken'),
    [
        ({}, 'LOCALHOST'),
        ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET'}, 'SUBNET'),
        ({'ROS_DISTRO': 'jazzy'}, None),
        ({'ROS_LOCALHOST_ONLY': '0'}, None),
        ({'ROS_STATIC_PEERS': '192.0.2.1'}, None),
    ],
)
def test_nodes_stay_on_this_machine_where_no_environment_says_otherwise(
    given: dict[str, str], taken: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    need_ros()
    monkeypatch.setattr(os, 'environ', dict(given))
    processes.prepare_ros()
    assert os.environ.get('ROS_AUTOMATIC_DISCOVERY_RANGE') == taken
