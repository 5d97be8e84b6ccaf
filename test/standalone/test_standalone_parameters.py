"""Parameters from files and the command line, and the services behind `ros2 param`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from helpers.nodes import Caller, NodeProcess

pytest.importorskip('cyclonedds')
pytest.importorskip('rosbags')

from fisheye_svp_ros.standalone import arguments
from fisheye_svp_ros.standalone.exceptions import UnknownROSArgsError
from fisheye_svp_ros.standalone.messages import message_class

NODE = """
import sys
import rclpy
from rcl_interfaces.msg import (FloatingPointRange, IntegerRange, ParameterDescriptor,
                                SetParametersResult)
from rclpy.node import Node
rclpy.init()
node = Node('camera', automatically_declare_parameters_from_overrides='auto' in sys.argv)
near = ParameterDescriptor(description='m', floating_point_range=[
    FloatingPointRange(from_value=0.1, to_value=10.0)])
if 'auto' not in sys.argv:
    print('range', node.declare_parameter('range', 1.0, near).value, flush=True)
    print('lens', node.declare_parameter('lens.f', 400.0).value, flush=True)
    node.declare_parameter('ids', [1, 2])
def check(parameters):
    for parameter in parameters:
        if parameter.name == 'lens.f' and parameter.value <= 0:
            return SetParametersResult(successful=False, reason='lens.f must be positive')
    return SetParametersResult(successful=True)
node.add_on_set_parameters_callback(check)
print('sweep', sorted((n, p.value) for n, p in node.get_parameters_by_prefix('sweep').items()),
      flush=True)
print('ready', flush=True)
rclpy.spin(node)
"""


def _parameter(name: str, kind: str, value: Any) -> Any:
    types: Any = message_class('rcl_interfaces/msg/ParameterType')
    number = getattr(types, f'PARAMETER_{kind.upper()}')
    held = message_class('rcl_interfaces/msg/ParameterValue')(
        type=number, **{f'{kind}_value': value})
    return message_class('rcl_interfaces/msg/Parameter')(name=name, value=held)


def test_file_and_command_line(run_node: Callable[..., NodeProcess], tmp_path: Path) -> None:
    config = tmp_path / 'config.yaml'
    config.write_text("""
/**:
  ros__parameters: {range: 2.0, lens: {f: 100.0}}
left:
  camera:
    ros__parameters:
      lens.f: 200.0
/right/camera: {ros__parameters: {lens: {f: 300.0}}}
""")
    files = ('--ros-args', '--params-file', str(config))
    right = run_node(NODE, *files, '-r', '__ns:=/right', '-p', 'lens.f:=350.0')
    left = run_node(NODE, *files, '-r', '__ns:=/left', '-p', 'range:=3.0')
    assert right.wait_for('range (.*)')[1] == '2.0'
    # As in rcl: what a file says for one node outranks what -p says for all.
    assert right.wait_for('lens (.*)')[1] == '300.0'
    assert left.wait_for('range (.*)')[1] == '3.0'
    assert left.wait_for('lens (.*)')[1] == '200.0'


def test_parameters_that_only_the_file_knows(run_node: Callable[..., NodeProcess]) -> None:
    node = run_node(NODE, 'auto', '--ros-args', '-p', 'sweep.f:=[1.0, 2.0]', '-p', 'sweep.n:=3')
    assert node.wait_for('sweep (.*)')[1] == "[('f', [1.0, 2.0]), ('n', 3)]"


@pytest.mark.parametrize(
    ('given', 'message'),
    [
        ('range:=99.0', 'out of range Min: 0.1, Max: 10.0, value: 99.0'),
        ('range:=1', "of type 'INTEGER', expecting type 'DOUBLE'"),
        ('lens.f:=text', "of type 'STRING', expecting type 'DOUBLE'"),
    ],
)
def test_start_is_refused(
    run_node: Callable[..., NodeProcess], given: str, message: str
) -> None:
    node = run_node(NODE, '--ros-args', '-p', given)
    assert node.finish() == 1
    assert message in node.lines[-1]


def test_services(run_node: Callable[..., NodeProcess], caller: Caller) -> None:
    run_node(NODE).wait_for('ready')

    def call(name: str, **request: Any) -> Any:
        topic = ''.join(f'_{c.lower()}' if c.isupper() else c for c in name)[1:]
        return caller.call(f'rcl_interfaces/srv/{name}', f'/camera/{topic}', **request)

    listed = call('ListParameters').result
    assert set(listed.names) == {'use_sim_time', 'range', 'lens.f', 'ids'}
    assert listed.prefixes == ['lens']
    assert call('ListParameters', prefixes=['lens'], depth=1).result.names == ['lens.f']
    assert call('ListParameters', depth=1).result.names == ['use_sim_time', 'range', 'ids']

    values = call('GetParameters', names=['range', 'ids']).values
    assert (values[0].double_value, [*values[1].integer_array_value]) == (1.0, [1, 2])
    assert call('GetParameters', names=['range', 'unknown']).values == []
    assert [*call('GetParameterTypes', names=['range', 'ids']).types] == [3, 7]
    described = call('DescribeParameters', names=['range']).descriptors[0]
    assert (described.name, described.description) == ('range', 'm')
    assert described.floating_point_range[0].to_value == 10.0

    results = call('SetParameters', parameters=[
        _parameter('range', 'double', 2.5),
        _parameter('range', 'double', 0.0),
        _parameter('lens.f', 'double', -1.0),
        _parameter('lens.f', 'string', 'long'),
        _parameter('unknown', 'bool', True),
        _parameter('use_sim_time', 'bool', True),
        _parameter('ids', 'integer_array', [5]),
    ]).results  # fmt: skip
    assert [result.successful for result in results] == [True, *[False] * 5, True]
    for result, reason in zip(
        results[1:6],
        ('out of range', 'lens.f must be positive', 'Wrong parameter type', 'undeclared',
         'simulated time'),
        strict=True,
    ):  # fmt: skip
        assert reason in result.reason
    values = call('GetParameters', names=['range', 'lens.f', 'ids']).values
    assert [values[0].double_value, values[1].double_value] == [2.5, 400.0]
    assert [*values[2].integer_array_value] == [5]

    atomically = call('SetParametersAtomically', parameters=[
        _parameter('range', 'double', 9.0), _parameter('lens.f', 'double', 0.0),
    ]).result  # fmt: skip
    assert (atomically.successful, atomically.reason) == (False, 'lens.f must be positive')
    assert call('GetParameters', names=['range']).values[0].double_value == 2.5


@pytest.mark.parametrize(
    ('text', 'value'),
    [
        ('1', 1), ('-7', -7), ('0x1F', 31), ('010', 8), ('08', 8.0), ('1e-3', 0.001),
        ('1.', 1.0), ('.inf', float('inf')), ('-.inf', float('-inf')), ('on', True), ('N', False),
        ('"1"', '1'), ("'yes'", 'yes'), ('text', 'text'), ('[1, 2]', [1, 2]), ('[a, "1"]',
        ['a', '1']), ('1_000', '1_000'), ('99999999999999999999', 1e20), ('[true]', [True]),
    ],
)  # fmt: skip
def test_values_have_the_type_that_rcl_gives_them(text: str, value: object) -> None:
    parsed = arguments.parse(['--ros-args', '-p', f'x:={text}']).overrides('/node')['x']
    assert parsed == value
    assert type(parsed) is type(value)


@pytest.mark.parametrize(
    'words',
    [
        ['-p', 'x'], ['-p', 'x:='], ['-p', 'x:=[1, a]'], ['-p', 'x:={a: 1}'], ['-p'],
        ['--params-file', '/nowhere.yaml'], ['--log-level', 'loud'], ['--unknown'], ['-p', 'x:=['],
    ],
)  # fmt: skip
def test_bad_arguments_are_named(words: list[str]) -> None:
    with pytest.raises(UnknownROSArgsError, match=r'.'):
        arguments.parse(['node', '--ros-args', *words])


@pytest.mark.parametrize('text', ['- 1', '/**: 3', 'a: {ros__parameters: [1]}', '', 'a: [', ':'])
def test_bad_files_are_named(tmp_path: Path, text: str) -> None:
    file = tmp_path / 'bad.yaml'
    file.write_text(text)
    with pytest.raises(UnknownROSArgsError, match=r'bad\.yaml'):
        arguments.parse(['--ros-args', '--params-file', str(file)])


def test_only_ros_arguments_are_read() -> None:
    argv = ['prog', '-p', 'a:=1', '--ros-args', '-p', 'b:=2', '--', '-p', 'c:=3', '--ros-args',
            '-p', 'node:d:=4']  # fmt: skip
    parsed = arguments.parse(argv)
    assert parsed.overrides('/node') == {'b': 2, 'd': 4}
    assert parsed.overrides('/other') == {'b': 2}
