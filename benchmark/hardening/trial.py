"""Tests of a copy of the tree, run in a forked process: what they import is loaded once."""

from __future__ import annotations

import os
import signal
import sys
from contextlib import suppress
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from types import ModuleType

_FORK = get_context('fork')
# What the tests import of others, loaded once for all mutants.
_PRELOADED = (
    'pytest',
    'hypothesis',
    'numpy',
    'scipy.optimize',
    'scipy.stats',
    'scipy.spatial',
    'scipy.sparse.linalg',
    'numba',
    'cv2',
    'matplotlib.pyplot',
    'rosbags.highlevel',
    'yaml',
    'pyarrow.parquet',
    'rclpy.node',
    'rich.console',
    'jinja2',
)


def preload() -> None:
    """Import what the tests import of others, where it is installed."""
    for name in _PRELOADED:
        with suppress(ImportError):
            import_module(name)


def failing_test(
    tests: list[str], tree: Path, environment: dict[str, str], patience: float, log: Path
) -> str:
    """Return the first test that fails, 'hung' after some patience, s, or nothing."""
    child = _FORK.Process(target=_run_tests, args=(tests, tree, environment, log))
    child.start()
    child.join(patience)
    hung = child.exitcode is None
    with suppress(ProcessLookupError):
        os.killpg(child.pid or 0, signal.SIGKILL)  # with what tests have started
    child.join()
    if hung or child.exitcode == 0:
        return 'hung' if hung else ''
    lines = log.read_text(encoding='utf-8', errors='replace').splitlines()
    failed = [line for line in lines if line.startswith(('FAILED ', 'ERROR '))]
    return failed[0].split(' ', 1)[1].split(' - ')[0] if failed else f'exit {child.exitcode}'


def _run_tests(tests: list[str], tree: Path, environment: dict[str, str], log: Path) -> None:
    os.setsid()
    with log.open('wb') as stream:
        for descriptor in (1, 2):
            os.dup2(stream.fileno(), descriptor)
    os.chdir(tree)
    sys.path.insert(0, str(tree))
    for name in [name for name in sys.modules if name.startswith('benchmark')]:
        del sys.modules[name]
    sys.modules['__main__'] = ModuleType('__main__')  # which processes of the tests import, too
    os.environ |= environment | {'PYTHONPATH': str(tree), 'OMP_NUM_THREADS': '1'}
    sys.dont_write_bytecode = True  # a fault may have the size and the second of its original
    os.environ['PYTHONDONTWRITEBYTECODE'] = '1'
    if 'NUMBA_DISABLE_JIT' in environment and (numba := sys.modules.get('numba')) is not None:
        numba.config.DISABLE_JIT = int(environment['NUMBA_DISABLE_JIT'])
    import pytest

    os._exit(int(pytest.main(['-x', '-q', '-p', 'no:cacheprovider', *tests])))
