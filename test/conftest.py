"""Fixtures for tests that run nodes: a domain of their own, and processes that always end."""

from __future__ import annotations

import fcntl
import gc
import math
import os
import random
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

# As the Makefile has it: threads of OpenBLAS that wait for a core cost more than they bring.
os.environ.setdefault('OMP_NUM_THREADS', '1')
# Also where pytest is started in a colcon workspace, and reads no pyproject.toml.
sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parent)]

from helpers.lasting import LastingWorker  # noqa: E402
from helpers.nodes import TIMEOUT, Caller, NodeProcess  # noqa: E402

from fisheye_svp_ros.optics import engines  # noqa: E402

_LONG = Path(__file__).with_name('long_tests.txt')


def _is_free(domain: int) -> bool:
    """Say whether nobody else uses the domain on this machine, with or without a lock."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(('127.0.0.1', 7400 + 250 * domain + 10))
        except OSError:
            return False
    return True


@pytest.hookimpl(hookwrapper=True)
def pytest_collection() -> Iterator[None]:
    """Look for garbage neither while modules are loaded, nor among them afterwards."""
    gc.disable()
    yield
    gc.freeze()
    gc.enable()


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Have Fast DDS remove what killed nodes left in shared memory, once all workers have ended.

    As users do; among living nodes it takes their locks for a moment.
    """
    places = f'{Path(sys.executable).parent}{os.pathsep}{os.environ["PATH"]}'
    tool = shutil.which('fastdds', path=places)
    if tool and not hasattr(session.config, 'workerinput'):
        subprocess.run([tool, 'shm', 'clean'], stdout=subprocess.DEVNULL, check=False)


@pytest.hookimpl(tryfirst=True)  # pytest-xdist reads the groups in the same hook
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Keep in one process what needs the compiled engine, or one sweep to compare with: made once.

    What takes long comes first: at the end others would have nothing to do beside it.
    Processes that talk are at the mercy of the machine: such a test that fails runs once more.
    """
    again = config.pluginmanager.hasplugin('rerunfailures')
    long = {line for line in _LONG.read_text().splitlines() if not line.startswith('#')}
    for item in items:
        name = f'{item.path.relative_to(_LONG.parent.parent)}::{item.nodeid.partition("::")[2]}'
        if {name, name.partition('[')[0]} & long:
            item.add_marker(pytest.mark.long)
        fixtures = set(getattr(item, 'fixturenames', ()))
        if {'engine', 'compiled'} & fixtures:
            item.add_marker(pytest.mark.xdist_group('engines'))
        elif 'undisturbed' in fixtures:
            item.add_marker(pytest.mark.xdist_group('undisturbed'))
        if again and 'ros_domain' in fixtures:
            item.add_marker(pytest.mark.flaky(reruns=1))
    items.sort(key=lambda item: item.get_closest_marker('slow') is None)


@pytest.fixture(autouse=True)
def same_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take back what a test settles about the engine: the two agree to 1e-12, not to the bit."""
    monkeypatch.setattr(engines, '_engine', engines._engine)
    monkeypatch.setenv(engines.VARIABLE, os.environ.get(engines.VARIABLE, 'auto'))


@pytest.fixture(autouse=True)
def no_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    """Print no line of progress among those of a command, however busy the machine is."""
    monkeypatch.setattr('fisheye_svp_ros.reporting.terminal._INTERVAL', math.inf)


@pytest.fixture(scope='session', autouse=True)
def lasting_workers() -> Iterator[None]:
    """Search the photographs of all tests in the same processes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr('fisheye_svp_ros.detect.workers._Worker', LastingWorker)
        yield


@pytest.fixture(scope='session', autouse=True)
def undrawn() -> Iterator[None]:
    """Compose pictures, but do not draw them: half the time of a command that writes a report."""
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine, TightLayoutEngine

    from fisheye_svp_ros.reporting.plots import MarginLayout

    with pytest.MonkeyPatch.context() as patch:
        for engine in (ConstrainedLayoutEngine, TightLayoutEngine, MarginLayout):
            patch.setattr(engine, 'execute', _unless_drawn(engine.execute, lambda *_: None))
        save = _unless_drawn(Figure.savefig, lambda _, file, **__: file.write(b'\x89PNG'))
        patch.setattr(Figure, 'savefig', save)
        yield


_drawn = False


def _unless_drawn(function: Callable[..., None], instead: Callable[..., Any]) -> Any:
    def draw(*arguments: Any, **options: Any) -> Any:
        return (function if _drawn else instead)(*arguments, **options)

    return draw


def _draw() -> Iterator[None]:
    """Draw pictures, for a test that looks at them."""
    global _drawn
    _drawn = True
    yield
    _drawn = False


drawn = pytest.fixture(_draw, name='drawn')
# For the fixtures of a module whose tests look at them.
drawn_in_module = pytest.fixture(_draw, scope='module', name='drawn_in_module')


@pytest.fixture(params=['numpy', 'numba'])
def engine(request: pytest.FixtureRequest, same_engine: None) -> Iterator[str]:
    """Run a test on each engine."""
    if request.param == 'numba':
        pytest.importorskip('numba', reason='the engine numba comes with the extra `fast`')
    before = os.environ[engines.VARIABLE]
    engines.use(request.param)
    yield request.param
    engines.use(before)


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
                if 'rclpy' in sys.modules:  # a node that refused to start has left it on
                    sys.modules['rclpy'].try_shutdown()
                return
    pytest.fail('all ROS domains from 1 to 101 are taken')


@pytest.fixture
def start_process(ros_domain: int) -> Iterator[Callable[[list[str], dict[str, str]], NodeProcess]]:
    """Return a function that starts a command; what runs when the test ends is ended."""
    started: list[NodeProcess] = []

    def start(command: list[str], env: dict[str, str]) -> NodeProcess:
        started.append(NodeProcess(command, env))
        return started[-1]

    yield start
    for node in started:
        node.process.terminate()  # killed, it would leave its shared memory behind
    for node in started:
        try:
            node.process.wait(TIMEOUT)
        except subprocess.TimeoutExpired:
            node.process.kill()
            node.process.wait()


@pytest.fixture
def caller(ros_domain: int) -> Iterator[Caller]:
    """Return a service client on the domain of the test."""
    one = Caller(ros_domain)
    yield one
    one.close()
