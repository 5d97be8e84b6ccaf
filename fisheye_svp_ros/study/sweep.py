"""The offline sweep: the rows that the node graph would tell, in batches, on any executor."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np

from fisheye_svp_ros import __version__
from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import GeometryError, ParameterError
from fisheye_svp_ros.io.columns import TableParts
from fisheye_svp_ros.io.parameters import SWEEP, Sweep, rows, sweep_of, with_values
from fisheye_svp_ros.optics import engines
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Views, views_of
from fisheye_svp_ros.scene.rigs import STYLES
from fisheye_svp_ros.simulate.scenario import (
    MONO,
    SCALARS,
    Scenario,
    ScenarioBatch,
    check_sweep,
    model_of,
    scalars,
    scenario_landmarks,
    scenario_poses,
    simulate_batches,
    true_lens,
)
from fisheye_svp_ros.solve.poses import solve_poses
from fisheye_svp_ros.solve.solved_poses import NO_POSE, gate_reason
from fisheye_svp_ros.study.settings import (
    LocalizerSettings,
    SolverSettings,
    StereoCalibratorSettings,
    StereoDepthSettings,
    SyntheticCameraSettings,
)
from fisheye_svp_ros.study.solutions import (
    LOCALIZATION_METRICS,
    STEREO_CALIBRATION_METRICS,
    STEREO_DEPTH_METRICS,
    SetSolutions,
    localization_metrics,
    measure_points,
    solve_rigs,
)

if TYPE_CHECKING:
    from pandas import DataFrame

_SETS_PER_SOLVE = 512  # sets solved at once: more take more memory and no less time

_Solve = Callable[[Index], SetSolutions[Any]]  # the sets of an index (A,)
S = TypeVar('S', bound=SolverSettings)
CAMERA = 'synthetic_camera'
_MONO_SOLVERS = ('localizer',)
SCENARIO_COLUMNS = ('scenario', 'scenarios', 'set', 'sets')
_EVALUATIONS = 10  # of all points, to solve a set
_SETS_PER_TASK = 512  # sets a task: enough to solve them fast together, few enough to lose


class Outcome:
    """Metrics (T,) of T sets by name; note (T,) says why a set has none, '' where it has."""

    def __init__(self, count: int, names: Sequence[str]) -> None:
        self.metrics = {name: np.full(count, np.nan) for name in names}
        self.note = np.full(count, '', dtype=object)

    def attempt(self, index: Index, solve: _Solve, gate: float = 0.0) -> None:
        """Solve sets together; where one of them spoils it, find out which.

        gate: sigmas above which the residuals of a set count as no solution; 0: no limit.
        """
        try:
            solution = solve(index)
        except GeometryError as error:
            if len(index) == 1:
                from fisheye_svp_ros.io.recording import note_of_set  # with rosbags, seldom

                self.note[index] = note_of_set(str(error))
                return
            for half in np.array_split(index, 2):
                self.attempt(half, solve, gate)
            return
        solved = solution.solved & solution.passes(gate)
        self.note[index[~solution.passes(gate)]] = gate_reason(gate)
        self.note[index[~solution.solved]] = solution.unsolved
        for name, values in solution.metrics.items():
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


def _sets(batch: ScenarioBatch) -> _Sets:
    scenarios, sets = batch.uv[0].shape[:2]
    of = np.repeat(np.arange(scenarios), sets)
    poses = [pose.reshape(-1) for pose in batch.poses]
    uv = [uv.reshape(-1, *uv.shape[2:]) for uv in batch.uv]
    return _Sets(batch.landmark[of], batch.points[of], tuple(poses), tuple(uv))


def _solver_model(batch: ScenarioBatch, settings: SolverSettings) -> ForwardModel:
    if settings.lens:
        return model_of(settings.lens, 1.0, settings.solves_svp)
    return model_of(batch.lens, batch.shift_scale, settings.solves_svp)


def _chunks(index: Index) -> list[Index]:
    return [index[i : i + _SETS_PER_SOLVE] for i in range(0, len(index), _SETS_PER_SOLVE)]


def localizer(batch: ScenarioBatch, settings: LocalizerSettings) -> Outcome:
    """Localize the camera of every set, as the localizer does."""
    sets, model = _sets(batch), _solver_model(batch, settings)
    outcome = Outcome(len(sets.landmark), LOCALIZATION_METRICS)

    def solve(index: Index) -> SetSolutions[Any]:
        views = sets.views(0, index, settings.sigma_px)
        found = solve_poses(model, views, examined=False)
        return SetSolutions(
            found,
            localization_metrics(found, sets.poses[0].take(index)),
            found.result.converged,
            NO_POSE,
            sigmas=found.sigmas,
        )

    for index in _chunks(np.arange(len(sets.landmark))):
        outcome.attempt(index, solve, settings.gate)
    return outcome


def stereo_calibrator(batch: ScenarioBatch, settings: StereoCalibratorSettings) -> Outcome:
    """Calibrate after every set from those of its scenario so far, as the stereo calibrator does.

    A set that cannot be used is left out of those that come after it.
    """
    sets, model, rig = _sets(batch), _solver_model(batch, settings), batch.rig
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
        for window, latest in zip(windows, index, strict=True):
            window[:] = [*window, int(latest)][-settings.views :]
        lengths = np.array([len(window) for window in windows])
        for length in np.unique(lengths):
            for chunk in _chunks(index[lengths == length]):
                outcome.attempt(chunk, solve, settings.gate)
        for scenario in np.flatnonzero(outcome.note[index] != ''):
            windows[scenario] = before[scenario]
    return outcome


def solve_stereo_depth(batch: ScenarioBatch, settings: StereoDepthSettings) -> Outcome:
    """Measure every set with the true rig, as stereo depth does."""
    sets, model, rig = _sets(batch), _solver_model(batch, settings), batch.rig
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
    solve: Callable[[ScenarioBatch, Any], Outcome]


SOLVERS: Mapping[str, Solver] = {
    'localizer': Solver(LocalizerSettings, LOCALIZATION_METRICS, localizer),
    'stereo_calibrator': Solver(
        StereoCalibratorSettings, STEREO_CALIBRATION_METRICS, stereo_calibrator
    ),
    'stereo_depth': Solver(StereoDepthSettings, STEREO_DEPTH_METRICS, solve_stereo_depth),
}
TABLES: Mapping[str, type[Any]] = {
    CAMERA: SyntheticCameraSettings,
    **{name: s.settings for name, s in SOLVERS.items()},
}


class Plan(NamedTuple):
    """A sweep: what all scenarios share, the lists that are swept, and who solves, by node."""

    base: Scenario
    sweep: Sweep
    solvers: Mapping[str, SolverSettings]


def plan_sweep(parameters: Mapping[str, Mapping[str, Any]]) -> Plan:
    """Return the sweep that parameters of nodes, by node and name, ask for.

    One camera is localized; a rig is calibrated and measured with.
    Raises ParameterError for an unknown parameter, an empty list or a value that is not allowed,
    and FisheyeSvpError for a lens, landmarks or poses that cannot be used.
    """
    camera = parameters.get(CAMERA, {})
    base, sweep = with_values(Scenario(), camera), sweep_of(Scenario, camera, ('rig_file',))
    if not sweep.lists:
        raise ParameterError('no parameter is swept; add a list such as sweep.radius: [2.0, 0.5]')
    with_values(TABLES[CAMERA](), camera)  # what the node would refuse
    names = solvers_of(base, sweep)
    tables = {
        name: with_values(SOLVERS[name].settings(), parameters.get(name, {})) for name in names
    }
    for name, table in tables.items():
        if isinstance(table, StereoDepthSettings) and table.rig != StereoDepthSettings.rig:
            raise ParameterError(
                f'{name}: rig is {table.rig!r}; a sweep measures with the true '
                'rig, not with one from a topic'
            )
        if table.lens:
            model_of(table.lens, 1.0, table.solves_svp)
    check_sweep(base, sweep)
    return Plan(base, sweep, tables)


def solvers_of(base: Scenario, sweep: Sweep) -> tuple[str, ...]:
    """Return the solver nodes of a sweep; raise ParameterError where scenarios differ in them."""
    if base.rig_file:
        raise ParameterError(
            f'{CAMERA}: rig_file names a rig; an offline sweep simulates one '
            'camera or a pair: leave rig_file out, and choose a style'
        )
    mono = {style == MONO for style in sweep.lists.get('style', (base.style,))}
    if len(mono) > 1:
        raise ParameterError(f'{SWEEP}style has {MONO} together with rigs; make two sweeps of it')
    return _MONO_SOLVERS if mono.pop() else ('stereo_calibrator', 'stereo_depth')


def idle_solvers(plan: Plan, nodes: Iterable[str]) -> list[str]:
    """Return a sentence for each node that has nothing to solve in a sweep."""
    *styles, last = STYLES
    needed = {
        node: MONO if node in _MONO_SOLVERS else f'{", ".join(styles)} or {last}'
        for node in nodes
        if node not in (CAMERA, *plan.solvers)
    }
    return [
        f'{node} solves nothing in this sweep: it needs style {style}'
        for node, style in needed.items()
    ]


def column_types(plan: Plan) -> dict[str, type]:
    """Return the columns of the rows of a sweep: names as in a table of a recording, and types."""
    kinds = {row.name: type(row.default) for row in rows(Scenario)}
    columns: dict[str, type] = dict.fromkeys(SCENARIO_COLUMNS, int)
    columns |= {name: kinds[name] for name in SCALARS}
    for node in plan.solvers:
        columns |= {f'{node}.{name}': float for name in SOLVERS[node].metrics}
        columns[f'{node}.note'] = str
    return columns


def tasks(plan: Plan) -> list[range]:
    """Return the numbers of the scenarios of each task: the same whoever works on them."""
    sets = len(scenario_poses(_scenario(plan, 0)).position)
    count, step = len(plan.sweep), max(1, _SETS_PER_TASK // sets)
    return [range(start, min(start + step, count)) for start in range(0, count, step)]


def part_check(plan: Plan) -> Callable[[int, DataFrame], bool]:
    """Return what tells whether a task's part of the table, by its number, has all its rows."""
    scenarios = {numbers.start: len(numbers) for numbers in tasks(plan)}

    def is_whole(number: int, part: DataFrame) -> bool:
        firsts = part.drop_duplicates('scenario')
        return len(firsts) == scenarios.get(number) and firsts['sets'].sum() == len(part)

    return is_whole


def work(plan: Plan) -> int:
    """Return about how many points a sweep will project, for `engines.settle`."""
    scenario = _scenario(plan, 0)
    sets, cameras = len(scenario_poses(scenario).position), len(plan.solvers)
    return len(plan.sweep) * sets * cameras * len(scenario_landmarks(scenario).ids) * _EVALUATIONS


def sweep_rows(plan: Plan, numbers: range) -> DataFrame:
    """Return the rows of some scenarios, one a set, in their order; NaN where nothing is known.

    Raises FisheyeSvpError for a scenario that cannot be simulated.
    """
    from pandas import concat

    scenarios = [_scenario(plan, number) for number in numbers]
    parts = [
        _batch_rows(plan, scenarios, numbers.start, batch)
        for batch in simulate_batches(scenarios, numbers.start)
    ]
    whole = concat(parts) if len(parts) > 1 else parts[0]
    return whole.sort_values(['scenario', 'set'], ignore_index=True)[[*column_types(plan)]]


def solve_rows(engine: str, plan: Plan, numbers: range) -> DataFrame:
    """Return rows as `sweep_rows` does, by the engine that all rows of a sweep come from."""
    engines.use(engine)
    return sweep_rows(plan, numbers)


def write_rows(parts: TableParts, engine: str, plan: Plan, numbers: range) -> None:
    """Write rows as a part of the table, in the process that made them."""
    parts.write(numbers.start, solve_rows(engine, plan, numbers))


def fingerprint(plan: Plan) -> str:
    """Return what tells a sweep from any other: parameters and what their files hold."""
    parts: list[Any] = [__version__, plan.base, dict(plan.sweep.lists), dict(plan.solvers)]
    for name in ('lens', 'environment', 'poses_file'):
        for value in plan.sweep.lists.get(name, (getattr(plan.base, name),)):
            scenario = replace(plan.base, **{name: value})
            landmarks, poses = scenario_landmarks(scenario), scenario_poses(scenario)
            parts += [
                true_lens(scenario.lens),
                landmarks.ids.tolist(),
                landmarks.points.tolist(),
                poses.position.tolist(),
                poses.rotation.tolist(),
            ]
    parts += [true_lens(table.lens) for table in plan.solvers.values() if table.lens]
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def _scenario(plan: Plan, number: int) -> Scenario:
    return replace(plan.base, **plan.sweep.point(number))


def _batch_rows(
    plan: Plan, scenarios: list[Scenario], first: int, batch: ScenarioBatch
) -> DataFrame:
    from pandas import DataFrame

    kinds, sets = column_types(plan), batch.uv[0].shape[1]
    tags = [scalars(scenarios[row]) for row in batch.row]
    columns: dict[str, Any] = {
        'scenario': np.repeat(first + np.asarray(batch.row), sets),
        'scenarios': len(plan.sweep),
        'set': np.tile(np.arange(sets), len(tags)),
        'sets': sets,
    }
    for name in SCALARS:
        kind = object if kinds[name] is str else kinds[name]
        columns[name] = np.repeat(np.array([tag[name] for tag in tags], dtype=kind), sets)
    for node, settings in plan.solvers.items():
        outcome = SOLVERS[node].solve(batch, settings)
        columns |= {f'{node}.{name}': values for name, values in outcome.metrics.items()}
        columns[f'{node}.note'] = [note or None for note in outcome.note]
    return DataFrame(columns)
