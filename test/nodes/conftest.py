"""What tests of nodes share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from helpers.graph import Graph


@pytest.fixture(autouse=True)
def frequent_reports(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have nodes in the process of a test report on /diagnostics ten times a second."""
    if 'ros_domain' in request.fixturenames:
        from fisheye_svp_ros.nodes import base

        monkeypatch.setattr(base, '_REPORT_PERIOD', 0.1)


@pytest.fixture
def graph(ros_domain: int) -> Iterator[Callable[..., Graph]]:
    """Return a function that starts a graph; each argument is a parameter NAME:=VALUE."""
    from helpers.graph import Graph

    started: list[Graph] = []

    def start(*parameters: str) -> Graph:
        started.append(Graph(*(word for one in parameters for word in ('-p', one))))
        return started[-1]

    yield start
    for one in started:
        one.close()
