"""What tests of nodes share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from helpers.graph import Graph


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
