"""The package's own engines as sides of a row."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from importlib.util import find_spec
from typing import Any

from benchmark.speed.harness import OURS, Goal, Row, Side, available, measure
from fisheye_svp_ros.optics.engines import use as use


def engines() -> list[str]:
    """Return the names of the engines that can run here."""
    return ['numpy'] if find_spec('numba') is None else ['numpy', 'numba']


def name_of(engine: str) -> str:
    """Return how the package with an engine is called in a row."""
    return f'{OURS}, {engine}'


def sides(run: Callable[[], Any], way: str = '', **keywords: Any) -> dict[str, Callable[[], Side]]:
    """Return makers of one side an engine; way: what sets the sides apart from other ones."""
    return {
        name_of(engine) + way: partial(_side, engine, way, run, keywords) for engine in engines()
    }


def row(
    title: str,
    unit: tuple[str, float],
    makers: dict[str, Callable[[], Side]],
    repeats: int,
    goals: Sequence[tuple[str, str, float]] = (),
    error_unit: str = 'm',
    text: str = '',
) -> Row:
    """Measure the sides of a row; unit: its name and size, s; goals: engine, peer and ratio."""
    sides, left_out = available(makers)
    return Row(
        title,
        *unit,
        measure(sides, repeats),
        error_unit,
        left_out,
        [Goal(name_of(engine), peer, ratio) for engine, peer, ratio in goals],
        text,
    )


def _side(engine: str, way: str, run: Callable[[], Any], keywords: dict[str, Any]) -> Side:
    def with_engine() -> Any:
        use(engine)
        try:
            return run()
        finally:
            use('numpy')  # what the sides are compared with comes from the reference

    return Side(name_of(engine) + way, with_engine, **keywords)
