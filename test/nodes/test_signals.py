"""Commands that are nodes of their own end on a signal as nodes do."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from helpers import graph  # noqa: F401 - skips where there is no rclpy

from fisheye_svp_ros.cli import main
from fisheye_svp_ros.nodes.recorder import Recorder
from fisheye_svp_ros.nodes.session import SignalHandler
from fisheye_svp_ros.nodes.watcher import Watcher

SIGNALS = signal.SIGINT, signal.SIGTERM
RECORDED = 'no message arrived on a recorded topic, so nothing is kept'


@pytest.fixture(autouse=True)
def handlers() -> Iterator[list[object]]:
    """Give signals back their handlers, whatever a test leaves; return these."""
    before = [signal.getsignal(number) for number in SIGNALS]
    yield before
    for number, handler in zip(SIGNALS, before, strict=True):
        signal.signal(number, handler)


def interrupted(number: signal.Signals, went_on: list[bool]) -> Callable[..., None]:
    """Return a function that gets a signal."""

    def run(*_: object, **__: object) -> None:
        os.kill(os.getpid(), number)
        went_on.append(True)

    return run


@pytest.mark.parametrize('number', SIGNALS)
@pytest.mark.parametrize(
    ('command', 'kind', 'status', 'text'),
    [('record', Recorder, 2, RECORDED), ('watch', Watcher, 0, '')],
)
def test_a_signal_ends_the_building_of_a_node_there_and_then(
    command: str,
    kind: type,
    status: int,
    text: str,
    number: signal.Signals,
    ros_domain: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    handlers: list[object],
) -> None:
    went_on: list[bool] = []
    monkeypatch.setattr(kind, '__init__', interrupted(number, went_on))
    words = {'record': ['-o', str(tmp_path / 'bag')], 'watch': []}[command]
    assert main([command, *words]) == status
    err = capfd.readouterr().err
    assert not went_on and err.count('\n') == (1 if text else 0) and text in err
    assert not (tmp_path / 'bag').exists()
    assert [signal.getsignal(one) for one in SIGNALS] == handlers


@pytest.mark.parametrize('number', SIGNALS)
def test_a_signal_before_there_is_a_recorder_is_not_lost(
    number: signal.Signals,
    ros_domain: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr('fisheye_svp_ros.nodes.session.rclpy.init', interrupted(number, []))
    monkeypatch.setattr(Recorder, '__init__', lambda *_: pytest.fail('it goes on'))
    assert main(['record', '-o', str(tmp_path / 'bag')]) == 2
    assert RECORDED in capfd.readouterr().err


def test_what_comes_twice_below_a_launch_is_one_interrupt() -> None:
    """Of Ctrl-C, from the terminal and from launch; a second one would end the recording."""
    signals = SignalHandler()
    signals.collect()
    for _ in range(2):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.1)
    assert len(signals.times) == 1
    time.sleep(1.1)
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.01)
    assert len(signals.times) == 2
