"""Rows: the Numba engine on two cores, and compiled without vectorization.

Both are settled when a process starts, so each side is a process of its own that times itself.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import partial
from typing import Any

import numpy as np

from benchmark.speed import engines
from benchmark.speed.harness import Goal, NotHereError, Row, Side, available, measure
from benchmark.speed.scenes import localization, points, shift_lens
from benchmark.speed.worker import worker
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.pose import identity
from fisheye_svp_ros.scene.observations import views_of
from fisheye_svp_ros.solve.localization import localize

NUMBA = engines.name_of('numba')
_UNVECTORISED = {'NUMBA_LOOP_VECTORIZE': '0', 'NUMBA_SLP_VECTORIZE': '0'}


def rows(many: int = 10_000, count: int = 100_000, repeats: int = 9) -> list[Row]:
    """Return the rows about `many` localizations and about `count` points."""
    one, two = f'{NUMBA}, one core', f'{NUMBA}, two cores'
    cores = {one: {'OMP_NUM_THREADS': '1'}, two: {'OMP_NUM_THREADS': '2'}}
    with tempfile.TemporaryDirectory() as folder:
        # A compilation of its own must not end up in the user's cache.
        scalar = {**_UNVECTORISED, 'XDG_CACHE_HOME': folder}
        compilations = {NUMBA: {}, 'without vectorisation': scalar}
        return [
            _row(
                f'{many} localizations, ShiftVP, on two cores',
                ('localization', many),
                cores,
                ('µs each', 1e-6),
                repeats,
                'wall',
                [Goal(two, one, 1.7)],
                'On the clock on the wall: both cores must be free.',
            ),
            _row(
                'Projection with derivatives by the pose, ShiftVP, without vectorisation',
                ('projection', count),
                compilations,
                ('ns a point', 1e-9),
                repeats,
                'processor',
                [],
                'The same code compiled twice: alike, vectorisation would be lost.',
            ),
        ]


def _row(
    title: str,
    job: tuple[str, int],
    variants: Mapping[str, Mapping[str, str]],
    unit: tuple[str, float],
    repeats: int,
    clock: str,
    goals: list[Goal],
    text: str,
) -> Row:
    with ExitStack() as stack:
        sides, left_out = available(
            {
                name: partial(_side, stack, name, job, environment, clock)
                for name, environment in variants.items()
            }
        )
        timings = measure(sides, repeats)
    return Row(title, *unit, timings, left_out=left_out, goals=goals, text=text)


def _side(
    stack: ExitStack, name: str, job: tuple[str, int], environment: Mapping[str, str], clock: str
) -> Side:
    if 'numba' not in engines.engines():
        raise NotHereError('Numba is not installed')
    what, size = job
    command = [sys.executable, '-m', 'benchmark.speed.engine_worker', what, str(size)]
    run = stack.enter_context(worker(command, {**os.environ, **environment}))
    return Side(name, run, size, seconds=lambda answer: float(answer[clock]))


def work_of(what: str, size: int) -> Callable[[], Any]:
    """Return a job of a worker."""
    model = ForwardModel(shift_lens())
    if what == 'localization':
        scene = localization(model.lens, size)
        return lambda: localize(model, scene.views, scene.start)
    views = views_of(points(size, np.radians(100.0)), np.zeros((1, size, 2)))
    return lambda: model.linearize(identity(1), views)
