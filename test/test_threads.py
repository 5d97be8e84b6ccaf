"""BLAS takes one thread while the library works, unless the environment says otherwise."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from fisheye_svp_ros.process import VARIABLES, limit_threads, set_thread_count

threadpoolctl = pytest.importorskip('threadpoolctl', reason='comes with pip, not with ROS 2')


@limit_threads
def _threads() -> set[int]:
    """Return the numbers of threads that BLAS libraries take."""
    return {
        pool['num_threads']
        for pool in threadpoolctl.threadpool_info()
        if pool['user_api'] == 'blas'
    }


@pytest.fixture
def no_number(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the environment say nothing about threads."""
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)


@pytest.mark.usefixtures('no_number')
def test_one_thread_inside_and_as_many_as_before_afterwards() -> None:
    with threadpoolctl.threadpool_limits(2, user_api='blas'):
        before = _threads.__wrapped__()
        assert _threads() == {1}
        assert _threads.__wrapped__() == before


_LOADED_INSIDE = """
import numpy as np
from threadpoolctl import threadpool_info
from fisheye_svp_ros.process import limit_threads

@limit_threads
def count():
    import scipy.linalg
    return {pool['num_threads'] for pool in threadpool_info() if pool['user_api'] == 'blas'}

assert count() == {1}, count()
"""


@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason='one core has one thread anyway')
def test_what_is_loaded_inside_is_limited_too() -> None:
    environment = {name: value for name, value in os.environ.items() if name not in VARIABLES}
    subprocess.run([sys.executable, '-c', _LOADED_INSIDE], check=True, env=environment)


@pytest.mark.usefixtures('no_number')
def test_a_number_in_the_environment_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv('OPENBLAS_NUM_THREADS', '2')
    with threadpoolctl.threadpool_limits(2, user_api='blas'):
        assert _threads() == _threads.__wrapped__()


@pytest.mark.usefixtures('no_number')
def test_processes_of_the_package_ask_for_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLES[0], '')
    monkeypatch.delenv(VARIABLES[0])
    set_thread_count()
    assert os.environ[VARIABLES[0]] == '1'
    monkeypatch.setenv(VARIABLES[0], '3')
    set_thread_count()
    assert os.environ[VARIABLES[0]] == '3'


def test_the_library_is_single_threaded() -> None:
    from fisheye_svp_ros.library import functions as library

    for name in (
        'localize',
        'calibrate',
        'calibrate_stereo',
        'stereo_depth',
        'sweep',
        'diagnose',
        'budget',
    ):
        assert hasattr(getattr(library, name), '__wrapped__'), name
