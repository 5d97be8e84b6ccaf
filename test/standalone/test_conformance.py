"""One node, run through the standalone client and through rclpy: the transcripts are the same."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.nodes import GENUINE, Caller, GenuineCaller, NodeProcess

pytest.importorskip('cyclonedds')
pytest.importorskip('rosbags')

NODE = Path(__file__).with_name('conformance_node.py')
CONFIG = """
/**:
  ros__parameters:
    rate: 4.0
    lens: {f: 300.0, model: {name: equisolid}}
/rig/left/probe:
  ros__parameters:
    ids: [7, 8]
    words: ['1', "true"]
somebody_else:
  ros__parameters:
    name: wrong
"""


def _transcript(
    run: Callable[..., NodeProcess], caller: Caller | GenuineCaller, genuine: bool, config: Path
) -> str:
    node = run(
        NODE, '--ros-args', '--params-file', str(config), '-p', 'name:=sole', '-p', 'any:=1e-3',
        '-p', 'mistyped:=7', '-r', '__ns:=/rig/left', '-r', '__node:=probe',
        '-r', 'values:=/numbers', '-r', '~/cloud:=points', '--log-level', 'info', genuine=genuine,
    )  # fmt: skip
    node.wait_for('^ready')
    response = caller.call('std_srvs/srv/Trigger', '/rig/left/probe/finish')
    assert (response.success, response.message) == (True, 'eye')
    assert node.finish() == 0
    return '\n'.join(re.sub(r'\[\d+\.\d+\]', '[stamp]', line) for line in node.lines)


def test_standalone_transcript(
    run_node: Callable[..., NodeProcess], caller: Caller, tmp_path: Path
) -> None:
    config = tmp_path / 'config.yaml'
    config.write_text(CONFIG)
    text = _transcript(run_node, caller, False, config)
    for line in (
        'node probe /rig/left /rig/left/probe',
        'parameter rate Type.DOUBLE 4.0',
        'parameter words Type.STRING_ARRAY [\'1\', \'true\']',
        'parameter any Type.DOUBLE 0.001',
        'parameter name Type.STRING sole',
        'topics /numbers /rig/left/points /numbers /absolute/pose',
        'set name  False a name is needed sole',
        '[INFO] [stamp] [rig.left.probe]: ticked',
    ):
        assert line in text.splitlines()
    # A late subscriber receives as much of the past as the history is deep.
    assert re.findall('^value (.*)$', text, re.M) == ['2.0', '3.0']


@pytest.mark.skipif(not GENUINE, reason='ROS 2 is not installed here')
def test_rclpy_gives_the_same_transcript(
    run_node: Callable[..., NodeProcess],
    caller: Caller,
    node_caller: GenuineCaller,
    tmp_path: Path,
) -> None:
    config = tmp_path / 'config.yaml'
    config.write_text(CONFIG)
    # Genuine first: it may take Fast DDS ten seconds to see that a node of Cyclone DDS is gone.
    genuine = _transcript(run_node, node_caller, True, config)
    assert genuine == _transcript(run_node, caller, False, config)
