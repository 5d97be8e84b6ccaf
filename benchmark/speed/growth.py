"""Table: how time and memory grow with the size of a problem."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from benchmark.speed.engines import use
from benchmark.speed.harness import Side, exponent, measure
from benchmark.speed.report import Table, number
from benchmark.speed.scenes import (
    LANDMARKS,
    localization,
    on_board,
    points,
    shift_lens,
    stereo,
    svp_lens,
)
from fisheye_svp_ros.diagnosis import NullModel, diagnose
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.io.landmark_files import environment
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.scene.rigs import paper_pose
from fisheye_svp_ros.simulate.simulation import simulate
from fisheye_svp_ros.solve.bundle_adjustment import adjust
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.localization import localize
from fisheye_svp_ros.solve.rig_state import group_by_frame
from fisheye_svp_ros.solve.stereo_calibration import calibrate_stereo

_TEXT = """Median time and peak of newly allocated memory, NumPy engine; an exponent of 1 is
proportional growth."""


class Growth(NamedTuple):
    """Work whose size grows: what `make` prepares for a size is timed."""

    work: str
    what: str
    sizes: Sequence[int]
    make: Callable[[int], Callable[[], Any]]


def tables(repeats: int = 3) -> list[Table]:
    """Return the table."""
    use('numpy')
    header = ('work', 'that grows', 'sizes', 'time, ms', 'exponent', 'memory, MB', 'exponent')
    return [Table('Growth', header, [line(growth, repeats) for growth in growths()], _TEXT)]


def line(growth: Growth, repeats: int) -> tuple[str, ...]:
    """Return the line of the table of one kind of work."""
    runs = {size: growth.make(size) for size in growth.sizes}
    timings = measure([Side(str(size), run) for size, run in runs.items()], repeats)
    seconds = [timing.median for timing in timings]
    memory = [_peak(run) for run in runs.values()]
    return (
        growth.work,
        growth.what,
        ' '.join(map(str, growth.sizes)),
        ' '.join(number(1e3 * value) for value in seconds),
        f'{exponent(growth.sizes, seconds):.2f}',
        ' '.join(number(value / 1e6) for value in memory),
        f'{exponent(growth.sizes, memory):.2f}',
    )


def growths() -> list[Growth]:
    """Return what grows."""
    return [
        Growth('projection, ShiftVP', 'points', (20_000, 100_000, 500_000), _projection),
        Growth('a localization, ShiftVP', 'landmarks', (100, 1000, 10_000), _landmarks),
        Growth('localizations, ShiftVP', 'views', (100, 1000, 10_000), _views),
        Growth('stereo calibration', 'views', (10, 40, 160), _stereo),
        Growth('null model and tests, 30 frames', 'effects', (5, 10, 20), _evidence),
        Growth('diagnosis, 33 landmarks', 'frames', (20, 40, 80, 160, 320), _diagnosis),
        Growth(
            'diagnosis, 10 frames of a board',
            'landmarks',
            (32, 64, 128, 256, 512),
            lambda count: _of_board(count, 1),
        ),
        Growth(
            'diagnosis, 10 frames of a board, 32 landmarks',
            'cameras',
            (1, 2, 4, 8, 16),
            lambda count: _of_board(32, count),
        ),
    ]


def _projection(count: int) -> Callable[[], Any]:
    lens, seen = shift_lens(), points(count, np.radians(100.0))
    return lambda: project(lens, seen)


def _landmarks(count: int) -> Callable[[], Any]:
    scene = localization(shift_lens(), 1, count)
    model = ForwardModel(scene.lens)
    return lambda: localize(model, scene.views)


def _views(count: int) -> Callable[[], Any]:
    scene = localization(shift_lens(), count, LANDMARKS)
    model = ForwardModel(scene.lens)
    return lambda: localize(model, scene.views)


def _stereo(count: int) -> Callable[[], Any]:
    scene = stereo(svp_lens(), count)
    model = ForwardModel(scene.lens)
    return lambda: calibrate_stereo(model, model, scene.left, scene.right)


def _evidence(count: int) -> Callable[[], Any]:
    data = group_by_frame(_seen(30))
    state = adjust(data, initial_state(data, shift_lens().svp()), ())
    left_out = list(CATALOGUE)[count:]
    return lambda: NullModel.estimate(data, state, (), left_out=left_out)


def _diagnosis(count: int) -> Callable[[], Any]:
    seen, lens = _seen(count), shift_lens().svp()
    return lambda: diagnose(seen, lens)


def _of_board(landmarks: int, cameras: int) -> Callable[[], Any]:
    seen, names = on_board(10, landmarks, cameras)
    lenses = dict.fromkeys(names, shift_lens().svp())
    return lambda: diagnose(seen, lenses)


def _seen(frames: int) -> Observations:
    """Return what a lens with a shift sees of the paper's landmarks, at 0.5 m."""
    rng = np.random.default_rng(1)
    turn = rotation_from_vector(rng.uniform(-0.5, 0.5, (frames, 3)))
    poses = Pose(turn @ paper_pose(frames).rotation, rng.uniform(-0.1, 0.1, (frames, 3)))
    return simulate(ForwardModel(shift_lens()), environment('whole', 0.5), poses, 0.2, rng)


def _peak(run: Callable[[], Any]) -> float:
    tracemalloc.start()
    try:
        run()
        return float(tracemalloc.get_traced_memory()[1])
    finally:
        tracemalloc.stop()
