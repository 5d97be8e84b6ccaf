"""Kita's evaluation: self-localization, stereo calibration and stereo measurement, numbers only.

Image points come from one lens, the solver is given another, by default the same one without its
viewpoint shift.  Rows of tables are (x, y, z, axis, residual) in mm, mm, mm, degree and px, as the
paper prints them, in the paper's frames (x right, y up, camera gazing along -z).
"""

from __future__ import annotations

from functools import cache
from itertools import combinations
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.io.landmark_files import environment
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.paper.tables import CAPTIONS, PANELS, RIGHT_CAMERA_Z, STYLE_NAMES
from fisheye_svp_ros.pose import PAPER_FROM_OPTICAL, Pose
from fisheye_svp_ros.scene.observations import RADII, SPREADS, Views, views_of
from fisheye_svp_ros.scene.rigs import calibration_poses, paper_pose, rig
from fisheye_svp_ros.solve.localization import Localization
from fisheye_svp_ros.solve.poses import solve_poses
from fisheye_svp_ros.solve.stereo_calibration import StereoCalibration
from fisheye_svp_ros.study.solutions import (
    Metrics,
    localization_metrics,
    measure_points,
    solve_rigs,
)


class LocalizedSpread(NamedTuple):
    """E environments localized.  rows (E, 5); solved; views: what was seen of the landmarks."""

    rows: Array
    solved: Localization
    views: Views


class StereoMeasurement(NamedTuple):
    """Stereo measurement of N landmarks, NaN where a camera does not see one (section 5).

    uv_left, uv_right (N, 2), px; foot (N, 2), px: nearest point of the epipolar curve; distance,
    vertical (N,), px: to the curve, and to it in the same column; true, measured (N, 3), m, world;
    metrics: Error2 in both readings and Error3, see `study.solutions.stereo_depth_metrics`.
    """

    uv_left: Array
    uv_right: Array
    foot: Array
    distance: Array
    vertical: Array
    true: Array
    measured: Array
    metrics: dict[str, float]


class LensEvaluation(NamedTuple):
    """All of the paper's numbers for one lens and one solver.

    localization, calibration (3 radii, 3 spreads or styles, 5): tables 1 and 3, or 2 and 4;
    localized: one a spread; measured: one a panel of figure 9 or 10, in the order of PANELS.
    """

    lens: Lens
    localization: Array
    calibration: Array
    localized: tuple[LocalizedSpread, ...]
    measured: tuple[StereoMeasurement, ...]

    def panels(self, metric: str) -> Array:
        """Return a stereo depth metric of the nine panels, (9,)."""
        return np.array([measured.metrics[metric] for measured in self.measured])


def landmarks_at(spread: str, radius: float) -> Array:
    """Return the landmarks (N, 3) of an environment, m."""
    return radius * _directions(spread)


@cache
def _directions(spread: str) -> Array:
    return environment(spread, 1.0).points


def evaluate(lens: Lens, solver: Lens | None = None) -> LensEvaluation:
    """Evaluate a lens with a solver that believes another one, by default the SVP lens."""
    localized = localize_spreads(lens, solver)
    return LensEvaluation(
        lens,
        np.stack([spread.rows for spread in localized], axis=1),
        calibrate_rigs(lens, solver)[0],
        localized,
        tuple(measure(lens, radius, style, solver) for radius, style in PANELS),
    )


def localize_environments(
    lens: Lens, points: Array, solver: Lens | None = None, start: Pose | None = None
) -> LocalizedSpread:
    """Localize the paper's camera among landmarks (E, N, 3), m (section 3).

    start (E,): poses to start from, the true one by default.
    """
    true = paper_pose(len(points))
    views = views_of(points, ForwardModel(lens).predict(true, views_of(points)).uv)
    model = ForwardModel(lens.svp() if solver is None else solver)
    solved = solve_poses(model, views, true if start is None else start, examined=False)
    return LocalizedSpread(_paper_rows(localization_metrics(solved, true)), solved.result, views)


def localize_spreads(lens: Lens, solver: Lens | None = None) -> tuple[LocalizedSpread, ...]:
    """Localize at the three radii, one result a spread: Whole, Inner, Outer."""
    return tuple(
        localize_environments(
            lens, np.stack([landmarks_at(spread, radius) for radius in RADII]), solver
        )
        for spread in SPREADS
    )


def calibrate_rigs(
    lens: Lens,
    solver: Lens | None = None,
    poses: Pose | None = None,
    directions: Array | None = None,
) -> tuple[Array, StereoCalibration]:
    """Return table 3 or 4, rows (3 radii, 3 styles, 5), and the nine solved systems (section 4).

    poses (V,): of the right camera in the world, `rig.calibration_poses` by default; directions
    (N, 3), unit: of the landmarks, Whole by default.
    """
    directions = landmarks_at('whole', 1.0) if directions is None else directions
    right = calibration_poses() if poses is None else poses
    systems = [(radius, rig(style)) for radius in RADII for style in STYLE_NAMES]
    views: list[list[Views]] = [[], []]
    model = ForwardModel(lens)
    for radius, left_in_right in systems:
        points = radius * directions
        left = right.compose(left_in_right.broadcast_to(*right.shape))
        for seen, pose in zip(views, (left, right), strict=True):
            blank = views_of(points, np.zeros((len(right.position), len(points), 2)))
            seen.append(views_of(points, model.predict(pose, blank).uv))
    left_views, right_views = map(Views.concatenate, views)
    solving_model = ForwardModel(lens.svp() if solver is None else solver)
    solved = solve_rigs(
        (solving_model, solving_model),
        left_views,
        right_views,
        len(systems),
        Pose.stack([true for _, true in systems]),
    )
    table = _paper_rows(solved.metrics)
    table[:, :3] = table[:, :3] @ PAPER_FROM_OPTICAL
    return table.reshape(len(RADII), len(STYLE_NAMES), -1), solved.solution


def measure(
    lens: Lens, radius: float, style: str, solver: Lens | None = None
) -> StereoMeasurement:
    """Measure the Whole landmarks with a rig that is known (section 5, figures 9 and 10)."""
    home = paper_pose(1)
    ahead = np.array([0.0, 0.0, RIGHT_CAMERA_Z.get(lens.name, 0.0)])
    right = Pose(home.rotation, home.position + ahead)
    left_in_right = rig(style)
    points = landmarks_at('whole', radius)
    blank = views_of(points)
    model = ForwardModel(lens)
    uv_right = model.predict(right, blank).uv
    uv_left = model.predict(right.compose(left_in_right.take(None)), blank).uv
    solving_model = ForwardModel(lens.svp() if solver is None else solver)
    solved = measure_points(
        (solving_model, solving_model),
        left_in_right.take(None),
        uv_left,
        uv_right,
        right.into_body(points),
    )
    calibration = solved.solution
    return StereoMeasurement(
        uv_left[0],
        uv_right[0],
        calibration.foot[0],
        calibration.distance[0],
        calibration.vertical[0],
        points,
        calibration.points[0] @ right.rotation[0].T + right.position[0],
        {name: float(value[0]) for name, value in solved.metrics.items()},
    )


def captions_of(lens: str, error2: Array, error3: Array) -> dict[int, tuple[float, float]]:
    """Find which panel (index in PANELS) each printed caption belongs to.

    error2 (9,), px, and error3 (9,), mm: ours.  The text of the paper kept five captions of nine
    panels, in printed order; of the orders that agree with that the nearest one in log is taken.
    """
    printed = np.array(CAPTIONS[lens])
    off = np.log(printed[:, None, :] / np.stack([error2, error3], axis=-1)) ** 2
    off = off.sum(axis=-1)
    best = min(
        combinations(range(len(PANELS)), len(printed)),
        key=lambda panels: float(off[range(len(printed)), panels].sum()),
    )
    return {panel: CAPTIONS[lens][i] for i, panel in enumerate(best)}


def _paper_rows(metrics: Metrics) -> Array:
    """Return rows (E, 5) in the paper's units."""
    position = [1000 * metrics[f'position_error_{axis}_m'] for axis in 'xyz']
    return np.column_stack(
        [*position, np.degrees(metrics['axis_error_rad']), metrics['mean_residual_px']]
    )
