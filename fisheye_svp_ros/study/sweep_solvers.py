"""What the solver nodes would tell of simulated sets, many at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Views, views_of
from fisheye_svp_ros.simulate.scenario import model_of
from fisheye_svp_ros.simulate.scenario_batch import Batch
from fisheye_svp_ros.solve.localization import localize
from fisheye_svp_ros.solve.stereo_calibration import calibrate_stereo
from fisheye_svp_ros.solve.stereo_depth import (
    epipolar_offset,
    triangulate,
    triangulate_optimally,
)
from fisheye_svp_ros.study.metrics import (
    LOCALIZATION_METRICS,
    NO_PAIR,
    NO_POSE,
    NO_RIG,
    STEREO_CALIBRATION_METRICS,
    STEREO_DEPTH_METRICS,
    Metrics,
    localization_metrics,
    stereo_calibration_metrics,
    stereo_depth_metrics,
)
from fisheye_svp_ros.study.settings import (
    SolverSettings,
    StereoCalibratorSettings,
    StereoDepthSettings,
)

_TOGETHER = 512  # sets solved at once: more take more memory and no less time

# Solves the sets of an index (A,): metrics (A,), and which of the sets could be solved.
_Solve = Callable[[Index], tuple[Metrics, Mask]]
S = TypeVar('S', bound=SolverSettings)


class Outcome:
    """Metrics (T,) of T sets by name; note (T,) says why a set has none, '' where it has."""

    def __init__(self, count: int, names: Sequence[str]) -> None:
        self.metrics = {name: np.full(count, np.nan) for name in names}
        self.note = np.full(count, '', dtype=object)

    def attempt(self, index: Index, solve: _Solve, lost: str) -> None:
        """Solve sets together; where one of them spoils it, find out which.

        lost: why a set that the solver leaves unsolved has no metrics.
        """
        try:
            metrics, solved = solve(index)
        except GeometryError as error:
            if len(index) == 1:
                self.note[index] = str(error)
                return
            for half in np.array_split(index, 2):
                self.attempt(half, solve, lost)
            return
        self.note[index[~solved]] = lost
        for name, values in metrics.items():
            self.metrics[name][index[solved]] = values[solved]


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
    poses = [Pose(p.rotation.reshape(-1, 3, 3), p.position.reshape(-1, 3)) for p in batch.poses]
    uv = [uv.reshape(-1, *uv.shape[2:]) for uv in batch.uv]
    return _Sets(batch.landmark[of], batch.points[of], tuple(poses), tuple(uv))


def _model(batch: Batch, settings: SolverSettings) -> ForwardModel:
    if settings.lens:
        return model_of(settings.lens, 1.0, settings.svp)
    return model_of(batch.lens, batch.shift_scale, settings.svp)


def _chunks(index: Index) -> list[Index]:
    return [index[i:i + _TOGETHER] for i in range(0, len(index), _TOGETHER)]


def localizer(batch: Batch, settings: SolverSettings) -> Outcome:
    """Localize the camera of every set, as the localizer does."""
    sets, model = _sets(batch), _model(batch, settings)
    outcome = Outcome(len(sets.landmark), LOCALIZATION_METRICS)

    def solve(index: Index) -> tuple[Metrics, Mask]:
        solution = localize(model, sets.views(0, index, settings.sigma_px))
        true = sets.poses[0].take(index)
        metrics = localization_metrics(solution.pose, solution.residual, true)
        return metrics, solution.converged

    for index in _chunks(np.arange(len(sets.landmark))):
        outcome.attempt(index, solve, NO_POSE)
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

    def solve(index: Index) -> tuple[Metrics, Mask]:
        of = index // per_scenario
        rows = np.array([windows[scenario] for scenario in of])
        left, right = (sets.views(i, rows.ravel(), settings.sigma_px) for i in (0, 1))
        solution = calibrate_stereo(model, model, left, right, len(index))
        metrics = stereo_calibration_metrics(
            solution.rig, solution.left_residual, solution.right_residual, rig.take(of)
        )
        return metrics, solution.converged

    for number in range(per_scenario):
        index = np.arange(scenarios) * per_scenario + number
        before = [list(window) for window in windows]
        for window, one in zip(windows, index, strict=True):
            window[:] = [*window, int(one)][-settings.views:]
        lengths = np.array([len(window) for window in windows])
        for length in np.unique(lengths):
            for chunk in _chunks(index[lengths == length]):
                outcome.attempt(chunk, solve, NO_RIG)
        for scenario in np.flatnonzero(outcome.note[index] != ''):
            windows[scenario] = before[scenario]
    return outcome


def stereo_depth(batch: Batch, settings: StereoDepthSettings) -> Outcome:
    """Measure every set with the true rig, as stereo depth does."""
    sets, model, rig = _sets(batch), _model(batch, settings), batch.rig
    assert rig is not None
    triangulated = triangulate_optimally if settings.optimal else triangulate
    per_scenario = batch.uv[0].shape[1]
    outcome = Outcome(len(sets.landmark), STEREO_DEPTH_METRICS)

    def solve(index: Index) -> tuple[Metrics, Mask]:
        left, right = (uv[index] for uv in sets.uv)
        both = np.isfinite(np.concatenate([left, right], axis=-1)).all(axis=-1)
        rigs = rig.take(index[np.nonzero(both)[0]] // per_scenario)
        offset = epipolar_offset(model, model, rigs, left[both], right[both])
        distance, vertical = np.full((2, *both.shape), np.nan)
        distance[both], vertical[both] = offset.distance, offset.vertical
        points = np.full((*both.shape, 3), np.nan)
        points[both] = triangulated(model, model, rigs, left[both], right[both]).points
        true = sets.poses[1].take(index).into_body(sets.points[index])
        return stereo_depth_metrics(distance, vertical, points, true), np.asarray(both.any(axis=1))

    for index in _chunks(np.arange(len(sets.landmark))):
        outcome.attempt(index, solve, NO_PAIR)
    return outcome


class Solver(NamedTuple):
    """A solver node: its parameters, the names of its metrics, and what it does."""

    settings: type[SolverSettings]
    metrics: Sequence[str]
    solve: Callable[[Batch, Any], Outcome]


SOLVERS: Mapping[str, Solver] = {
    'localizer': Solver(SolverSettings, LOCALIZATION_METRICS, localizer),
    'stereo_calibrator': Solver(
        StereoCalibratorSettings, STEREO_CALIBRATION_METRICS, stereo_calibrator
    ),
    'stereo_depth': Solver(StereoDepthSettings, STEREO_DEPTH_METRICS, stereo_depth),
}
