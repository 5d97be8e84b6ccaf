"""How executables start, refuse and end, as `ros2 run` and launch see it."""

from __future__ import annotations

import ctypes
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext
from pathlib import Path

import pytest
from helpers import graph  # noqa: F401 - skips where there is no rclpy
from helpers.nodes import ROOT, NodeProcess

from fisheye_svp_ros import __version__
from fisheye_svp_ros.nodes import NODES, base, executables, running
from fisheye_svp_ros.nodes.session import SignalHandler

_CODE = """
import sys
from fisheye_svp_ros import cli
try:
    print('loading', flush=True)
    sys.exit(cli.main(['run', *sys.argv[1:]]))
except KeyboardInterrupt:  # before or after the command itself
    sys.exit(130)
"""


@pytest.fixture
def start(
    ros_domain: int, start_process: Callable[..., NodeProcess]
) -> Callable[..., NodeProcess]:
    """Return a function that starts a node as its executable does."""

    def run(node: str, *arguments: str) -> NodeProcess:
        path = os.pathsep.join([str(ROOT), os.environ.get('PYTHONPATH', '')])
        env = os.environ | {
            'ROS_DOMAIN_ID': str(ros_domain),
            'PYTHONPATH': path,
            'FISHEYE_SVP_ENGINE': 'numpy',
        }
        return start_process([sys.executable, '-c', _CODE, node, *arguments], env)

    return run


UNUSABLE = [
    ['--params-file', 'nosuch.yaml'],
    ['--params-file', 'BROKEN'],
    ['-r', 'foo'],
    ['-p', 'svp'],
    ['-r', '__node:=9x'],
    ['--nosuch'],
    ['-p', 'lens:=nothere'],
    ['-p', 'lens:=[]'],
    ['-p', 'patience:=-1.0'],
    ['-p', 'qos_overrides./image_points.subscription.reliability:=sometimes'],
]


def assert_refused(arguments: list[str], status: int, lines: list[str]) -> None:
    assert status == 2
    told = [line for line in lines if line.startswith('localizer: ')]
    assert len(told) == 1 and len(told[0]) > 20, lines
    assert arguments != ['--nosuch'] or 'ROS arguments' in told[0]  # rclpy: a bare list
    assert ('a list must' in told[0]) == (arguments == ['-p', 'lens:=[]'])
    assert 'Traceback' not in '\n'.join(lines)


@pytest.mark.usefixtures('handler_kept')
@pytest.mark.parametrize('arguments', UNUSABLE)
def test_arguments_that_cannot_be_used_end_a_node_with_the_reason(
    arguments: list[str], ros_domain: int, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    broken = tmp_path / 'broken.yaml'
    broken.write_text('/**:\n  ros__parameters: {lens: [fish214\n')
    given = [str(broken) if word == 'BROKEN' else word for word in arguments]
    status = executables.run('localizer', args=['--ros-args', *given])
    assert_refused(arguments, status, capfd.readouterr().err.splitlines())


@pytest.mark.parametrize('arguments', [['--nosuch'], ['-p', 'patience:=-1.0']])
def test_a_process_that_cannot_use_its_arguments_ends_with_the_reason(
    start,
    arguments: list[str],  # type: ignore[no-untyped-def]
) -> None:
    node = start('localizer', '--ros-args', *arguments)
    assert_refused(arguments, node.finish(), node.lines)


@pytest.mark.parametrize(
    ('words', 'status', 'said'),
    [
        (['--help'], 0, 'localizer: parameters, as in --ros-args -p NAME:=VALUE'),
        (['--version'], 0, f'localizer {__version__}'),
        (
            ['-p', 'lens:=fish180'],
            2,
            "localizer: '-p' comes before --ros-args; ROS arguments follow",
        ),
    ],
)
def test_an_executable_overlooks_no_argument(
    words: list[str],
    status: int,
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, 'argv', ['localizer', *words])
    monkeypatch.setattr(executables, 'run', lambda *_: pytest.fail('it runs'))
    assert executables.localizer() == status
    assert said in ''.join(capsys.readouterr())


def test_security_that_cannot_be_had_ends_a_node_with_the_reason(
    start,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,  # type: ignore[no-untyped-def]
) -> None:
    (tmp_path / 'enclaves' / 'localizer').mkdir(parents=True)  # without a key
    for name, value in (('ENABLE', 'true'), ('STRATEGY', 'Enforce'), ('KEYSTORE', str(tmp_path))):
        monkeypatch.setenv(f'ROS_SECURITY_{name}', value)
    node = start('localizer', '--ros-args', '--enclave', '/localizer')
    assert node.finish() == 2
    assert any(re.match('localizer: ROS 2: .*(security|permission)', line) for line in node.lines)
    assert 'Traceback' not in '\n'.join(node.lines)


def test_help_tells_the_parameters_of_a_node(capsys: pytest.CaptureFixture[str]) -> None:
    from fisheye_svp_ros import cli

    for words in (['--help'], ['--ros-args', '--help']):
        assert cli.main(['run', 'stereo_depth', *words]) == 0
        told = capsys.readouterr().out
        for row in executables.parameters('stereo_depth'):
            assert f'  {row.name} ' in told


def test_ros_arguments_without_ros_args_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    from fisheye_svp_ros import cli

    assert cli.main(['run', 'localizer', '-p', 'svp:=true']) == 2
    assert "'-p' comes before --ros-args" in capsys.readouterr().err


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize('after', [0.0, 0.4, 0.8, 1.2])
def test_a_signal_while_a_node_starts_ends_it_quietly(
    start,
    number: signal.Signals,
    after: float,  # type: ignore[no-untyped-def]
) -> None:
    node = start('localizer', '--ros-args', '-p', 'lens:=fish214')
    node.wait_for('loading')
    time.sleep(after)
    status = node.finish(number)
    assert 'Traceback' not in '\n'.join(node.lines), node.lines
    assert status in (0, 130, -number)


def printed_by(code: str, environment: Mapping[str, str] = os.environ) -> str:
    """Return what Python code prints in a process of its own."""
    return subprocess.run(
        [sys.executable, '-c', code],
        capture_output=True,
        text=True,
        check=True,
        env={**environment, 'PYTHONPATH': str(ROOT)},
    ).stdout


def test_hardly_anything_is_loaded_before_signals_end_a_node_quietly() -> None:
    code = (
        'import sys; before = {*sys.modules}; import fisheye_svp_ros.nodes.executables; '
        "print(*sorted(name for name in {*sys.modules} - before if 'fisheye' in name))"
    )
    assert printed_by(code).split() == [
        'fisheye_svp_ros',
        'fisheye_svp_ros.io',
        'fisheye_svp_ros.io.streams',
        'fisheye_svp_ros.nodes',
        'fisheye_svp_ros.nodes.executables',
        'fisheye_svp_ros.process',
    ]


def test_a_node_that_diagnoses_starts_without_what_only_a_diagnosis_needs() -> None:
    """A quarter of a second of imports that no start waits for."""
    code = (
        'import sys; import fisheye_svp_ros.nodes.model_critic; '
        "print(*{'scipy.special', 'scipy.linalg', 'rich', 'jinja2', 'matplotlib', 'pandas'} "
        '& {*sys.modules})'
    )
    assert not printed_by(code).split()


@pytest.mark.parametrize('node', ['localizer', 'stereo_depth', 'rectifier', 'synthetic_camera'])
def test_a_node_that_only_solves_starts_without_what_adjusts(node: str) -> None:
    code = (
        f'import sys; import fisheye_svp_ros.nodes.{node}; '
        "print(*{'scipy', 'fisheye_svp_ros.solve.bundle_adjustment'} & {*sys.modules})"
    )
    assert not printed_by(code).split()


@pytest.mark.parametrize(('given', 'taken'), [({}, '1'), ({'OMP_NUM_THREADS': '3'}, '3')])
def test_a_node_computes_on_one_core_unless_told_otherwise(
    given: dict[str, str], taken: str
) -> None:
    code = (
        'import os, sys; import fisheye_svp_ros.nodes.executables; '
        "assert 'numpy' not in sys.modules; print(os.environ['OMP_NUM_THREADS'])"
    )
    env = {name: value for name, value in os.environ.items() if name != 'OMP_NUM_THREADS'}
    assert printed_by(code, env | given).strip() == taken


@pytest.mark.parametrize('name', NODES)
def test_a_signal_while_a_node_is_being_built_ends_it_quietly(
    name: str, ros_domain: int, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(base.BaseNode, 'announce', interrupt)
    monkeypatch.setattr(signal, 'signal', lambda *_: None)
    assert executables.run(name, args=[]) == 0
    assert capfd.readouterr().err == ''


@pytest.fixture
def handler_kept() -> Iterator[None]:
    """Give SIGINT back the handler that a node replaces."""
    before = signal.getsignal(signal.SIGINT)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_building_of_a_node_there_and_then(
    ros_domain: int,
    number: signal.Signals,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    handler_kept: None,
) -> None:
    """What rclpy does on SIGTERM, to end the context, makes the rest of the start fail."""

    def signaled(*_: object, **__: object) -> None:
        os.kill(os.getpid(), number)
        went_on.append(True)

    went_on: list[bool] = []
    monkeypatch.setattr(base.BaseNode, 'announce', signaled)
    assert executables.run('localizer', args=[]) == 0
    assert not went_on and capfd.readouterr().err == ''
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


def test_a_signal_before_there_is_a_node_or_that_c_code_dropped_ends_it(
    ros_domain: int,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    handler_kept: None,
) -> None:
    def drop(*_: object, **__: object) -> None:
        signals._raises = False  # as C code does that drops what its callbacks raise
        os.kill(os.getpid(), signal.SIGTERM)

    def signaled(**given: object) -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        init(**given)

    init = running.rclpy.init
    monkeypatch.setattr(running.rclpy, 'init', signaled)
    monkeypatch.setattr(base.BaseNode, 'announce', lambda *_, **__: pytest.fail('it goes on'))
    assert executables.run('localizer', args=[]) == 0
    monkeypatch.undo()
    monkeypatch.setenv('ROS_DOMAIN_ID', str(ros_domain))
    signals = SignalHandler()
    monkeypatch.setattr(running, 'SignalHandler', lambda: signals)
    monkeypatch.setattr(base.BaseNode, 'introduce', drop)
    assert executables.run('synthetic_camera', args=[]) == 0
    assert 'Traceback' not in capfd.readouterr().err


@pytest.mark.usefixtures('handler_kept')
@pytest.mark.filterwarnings('error::pytest.PytestUnraisableExceptionWarning')
def test_a_second_interrupt_does_not_disturb_what_the_first_one_ends(
    ros_domain: int, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    class Held:
        def __del__(self) -> None:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.01)

    def interrupt(*_: object, **__: object) -> None:
        held = Held()  # until the exception is dealt with
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(1.0)
        raise AssertionError(held)

    monkeypatch.setattr(base.BaseNode, 'announce', interrupt)
    assert executables.run('localizer', args=[]) == 0
    assert capfd.readouterr().err == ''


@pytest.mark.usefixtures('handler_kept')
@pytest.mark.filterwarnings('ignore::pytest.PytestUnraisableExceptionWarning')
def test_an_interrupt_that_was_lost_can_be_repeated(
    ros_domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt() -> None:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.1)

    def lose(*_: object, **__: object) -> None:
        ctypes.CFUNCTYPE(None)(interrupt)()  # C code that drops what its callbacks raise
        time.sleep(1.1)
        interrupt()
        went_on.append(True)

    went_on: list[bool] = []
    monkeypatch.setattr(base.BaseNode, 'announce', lose)
    assert executables.run('localizer', args=[]) == 0
    assert not went_on


@pytest.mark.parametrize('ended', [True, False])
def test_what_fails_once_a_signal_has_ended_the_context_is_no_failure(
    ended: bool, ros_domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        if ended:
            running.rclpy.shutdown()
        raise RuntimeError('the context is not valid')

    monkeypatch.setattr(base.BaseNode, 'announce', fail)
    monkeypatch.setattr(signal, 'signal', lambda *_: None)
    with nullcontext() if ended else pytest.raises(RuntimeError):
        assert executables.run('localizer', args=[]) == 0
