"""A node serves from NumPy until Numba has compiled, and says so."""

from __future__ import annotations

from typing import Any

import pytest
from helpers.nodes import need_ros

need_ros()

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402

from fisheye_svp_ros.io.decoding import read_key_values  # noqa: E402
from fisheye_svp_ros.nodes.localizer import Localizer  # noqa: E402
from fisheye_svp_ros.optics import engines  # noqa: E402
from fisheye_svp_ros.optics.engines import cache, numpy_engine  # noqa: E402


@pytest.fixture
def uncompiled(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Have nothing compiled yet; return the engines that are taken into use."""
    taken: list[str] = []
    monkeypatch.setattr(engines, 'find_spec', lambda _: 'there')
    monkeypatch.setattr(engines.cache, 'is_compiled', lambda: False)
    monkeypatch.setattr(engines, 'use', taken.append)
    monkeypatch.setattr(engines, '_engine', None)
    monkeypatch.setenv(engines.VARIABLE, 'numba')
    return taken


def told(reports: list[Any]) -> str:
    return read_key_values(reports[-1])['engine'] if reports else ''


def test_a_start_never_waits_for_numba(graph, uncompiled, monkeypatch):
    monkeypatch.setattr(cache, '_CODE', 'import time; time.sleep(600)')
    g = graph('lens:=fish214')
    reports = g.hear(DiagnosticArray, '/diagnostics')
    node = g.start(Localizer)
    g.until(lambda: told(reports) == 'numpy, until Numba has compiled')
    assert engines._engine is numpy_engine and not uncompiled
    process = node._compilation._process
    g.close()
    assert process.wait(10) != 0, 'it ends with its node'


@pytest.mark.parametrize(
    ('code', 'taken', 'line'),
    [
        ('pass', ['numba'], 'solving with Numba from now on'),
        ('raise SystemExit("no room")', [], 'Numba has not compiled (no room)'),
    ],
)
def test_numba_is_taken_once_it_has_compiled(
    graph, uncompiled, monkeypatch, capfd, code, taken, line
):
    monkeypatch.setattr(cache, '_CODE', code)
    g = graph('lens:=fish214')
    reports = g.hear(DiagnosticArray, '/diagnostics')
    node = g.start(Localizer)
    g.until(lambda: node._compilation is None)
    g.until(lambda: told(reports) == 'numpy')  # what `use` would have changed
    assert uncompiled == taken
    assert line in capfd.readouterr().err
