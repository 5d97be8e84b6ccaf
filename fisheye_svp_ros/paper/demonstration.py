"""What the demo shows: the paper's scenarios, recorded or computed, beside what it prints."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.errors import BagError
from fisheye_svp_ros.io.columns import plain_columns
from fisheye_svp_ros.io.recording import NAMESPACE, ResidualSet, residual_sets
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.paper.tables import (
    CALIBRATION,
    ERROR2_RANGE,
    ERROR3_RANGE,
    LENSES,
    LOCALIZATION,
    RIGHT_CAMERA_Z,
    STYLE_NAMES,
)
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.rectify.cameras import camera_for
from fisheye_svp_ros.rectify.maps import RectifiedPair, rectify_pair
from fisheye_svp_ros.scene.observations import RADII, SPREADS, group_views
from fisheye_svp_ros.scene.rigs import rig
from fisheye_svp_ros.simulate.render import Exposure, Print, render
from fisheye_svp_ros.simulate.scenario import Scenario, model_of, scalars, simulate_scenario
from fisheye_svp_ros.solve.poses import solve_poses
from fisheye_svp_ros.study.settings import LocalizerSettings
from fisheye_svp_ros.study.solutions import residual_points
from fisheye_svp_ros.study.sweep import CAMERA, plan_sweep, sweep_rows

if TYPE_CHECKING:
    from pandas import DataFrame

# Poses of the right camera for depth, x, y, z, qx, qy, qz, qw: one a lens (section 5).
DEPTH_POSES = [[0.0, 0.0, RIGHT_CAMERA_Z.get(lens, 0.0), 1.0, 0.0, 0.0, 0.0] for lens in LENSES]
_MM, _DEGREE = 1e-3, np.radians(1.0)
_PAIR_RANGE = 0.5  # m, of the paper's nearer landmarks
_BOARD = Print(9, 6, 0.065)
_DIRECTION = np.array([0.0, -0.25, 0.9])  # the board, in the left camera: above the axes


class Task(NamedTuple):
    """One of the paper's three evaluations: namespace, what is swept beside lens and radius."""

    name: str
    title: str
    swept: str
    values: Sequence[str]
    node: str
    error: str
    pixels: str


TASKS = (
    Task(
        'localization',
        'Self-localization with the SVP model: position error along the axis, axis error, mean '
        'image residual',
        'environment',
        SPREADS,
        'localizer',
        'position_error_z_m',
        'mean_residual_px',
    ),
    Task(
        'calibration',
        'Stereo calibration with the SVP model: position and axis error of the left camera, and '
        'mean image residual. The errors depend on ten poses that Kita did not publish',
        'style',
        STYLE_NAMES,
        'stereo_calibrator',
        'position_error_m',
        'mean_residual_px',
    ),
    Task(
        'depth',
        'Stereo depth with the SVP model: mean distance from the true points (Error3) and from '
        'the epipolar curves (Error2). Kita published only ranges',
        'style',
        STYLE_NAMES,
        'stereo_depth',
        'error3_m',
        'error2_px',
    ),
)


class DemoRow(NamedTuple):
    """One row of the demo; m, rad, px; published: (lowest, highest), NaN where there is none.

    error: of the position along the axis (localization), of the left camera (calibration), of
    points (depth: Error3); pixels: mean residual, or Error2.
    """

    task: str
    lens: str
    radius: float
    where: str
    error: float
    axis_error: float
    pixels: float
    published_error: tuple[float, float]
    published_axis_error: float
    published_pixels: tuple[float, float]


def camera_parameters(task: Task, lenses: Sequence[str], radii: Sequence[float]) -> dict[str, Any]:
    """Return the camera's parameters for the scenarios of a task."""
    parameters: dict[str, Any] = {
        'sweep.lens': list(lenses),
        'sweep.radius': list(radii),
        f'sweep.{task.swept}': list(task.values),
    }
    if task.name == 'calibration':
        parameters['poses_file'] = 'calibration'
    if task.name == 'depth':
        parameters['poses'] = [number for pose in DEPTH_POSES for number in pose]
    return parameters


def compute_demo(
    lenses: Sequence[str], radii: Sequence[float]
) -> tuple[DataFrame, list[ResidualSet]]:
    """Return what the recording of the node graph would tell, computed offline: no stamps."""
    from pandas import concat

    parts = []
    for task in TASKS:
        plan = plan_sweep({CAMERA: camera_parameters(task, lenses, radii)})
        plan = plan._replace(solvers={task.node: plan.solvers[task.node]})
        parts.append(sweep_rows(plan, range(len(plan.sweep))))
        parts[-1].insert(0, NAMESPACE, f'/{task.name}')
    fields = [
        _residual_field(Scenario(lens=lens, radius=radius))
        for lens, radius in itertools.product(lenses, radii)
    ]
    return concat(parts, ignore_index=True), fields


def _residual_field(scenario: Scenario) -> ResidualSet:
    views = group_views(simulate_scenario(scenario).observations)
    model = model_of(scenario.lens, 1.0, LocalizerSettings().solves_svp)
    points = residual_points(solve_poses(model, views, examined=False).require())
    tags = {name: str(value) for name, value in scalars(scenario).items()}
    return ResidualSet('/localization/localizer/residuals', 0, points, tags)


def demo_rows(table: DataFrame, lenses: Sequence[str], radii: Sequence[float]) -> list[DemoRow]:
    """Return the rows of the demo from its table, as `tabulate` or `compute_demo` make it.

    Raises BagError where a scenario is missing or is listed twice.
    """
    found: dict[tuple[str, str, float, str], dict[str, Any]] = {}
    columns = plain_columns(table)
    for cells in zip(*columns.values(), strict=True):
        row = dict(zip(columns, cells, strict=True))
        task = next((t for t in TASKS if row[NAMESPACE] == f'/{t.name}'), None)
        if task is None or not _is_shown(task, row):
            continue
        key = task.name, row['lens'], row['radius'], row[task.swept]
        if key in found:
            raise BagError(f'scenario {key} was recorded twice')
        found[key] = row
    rows = []
    for lens, task, radius in itertools.product(lenses, TASKS, radii):
        for where in task.values:
            if (task.name, lens, radius, where) not in found:
                raise BagError(
                    f'no result of {task.node} for {lens}, {where}, {radius} m; see '
                    'the logs next to the recording'
                )
            rows.append(_row(task, lens, radius, where, found[task.name, lens, radius, where]))
    return rows


def residual_fields(records: Iterable[Any]) -> list[ResidualSet]:
    """Return the residuals of every localization with the whole environment (figure 6)."""
    return [
        residuals
        for residuals in residual_sets(records)
        if residuals.tags.get('environment') == 'whole'
    ]


def _is_shown(task: Task, row: dict[str, Any]) -> bool:
    if task.name == 'depth':
        return bool(row['set'] == LENSES.index(row['lens']))
    return bool(row['set'] == row['sets'] - 1)


def _row(task: Task, lens: str, radius: float, where: str, row: dict[str, Any]) -> DemoRow:
    def metric(name: str) -> float:
        value = row.get(f'{task.node}.{name}')
        return np.nan if value is None else float(value)

    error, axis, pixels = _published_cells(task, lens, radius, where)
    return DemoRow(
        task.name,
        lens,
        radius,
        where,
        metric(task.error),
        metric('axis_error_rad'),
        metric(task.pixels),
        error,
        axis,
        pixels,
    )


def _published_cells(
    task: Task, lens: str, radius: float, where: str
) -> tuple[tuple[float, float], float, tuple[float, float]]:
    """Return error, m, axis error, rad, and px; for depth the paper gives ranges."""
    if task.name == 'depth':
        lowest, highest = ERROR3_RANGE[lens]
        return (lowest * _MM, highest * _MM), np.nan, ERROR2_RANGE[lens]
    table = LOCALIZATION if task.name == 'localization' else CALIBRATION
    x, y, z, axis, residual = table[
        LENSES.index(lens), RADII.index(radius), task.values.index(where)
    ]
    error = z if task.name == 'localization' else np.sqrt(x * x + y * y + z * z)
    return (error * _MM,) * 2, float(axis * _DEGREE), (float(residual),) * 2


def rectified_pair(lens: Lens) -> tuple[RectifiedPair, tuple[NDArray[Any], ...]]:
    """Return the pair of two cameras with the lens, and their rectified photographs."""
    place, rig_pose = _board_in_left(), rig('vergent')
    camera = camera_for([lens], 'pinhole', (640, 480), np.radians(110.0), along_baseline=True)
    pair = rectify_pair(lens, lens, rig_pose, camera, _PAIR_RANGE)
    left = place.inverse()
    images = [
        side.remap(render(lens, _BOARD, pose, Exposure(), np.random.default_rng(0)))
        for side, pose in ((pair.left, left), (pair.right, left.compose(rig_pose.inverse())))
    ]
    return pair, tuple(images)


def _board_in_left() -> Pose:
    """Return the board, which faces the left camera."""
    ahead: Array = _DIRECTION / np.linalg.norm(_DIRECTION)
    right = np.cross([0.0, 1.0, 0.0], ahead)
    right /= np.linalg.norm(right)
    turn = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    return Pose(turn, _PAIR_RANGE * ahead - turn @ _BOARD.corners.mean(axis=0))
