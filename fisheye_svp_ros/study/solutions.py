"""Metrics of solved sets, one or many at once; rigs and points that stereo cameras measure.

Metrics carry their unit in the name, batch first: dictionaries of arrays (S,).  What needs the
truth is absent without it.
"""

from __future__ import annotations

from typing import Generic, NamedTuple, TypeVar

import numpy as np

from fisheye_svp_ros.arrays import Array, Mask, scatter
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.io.decoding import RESIDUALS, Points, structured_array
from fisheye_svp_ros.pose import Pose, axis_angle_between
from fisheye_svp_ros.scene.observations import Views
from fisheye_svp_ros.solve.least_squares import misfit_fails
from fisheye_svp_ros.solve.localization import sight
from fisheye_svp_ros.solve.reliability import misfit_reason
from fisheye_svp_ros.solve.solved_poses import SolvedPoses, gate_reason
from fisheye_svp_ros.solve.stereo_calibration import StereoCalibration, calibrate_stereo
from fisheye_svp_ros.solve.stereo_depth import epipolar_offset, triangulate, triangulate_optimally
from fisheye_svp_ros.solve.weak_geometry import is_ambiguous, pose_odds

T = TypeVar('T')
Pair = tuple[ForwardModel, ForwardModel]  # of the left and the right camera

_NO_RIG = 'image_points: they do not determine a rig'
_NO_PAIR = 'image_points: no landmark is in both images'
Metrics = dict[str, Array]

FIT_METRICS = ('points', 'rms_px', 'mean_residual_px')
_POSE_ERRORS = (
    'position_error_m',
    'position_error_x_m',
    'position_error_y_m',
    'position_error_z_m',
    'rotation_error_rad',
    'axis_error_rad',
)
LOCALIZATION_METRICS = (*FIT_METRICS, *_POSE_ERRORS, 'odds', 'ambiguous')
STEREO_CALIBRATION_METRICS = ('views', *FIT_METRICS, *_POSE_ERRORS)
STEREO_DEPTH_METRICS = (
    'points',
    'error2_px',
    'error2_vertical_px',
    'error2_max_px',
    'error3_m',
    'error3_max_m',
)
# Those that pictures of sweeps and recordings show, in this order; tables hold all.
DRAWN_METRICS = ('position_error_m', 'axis_error_rad', 'rms_px', 'error3_m', 'error2_px')


class Measurement(NamedTuple):
    """N matched landmarks of each of S sets, NaN where a camera does not see one.

    points (S, N, 3), m, in the right camera's frame; distance, vertical (S, N), px, of the left
    image point from the epipolar curve, whose nearest point is foot (S, N, 2).
    """

    points: Array
    distance: Array
    vertical: Array
    foot: Array


class SetSolutions(NamedTuple, Generic[T]):
    """Rigs, or points, of S sets and their metrics, arrays (S,) by name.

    solved (S,); unsolved: why the others have no solution; reasons (S,): why a solution should
    not be relied on, '' for a reliable one, all of them where that was not examined; sigmas (S,):
    root mean square of the residuals, whitened, by degrees of freedom.
    """

    solution: T
    metrics: Metrics
    solved: Mask
    unsolved: str
    reasons: tuple[str, ...] = ('',)
    sigmas: Array = np.zeros(1)

    def require(self, gate: float = 0.0) -> SetSolutions[T]:
        """Return it as it is; raise GeometryError where a set has no solution.

        gate: nor where its residuals are above this many sigmas; 0: no limit.
        """
        if not self.solved.all():
            raise GeometryError(self.unsolved)
        if not self.passes(gate).all():
            raise GeometryError(gate_reason(gate, float(self.sigmas.max())))
        return self

    def passes(self, gate: float) -> Mask:
        """Say of which sets (S,) the residuals are no more than `gate` sigmas; 0: of all."""
        return np.asarray(self.sigmas <= gate) if gate else np.ones(self.solved.shape, dtype=bool)


def residual_points(solved: SolvedPoses) -> Points:
    """Return the residuals of one set (1,): px; incidence angle, rad, and range, m, as solved."""
    views = solved.views
    theta, distance = sight(solved.model, solved.pose, views)
    columns = (*views.uv[0].T, *solved.result.residual[0].T, theta[0], distance[0])
    return structured_array(RESIDUALS, views.landmark[0], *columns)


def solve_rigs(
    models: Pair, left: Views, right: Views, systems: int = 1, true: Pose | None = None
) -> SetSolutions[StereoCalibration]:
    """Calibrate S rigs of S * V views; models: left, right; true (S,); raise GeometryError."""
    calibration = calibrate_stereo(*models, left, right, systems)
    metrics = stereo_calibration_metrics(
        calibration.rig, calibration.left_residual, calibration.right_residual, true
    )
    points = [(view.weight > 0).reshape(systems, -1).sum(axis=1) for view in (left, right)]
    freedom = 2 * sum(points) - 6 * (calibration.pose.shape[1] + 1)
    reasons = tuple(
        misfit_reason(float(cost) / max(int(free), 1), int(free)) if fails else ''
        for cost, free, fails in zip(
            calibration.cost, freedom, misfit_fails(calibration.cost, freedom), strict=True
        )
    )
    sigmas = _residual_sigmas(calibration.cost, freedom)
    return SetSolutions(calibration, metrics, calibration.converged, _NO_RIG, reasons, sigmas)


def _residual_sigmas(cost: Array, freedom: Array) -> Array:
    return np.asarray(np.sqrt(cost / np.maximum(freedom, 1)))


def measure_points(
    models: Pair,
    rig: Pose,
    uv_left: Array,
    uv_right: Array,
    true: Array | None = None,
    optimal: bool = False,
) -> SetSolutions[Measurement]:
    """Measure landmarks with rigs (S,) that are known; models: left, right.

    uv_left, uv_right (S, N, 2), px, of the same landmarks, NaN = unseen; true (S, N, 3), m: where
    these are in the right camera's frame; optimal: by least reprojection error.
    """
    both = np.isfinite(np.concatenate([uv_left, uv_right], axis=-1)).all(axis=-1)
    pairs = *models, rig.take(np.nonzero(both)[0]), uv_left[both], uv_right[both]
    offset = epipolar_offset(*pairs)
    points = (triangulate_optimally if optimal else triangulate)(*pairs).points
    measured = Measurement(
        *(scatter(both, part) for part in (points, offset.distance, offset.vertical, offset.foot))
    )
    metrics = stereo_depth_metrics(measured.distance, measured.vertical, measured.points, true)
    return SetSolutions(measured, metrics, np.asarray(both.any(axis=1)), _NO_PAIR)


def localization_metrics(solved: SolvedPoses, true: Pose | None = None) -> Metrics:
    """Return LOCALIZATION_METRICS of solved sets (S,), as far as they are known; true (S,).

    rms_px: root mean square of the 2-D residual norm; mean_residual_px: mean norm, as Kita's
    tables have it; position errors in the frame of the poses; axis: the viewing axis.
    """
    return {
        **_fit_metrics(solved.residual),
        **_pose_errors(solved.pose, true),
        'odds': pose_odds(solved.result),
        'ambiguous': is_ambiguous(solved.result).astype(float),
    }


def stereo_calibration_metrics(
    rig: Pose, left_residual: Array, right_residual: Array, true: Pose | None = None
) -> Metrics:
    """Return STEREO_CALIBRATION_METRICS of rigs (S,), residuals (S, V, N, 2), px, NaN = no point.

    Position errors of the left camera in the frame of the right one (Kita, section 4).
    """
    residual = np.concatenate([left_residual, right_residual], axis=2)
    systems, views = residual.shape[:2]
    return {
        'views': np.full(systems, float(views)),
        **_fit_metrics(residual.reshape(systems, -1, 2)),
        **_pose_errors(rig, true),
    }


def stereo_depth_metrics(
    distance: Array, vertical: Array, points: Array, true: Array | None = None
) -> Metrics:
    """Return STEREO_DEPTH_METRICS (Kita, section 5) of measured points (S, N, 3), m, NaN = none.

    distance, vertical (S, N), px: of image points from their epipolar curves, NaN where there is
    none; error2: mean distance; error3: mean distance from the true points (S, N, 3).
    """
    metrics = {
        'points': np.isfinite(points[..., 0]).sum(axis=-1).astype(float),
        'error2_px': known_mean(distance),
        'error2_vertical_px': known_mean(np.abs(vertical)),
        'error2_max_px': _nanmax(distance),
    }
    if true is not None:
        off = np.linalg.norm(points - true, axis=-1)
        metrics |= {'error3_m': known_mean(off), 'error3_max_m': _nanmax(off)}
    return metrics


def _fit_metrics(residual: Array) -> Metrics:
    norm = np.linalg.norm(residual, axis=-1)
    return {
        'points': np.isfinite(norm).sum(axis=-1).astype(float),
        'rms_px': np.sqrt(known_mean(norm**2)),
        'mean_residual_px': known_mean(norm),
    }


def _pose_errors(pose: Pose, true: Pose | None) -> Metrics:
    if true is None:
        return {}
    change = pose.difference(true)
    return {
        'position_error_m': np.linalg.norm(change[..., :3], axis=-1),
        **{f'position_error_{axis}_m': change[..., i] for i, axis in enumerate('xyz')},
        'rotation_error_rad': np.linalg.norm(change[..., 3:], axis=-1),
        'axis_error_rad': axis_angle_between(pose, true),
    }


def known_mean(values: Array) -> Array:
    """Return the mean over the last axis of what is known; NaN where nothing is."""
    known = np.isfinite(values)
    count = known.sum(axis=-1)
    total = np.where(known, values, 0.0).sum(axis=-1)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def _nanmax(values: Array) -> Array:
    known = np.where(np.isfinite(values), values, np.nan)
    return np.asarray(np.fmax.reduce(known, axis=-1, initial=np.nan))
