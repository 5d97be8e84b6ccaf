"""Several nodes in one process: of a program of one's own, and of `fisheye-svp run`."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from helpers.nodes import ROOT, NodeProcess, need_ros, until

need_ros()

from rclpy.context import Context  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402  # isort: skip

from fisheye_svp_ros.cli import main  # noqa: E402
from fisheye_svp_ros.io.decoding import read_key_values  # noqa: E402
from fisheye_svp_ros.io.rig_files import save_rig  # noqa: E402
from fisheye_svp_ros.nodes import NODES, executables  # noqa: E402
from fisheye_svp_ros.nodes.localizer import Localizer  # noqa: E402
from fisheye_svp_ros.nodes.synthetic_camera import SyntheticCamera  # noqa: E402
from fisheye_svp_ros.scene.rigs import rig  # noqa: E402


@pytest.fixture
def context(ros_domain: int) -> Iterator[Context]:
    """Return a context of its own, as a program has that embeds nodes."""
    one = Context()
    one.init(args=[], domain_id=ros_domain)
    yield one
    one.try_shutdown()


def hear_results(node: Node, topic: str) -> list[Any]:
    heard: list[Any] = []
    node.create_subscription(DiagnosticArray, topic, heard.append, 10)
    return heard


def test_nodes_are_composed_as_rclpy_nodes_are(context: Context) -> None:
    """Two cameras, each with its localizer, in one executor, with values of their own."""
    executor = SingleThreadedExecutor(context=context)
    nodes: list[Node] = [Node('listener', context=context)]
    results = [hear_results(nodes[0], f'/{name}/finder/result') for name in ('front', 'rear')]
    for name, radius in (('front', 2.0), ('rear', 0.5)):
        nodes += [
            SyntheticCamera(
                namespace=name,
                context=context,
                parameter_overrides=[
                    Parameter('radius', value=radius),
                    Parameter('rate', value=50),
                ],
            ),
            Localizer(
                'finder',
                namespace=name,
                context=context,
                parameter_overrides=[Parameter('lens', value='fish214')],
            ),
        ]
    for node in nodes:
        executor.add_node(node)
    assert [node.get_fully_qualified_name() for node in nodes[1:]] == [
        '/front/synthetic_camera',
        '/front/finder',
        '/rear/synthetic_camera',
        '/rear/finder',
    ]
    assert nodes[1].settings.radius == 2.0 and nodes[3].settings.radius == 0.5
    until(lambda: executor.spin_once(0.02) or all(results))
    assert all(float(read_key_values(one[0])['position_error_m']) < 1e-6 for one in results)
    for node in nodes:
        node.destroy_node()
    executor.shutdown()


@pytest.mark.parametrize('name', NODES)
def test_every_node_takes_what_rclpy_nodes_take(
    name: str, context: Context, tmp_path: Any
) -> None:
    kind = executables._node_class(name)
    table = tmp_path / 'seen.csv'
    table.write_text(
        'frame,landmark,u,v,x,y,z\n'
        + ''.join(f'0,{i},{10 * i},{5 * i},0,{i},1\n' for i in range(5))
    )
    given = {'wait_for_subscribers': 3}
    given |= {'observations': str(table)} if name == 'measured_camera' else {}
    if name == 'rig_localizer':
        save_rig(rig('parallel'), tmp_path / 'rig.yaml')
        given |= {'rig': str(tmp_path / 'rig.yaml')}
    node = kind(
        'mine',
        namespace='robot',
        context=context,
        parameter_overrides=[Parameter(key, value=value) for key, value in given.items()],
    )
    assert node.get_fully_qualified_name() == '/robot/mine'
    assert node.settings.wait_for_subscribers == 3
    node.destroy_node()


def test_one_process_runs_several(
    ros_domain: int, start_process: Callable[..., NodeProcess], context: Context, tmp_path: Any
) -> None:
    params = tmp_path / 'params.yaml'
    params.write_text(
        '/robot/localizer: {ros__parameters: {lens: fish214}}\n'
        '/robot/synthetic_camera: {ros__parameters: {radius: 0.5, rate: 50}}\n'
    )
    path = os.pathsep.join([str(ROOT), os.environ.get('PYTHONPATH', '')])
    process = start_process(
        [
            sys.executable,
            '-m',
            'fisheye_svp_ros.cli',
            'run',
            'synthetic_camera',
            'localizer',
            '--ros-args',
            '-r',
            '__ns:=/robot',
            '--params-file',
            str(params),
        ],
        os.environ | {'PYTHONPATH': path},
    )
    listener, executor = Node('listener', context=context), SingleThreadedExecutor(context=context)
    executor.add_node(listener)
    results = hear_results(listener, '/robot/localizer/result')
    until(lambda: executor.spin_once(0.02) or results)
    assert float(read_key_values(results[0])['position_error_m']) < 1e-6
    assert process.finish(signal.SIGINT) == 0
    assert 'Traceback' not in '\n'.join(process.lines)
    listener.destroy_node()
    executor.shutdown()


def test_what_cannot_be_used_names_its_node(
    ros_domain: int, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(signal, 'signal', lambda *_: None)
    words = ['--ros-args', '-p', 'measured_camera:observations:=nothere.csv']
    assert executables.run('localizer', 'measured_camera', args=words) == 2
    assert capfd.readouterr().err.splitlines()[-1].startswith('measured_camera: nothere.csv')


def test_a_node_that_stands_there_twice_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['run', 'localizer', 'localizer']) == 2
    assert 'a node is listed twice' in capsys.readouterr().err
