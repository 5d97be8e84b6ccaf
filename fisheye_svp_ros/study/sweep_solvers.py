"""What the solver nodes would tell of simulated sets, many at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Views, views_of
from fisheye_svp_ros.simulate.scenario import Batch, model_of
from fisheye_svp_ros.study.metrics import (
    LOCALIZATION_METRICS,
    STEREO_CALIBRATION_METRICS,
    STEREO_DEPTH_METRICS,
)
from fisheye_svp_ros.study.settings import (
    LocalizerSettings,
    SolverSettings,
    StereoCalibratorSettings,
    StereoDepthSettings,
)
from fisheye_svp_ros.study.solutions import SetSolutions, localize_sets, measure_points, solve_rigs

_SETS_PER_SOLVE = 512  # sets solved at once: more take more memory and no less time

_Solve = Callable[[Index], SetSolutions[Any]]  # the sets of an index (A,)
S = TypeVar('S', bound=SolverSettings)


class Outcome:
    """Metrics (T,) of T sets by name; note (T,) says why a set has none, '' where it has."""

    def __init__(self, count: int, names: Sequence[str]) -> None:
        self.metrics = {name: np.full(count, np.nan) for name in names}
        self.note = np.full(count, '', dtype=object)

    def attempt(self, index: Index, solve: _Solve) -> None:
        """Solve sets together; where one of them spoils it, find out which."""
        try:
            found = solve(index)
        except GeometryError as error:
            if len(index) == 1:
                self.note[index] = str(error)
                return
            for half in np.array_split(index, 2):
                self.attempt(half, solve)
            return
        self.note[index[~found.solved]] = found.unsolved
        for name, values in found.metrics.items():
            self.metrics[name][index[found.solved]] = values[found.solved]


class _Sets(NamedTuple):
    """T sets: landmark (T, N), points (T, N, 3), m; by camera poses (T,) and uv (T, N, 2)."""

    landmark: Index
    points: Array
    poses: tuple[Pose, ...]
    uv: tuple[Array, ...]

    def views(self, camera: int, index: Index, sigma: float) -> Views:
        uv = self.uv[camera][index]
        views = views_of(self.points[index], uv, np.full(uv.shape[:2], 1 / sigma))
        return views._replace(landmark=self.landmark[index])


def _sets(batch: Batch) -> _Sets:
    scenarios, sets = batch.uv[0].shape[:2]
    of = np.repeat(np.arange(scenarios), sets)
    poses = [pose.reshape(-1) for pose in batch.poses]
    uv = [uv.reshape(-1, *uv.shape[2:]) for uv in batch.uv]
    return _Sets(batch.landmark[of], batch.points[of], tuple(poses), tuple(uv))


def _model(batch: Batch, settings: SolverSettings) -> ForwardModel:
    if settings.lens:
        return model_of(settings.lens, 1.0, settings.solves_svp)
    return model_of(batch.lens, batch.shift_scale, settings.solves_svp)


def _chunks(index: Index) -> list[Index]:
    return [index[i:i + _SETS_PER_SOLVE] for i in range(0, len(index), _SETS_PER_SOLVE)]


def localizer(batch: Batch, settings: LocalizerSettings) -> Outcome:
    """Localize the camera of every set, as the localizer does."""
    sets, model = _sets(batch), _model(batch, settings)
    outcome = Outcome(len(sets.landmark), LOCALIZATION_METRICS)

    def solve(index: Index) -> SetSolutions[Any]:
        views = sets.views(0, index, settings.sigma_px)
        return localize_sets(model, views, sets.poses[0].take(index))

    for index in _chunks(np.arange(len(sets.landmark))):
        outcome.attempt(index, solve)
    return outcome


def stereo_calibrator(batch: Batch, settings: StereoCalibratorSettings) -> Outcome:
    """Calibrate after every set from those of its scenario so far, as the stereo calibrator does.

    A set that cannot be used is left out of those that come after it.
    """
    sets, model, rig = _sets(batch), _model(batch, settings), batch.rig
    assert rig is not None
    scenarios, per_scenario = batch.uv[0].shape[:2]
    outcome = Outcome(len(sets.landmark), STEREO_CALIBRATION_METRICS)
    windows: list[list[int]] = [[] for _ in range(scenarios)]

    def solve(index: Index) -> SetSolutions[Any]:
        of = index // per_scenario
        rows = np.array([windows[scenario] for scenario in of])
        left, right = (sets.views(i, rows.ravel(), settings.sigma_px) for i in (0, 1))
        return solve_rigs((model, model), left, right, len(index), rig.take(of))

    for number in range(per_scenario):
        index = np.arange(scenarios) * per_scenario + number
        before = [list(window) for window in windows]
        for window, one in zip(windows, index, strict=True):
            window[:] = [*window, int(one)][-settings.views:]
        lengths = np.array([len(window) for window in windows])
        for length in np.unique(lengths):
            for chunk in _chunks(index[lengths == length]):
                outcome.attempt(chunk, solve)
        for scenario in np.flatnonzero(outcome.note[index] != ''):
            windows[scenario] = before[scenario]
    return outcome


def stereo_depth(batch: Batch, settings: StereoDepthSettings) -> Outcome:
    """Measure every set with the true rig, as stereo depth does."""
    sets, model, rig = _sets(batch), _model(batch, settings), batch.rig
    assert rig is not None
    per_scenario = batch.uv[0].shape[1]
    outcome = Outcome(len(sets.landmark), STEREO_DEPTH_METRICS)

    def solve(index: Index) -> SetSolutions[Any]:
        true = sets.poses[1].take(index).into_body(sets.points[index])
        left, right = (uv[index] for uv in sets.uv)
        rigs = rig.take(index // per_scenario)
        return measure_points((model, model), rigs, left, right, true, settings.optimal)

    for index in _chunks(np.arange(len(sets.landmark))):
        outcome.attempt(index, solve)
    return outcome


class Solver(NamedTuple):
    """A solver node: its parameters, the names of its metrics, and what it does."""

    settings: type[SolverSettings]
    metrics: Sequence[str]
    solve: Callable[[Batch, Any], Outcome]


SOLVERS: Mapping[str, Solver] = {
    'localizer': Solver(LocalizerSettings, LOCALIZATION_METRICS, localizer),
    'stereo_calibrator': Solver(
        StereoCalibratorSettings, STEREO_CALIBRATION_METRICS, stereo_calibrator
    ),
    'stereo_depth': Solver(StereoDepthSettings, STEREO_DEPTH_METRICS, stereo_depth),
}
