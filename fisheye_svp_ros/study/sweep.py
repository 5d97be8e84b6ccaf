"""The offline sweep: the rows that the node graph would tell, in batches, on any executor."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from fisheye_svp_ros import __version__
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.io.parameters import SWEEP, Sweep, rows, sweep_of, with_values
from fisheye_svp_ros.io.recording import Columns
from fisheye_svp_ros.optics import engines
from fisheye_svp_ros.scene.rigs import STYLES
from fisheye_svp_ros.simulate.scenario import (
    MONO,
    SCALARS,
    Batch,
    Scenario,
    check_sweep,
    model_of,
    scalars,
    scenario_landmarks,
    scenario_poses,
    simulate_batches,
    true_lens,
)
from fisheye_svp_ros.study.settings import (
    SolverSettings,
    StereoDepthSettings,
    SyntheticCameraSettings,
)
from fisheye_svp_ros.study.sweep_solvers import SOLVERS

CAMERA = 'synthetic_camera'
TABLES: Mapping[str, type[Any]] = {
    CAMERA: SyntheticCameraSettings, **{name: s.settings for name, s in SOLVERS.items()}
}
_MONO_SOLVERS = ('localizer',)
SCENARIO_COLUMNS = ('scenario', 'scenarios', 'set', 'sets')
_EVALUATIONS = 10  # of all points, to solve a set
_SETS_PER_TASK = 512  # sets a task: enough to solve them fast together, few enough to lose


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
        name: with_values(SOLVERS[name].settings(), parameters.get(name, {})) for name in names}
    for name, table in tables.items():
        if isinstance(table, StereoDepthSettings) and table.rig != StereoDepthSettings.rig:
            raise ParameterError(f'{name}: rig is {table.rig!r}; a sweep measures with the true '
                                 'rig, not with one from a topic')
        if table.lens:
            model_of(table.lens, 1.0, table.solves_svp)
    check_sweep(base, sweep)
    return Plan(base, sweep, tables)


def solvers_of(base: Scenario, sweep: Sweep) -> tuple[str, ...]:
    """Return the solver nodes of a sweep; raise ParameterError where scenarios differ in them."""
    if base.rig_file:
        raise ParameterError(f'{CAMERA}: rig_file names a rig; an offline sweep simulates one '
                             'camera or a pair: leave rig_file out, and choose a style')
    mono = {style == MONO for style in sweep.lists.get('style', (base.style,))}
    if len(mono) > 1:
        raise ParameterError(f'{SWEEP}style has {MONO} together with rigs; make two sweeps of it')
    return _MONO_SOLVERS if mono.pop() else ('stereo_calibrator', 'stereo_depth')


def idle_solvers(plan: Plan, nodes: Iterable[str]) -> list[str]:
    """Return a sentence for each node that has nothing to solve in a sweep."""
    *others, last = STYLES
    needed = {node: MONO if node in _MONO_SOLVERS else f'{", ".join(others)} or {last}'
              for node in nodes if node not in (CAMERA, *plan.solvers)}
    return [f'{node} solves nothing in this sweep: it needs style {style}'
            for node, style in needed.items()]


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


def work(plan: Plan) -> int:
    """Return about how many points a sweep will project, for `engines.settle`."""
    scenario = _scenario(plan, 0)
    sets, cameras = len(scenario_poses(scenario).position), len(plan.solvers)
    return len(plan.sweep) * sets * cameras * len(scenario_landmarks(scenario).ids) * _EVALUATIONS


def sweep_rows(plan: Plan, numbers: range) -> Columns:
    """Return the rows of some scenarios, one a set, in their order; None where nothing is known.

    Raises FisheyeSvpError for a scenario that cannot be simulated.
    """
    scenarios = [_scenario(plan, number) for number in numbers]
    parts = [
        _columns(plan, scenarios, numbers.start, batch)
        for batch in simulate_batches(scenarios, numbers.start)
    ]
    whole = {name: [cell for part in parts for cell in part[name]] for name in column_types(plan)}
    order = np.lexsort((whole['set'], whole['scenario']))
    return {name: [cells[i] for i in order] for name, cells in whole.items()}


def solve_sweep(
    plan: Plan, remaining: Iterable[range], engine: str, executor: Executor, ahead: int
) -> Iterator[tuple[range, Columns]]:
    """Yield tasks and their rows as they are done; no more than `ahead` are under way at once.

    engine: the one that all rows come from, whoever works on them.
    """
    under_way: dict[Future[Columns], range] = {}

    def completed_tasks() -> Iterator[tuple[range, Columns]]:
        for future in wait(under_way, return_when=FIRST_COMPLETED).done:
            yield under_way.pop(future), future.result()

    for numbers in remaining:
        under_way[executor.submit(_rows_of, engine, plan, numbers)] = numbers
        if len(under_way) >= ahead:
            yield from completed_tasks()
    while under_way:
        yield from completed_tasks()


def _rows_of(engine: str, plan: Plan, numbers: range) -> Columns:
    engines.use(engine)
    return sweep_rows(plan, numbers)


class InProcess(Executor):
    """An executor that does each task where and when it is submitted."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Return a future that is done."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def fingerprint(plan: Plan) -> str:
    """Return what tells a sweep from any other: parameters and what their files hold."""
    parts: list[Any] = [__version__, plan.base, dict(plan.sweep.lists), dict(plan.solvers)]
    for name in ('lens', 'environment', 'poses_file'):
        for value in plan.sweep.lists.get(name, (getattr(plan.base, name),)):
            scenario = replace(plan.base, **{name: value})
            landmarks, poses = scenario_landmarks(scenario), scenario_poses(scenario)
            parts += [true_lens(scenario.lens), landmarks.ids.tolist(), landmarks.points.tolist(),
                      poses.position.tolist(), poses.rotation.tolist()]
    parts += [true_lens(table.lens) for table in plan.solvers.values() if table.lens]
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def _scenario(plan: Plan, number: int) -> Scenario:
    return replace(plan.base, **plan.sweep.point(number))


def _columns(plan: Plan, scenarios: list[Scenario], first: int, batch: Batch) -> Columns:
    sets = batch.uv[0].shape[1]
    columns: Columns = {
        'scenario': [first + int(row) for row in batch.row for _ in range(sets)],
        'scenarios': [len(plan.sweep)] * (sets * len(batch.row)),
        'set': list(range(sets)) * len(batch.row),
        'sets': [sets] * (sets * len(batch.row)),
    }
    tags = [scalars(scenarios[row]) for row in batch.row]
    columns |= {name: [tag[name] for tag in tags for _ in range(sets)] for name in SCALARS}
    for node, settings in plan.solvers.items():
        outcome = SOLVERS[node].solve(batch, settings)
        notes = outcome.note.tolist()
        for name, values in outcome.metrics.items():
            columns[f'{node}.{name}'] = [
                None if note else v for v, note in zip(values.tolist(), notes, strict=True)]
        columns[f'{node}.note'] = [note or None for note in notes]
    return columns
