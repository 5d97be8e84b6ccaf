"""The package's own engines as sides of a row."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from benchmark.speed.harness import OURS, Side


def engines() -> list[str]:
    """Return the names of the engines that can run here."""
    return ['numpy']


def name_of(engine: str) -> str:
    """Return how the package with an engine is called in a row."""
    return f'{OURS}, {engine}'


def sides(run: Callable[[], Any], **keywords: Any) -> dict[str, Callable[[], Side]]:
    """Return makers of one side an engine."""
    return {name_of(engine): partial(_side, engine, run, keywords) for engine in engines()}


def _side(engine: str, run: Callable[[], Any], keywords: dict[str, Any]) -> Side:
    return Side(name_of(engine), run, **keywords)
