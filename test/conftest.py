"""Fixtures for tests that run nodes: a domain of their own, and processes that always end."""

from __future__ import annotations

import fcntl
import os
import queue
import random
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from fisheye_svp_ros import engines

# Asked before any test installs the standalone client, which answers to the name of rclpy.
GENUINE = find_spec('rclpy') is not None
ROOT = Path(__file__).resolve().parent.parent
TIMEOUT = 60.0  # s; only a hang takes this long, however busy the machine is

_INSTALL = 'from fisheye_svp_ros import standalone; standalone.install()\n'


def _is_free(domain: int) -> bool:
    """Say whether nobody else uses the domain on this machine, with or without a lock."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(('127.0.0.1', 7400 + 250 * domain + 10))
        except OSError:
            return False
    return True


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Keep what needs the compiled engine in one process, so that it is compiled once."""
    for item in items:
        if {'engine', 'compiled'} & set(getattr(item, 'fixturenames', ())):
            item.add_marker(pytest.mark.xdist_group('engines'))


@pytest.fixture(params=['numpy', 'numba'])
def engine(request: pytest.FixtureRequest) -> Iterator[str]:
    """Run a test on each engine."""
    if request.param == 'numba':
        pytest.importorskip('numba', reason='the engine numba comes with the extra `fast`')
    before = os.environ.get(engines.VARIABLE)
    engines.use(request.param)
    yield request.param
    engines.use(before or 'auto')
    if before is None:
        del os.environ[engines.VARIABLE]


@pytest.fixture
def ros_domain(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Reserve a ROS_DOMAIN_ID from 1 to 101 that no other test has, on loopback only."""
    for domain in random.sample(range(1, 102), 101):
        lock = Path(tempfile.gettempdir(), f'fisheye_svp_ros_domain_{domain}.lock')
        with lock.open('a') as held:
            try:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                continue
            if _is_free(domain):
                monkeypatch.setenv('ROS_DOMAIN_ID', str(domain))
                monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
                yield domain
                return
    pytest.fail('all ROS domains from 1 to 101 are taken')


class NodeProcess:
    """A node in a process of its own, and the lines it writes."""

    def __init__(self, command: list[str], env: dict[str, str]) -> None:
        self.lines: list[str] = []
        self._queue: queue.Queue[str | None] = queue.Queue()
        self.process = subprocess.Popen(
            command, env=env, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        assert self.process.stdout
        for line in self.process.stdout:
            self._queue.put(line.rstrip('\n'))
        self._queue.put(None)

    def wait_for(self, pattern: str, timeout: float = TIMEOUT) -> re.Match[str]:
        """Return the first new line that matches; fail when the process ends before."""
        end = time.monotonic() + timeout
        while (left := end - time.monotonic()) > 0:
            try:
                line = self._queue.get(timeout=left)
            except queue.Empty:
                break
            if line is None:
                self._queue.put(None)
                break
            self.lines.append(line)
            if match := re.search(pattern, line):
                return match
        raise AssertionError(f'no line with {pattern!r} in:\n' + '\n'.join(self.lines))

    def finish(self, number: signal.Signals | None = None, timeout: float = TIMEOUT) -> int:
        """Wait for the end, after a signal if one is given; return the exit status."""
        if number is not None:
            self.process.send_signal(number)
        status = self.process.wait(timeout)
        self._thread.join(timeout)
        while (line := self._queue.get(timeout=timeout)) is not None:
            self.lines.append(line)
        self._queue.put(None)
        return status


@pytest.fixture
def run_node(ros_domain: int) -> Iterator[Callable[..., NodeProcess]]:
    """Return a function that runs Python code or a script as a standalone node."""
    started: list[NodeProcess] = []

    def run(source: str | Path, *args: str, genuine: bool = False) -> NodeProcess:
        env = os.environ | {'PYTHONUNBUFFERED': '1', 'ROS_DOMAIN_ID': str(ros_domain)}
        # Without the path of an installed ROS 2, the standalone client takes its place.
        env['PYTHONPATH'] = os.pathsep.join(
            [str(ROOT), *(env.get('PYTHONPATH', '').split(os.pathsep) if genuine else [])])
        code = source
        if isinstance(source, Path):
            code = f'import runpy; runpy.run_path({str(source)!r}, run_name="__main__")'
        text = code if genuine else _INSTALL + str(code)
        started.append(NodeProcess([sys.executable, '-c', str(text), *args], env))
        return started[-1]

    yield run
    for node in started:
        if node.process.poll() is None:
            node.process.kill()
            node.process.wait()


class Caller:
    """A service client for tests, on the wire of the standalone client."""

    def __init__(self, domain: int) -> None:
        from fisheye_svp_ros.standalone import dds

        self._dds = dds
        self._participant = dds.Participant(domain)
        self._sequence = 0

    def call(self, typename: str, service: str, **request: Any) -> Any:
        """Call a service and return its response."""
        from fisheye_svp_ros.standalone.messages import service_class
        from fisheye_svp_ros.standalone.qos import QoSProfile

        dds, qos, types = self._dds, QoSProfile(depth=10), service_class(typename)
        participant = self._participant
        writer = dds.Writer(
            participant, f'rq{service}Request', types.Request.TYPENAME, qos, 'clientid=1.2.3;')
        reader = dds.Reader(
            participant, f'rr{service}Reply', types.Response, qos, 'clientid=1.2.3;')
        until(lambda: bool(
            writer.entity.get_matched_subscriptions() and reader.entity.get_matched_publications()
        ))
        self._sequence += 1
        header = dds.Header(writer.entity.instance_handle % 2**64, self._sequence)
        writer.write_call(header, types.Request(**request))
        while taken := until(reader.take_call):
            if taken[0][:2] == header[:2]:
                return taken[1]
        raise AssertionError('no reply')


@pytest.fixture
def caller(ros_domain: int) -> Iterator[Caller]:
    """Return a service client on the domain of the test."""
    pytest.importorskip('cyclonedds')
    yield Caller(ros_domain)


def until(condition: Callable[[], Any], timeout: float = TIMEOUT) -> Any:
    """Return the first true answer of a function, or fail after a while."""
    end = time.monotonic() + timeout
    while time.monotonic() < end:
        if answer := condition():
            return answer
        time.sleep(0.01)
    raise AssertionError('nothing happened in time')
