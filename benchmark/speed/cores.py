"""Row: two cores against one."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from benchmark.speed import engines
from benchmark.speed.harness import Goal, Row, Side, measure
from benchmark.speed.scenes import Scene, localization, shift_lens
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.solve.localization import localize


def rows(many: int = 10_000, repeats: int = 9) -> list[Row]:
    """Return the row: `many` localizations in one call, and in two threads."""
    scene = localization(shift_lens(), many)
    makers = {}
    with ThreadPoolExecutor(2) as pool:
        halves = [_part(scene, part) for part in np.array_split(np.arange(many), 2)]
        whole = _part(scene, np.arange(many))

        def both() -> Array:
            return np.concatenate([*pool.map(lambda half: half(), halves)])

        for name, run in (('one core', whole), ('two cores', both)):
            makers |= {
                f'{side}, {name}': maker
                for side, maker in engines.sides(run, work=many).items()
            }
        sides = [_named(maker(), name) for name, maker in makers.items()]
        timings = measure(sides, repeats)
    one, two = (f'{engines.name_of("numba")}, {cores}' for cores in ('one core', 'two cores'))
    return [Row(
        f'{many} localizations, ShiftVP, on two cores', 'µs each', 1e-6, timings,
        goals=[Goal(two, one, 1.7)],
    )]


def _part(scene: Scene, index: Array) -> Callable[[], Array]:
    model = ForwardModel(scene.lens)
    views, start = scene.views.take(index), scene.start.take(index)
    return lambda: localize(model, views, start).pose.position


def _named(side: Side, name: str) -> Side:
    return Side(name, side.run, side.work)
