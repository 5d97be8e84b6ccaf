"""What tests of nodes share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import pytest
from helpers.nodes import until

from fisheye_svp_ros.optics import engines

if TYPE_CHECKING:
    from helpers.graph import Graph

    from fisheye_svp_ros.detect.workers import BoundedCalls


@pytest.fixture(autouse=True)
def frequent_reports(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have nodes in the process of a test report on /diagnostics ten times a second."""
    if 'ros_domain' in request.fixturenames:
        from fisheye_svp_ros.nodes import base

        monkeypatch.setattr(base, '_REPORT_PERIOD', 0.1)


@pytest.fixture(autouse=True)
def reference_engine(same_engine: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have nodes solve by the reference, whatever was compiled before."""
    monkeypatch.setenv(engines.VARIABLE, 'numpy')


@pytest.fixture(scope='session')
def searches() -> Iterator[Callable[..., BoundedCalls]]:
    """Return what makes the process that searches images: the same one, which takes a second."""
    from fisheye_svp_ros.detect.workers import BoundedCalls

    class Lasting(BoundedCalls):
        def stop(self) -> None:
            until(lambda: (self.result(), not self.busy)[1])

    made: list[Lasting] = []

    def make(function: Any, first: Any) -> BoundedCalls:
        made[:] = made or [Lasting(function, first)]
        return made[0]

    yield make
    for one in made:
        BoundedCalls.stop(one)


@pytest.fixture
def graph(
    ros_domain: int, searches: Callable[..., BoundedCalls], monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., Graph]]:
    """Return a function that starts a graph; each argument is a parameter NAME:=VALUE."""
    from helpers.graph import Graph

    monkeypatch.setattr('fisheye_svp_ros.nodes.detector.BoundedCalls', searches)
    started: list[Graph] = []

    def start(*parameters: str) -> Graph:
        started.append(Graph(*(word for one in parameters for word in ('-p', one))))
        return started[-1]

    yield start
    for one in started:
        one.close()
