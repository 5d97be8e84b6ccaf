"""Errors of what was solved, as named metrics with their unit in the name; batch first.

Each function returns a dictionary of arrays (S,).  What needs the truth is absent without it; the
names of all are listed beside each function.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.pose import Pose, axis_angle_between

Metrics = dict[str, Array]

_FIT_METRICS = ('points', 'rms_px', 'mean_residual_px')
_POSE = ('position_error_m', 'position_error_x_m', 'position_error_y_m', 'position_error_z_m',
         'rotation_error_rad', 'axis_error_rad')
LOCALIZATION_METRICS = (*_FIT_METRICS, *_POSE)
STEREO_CALIBRATION_METRICS = ('views', *_FIT_METRICS, *_POSE)
STEREO_DEPTH_METRICS = ('points', 'error2_px', 'error2_vertical_px', 'error2_max_px', 'error3_m',
                        'error3_max_m')


class Summary(NamedTuple):
    """Of the finite ones among some values; NaN where there is none."""

    solved: int
    missing: int
    median: float
    mean: float
    largest: float


def localization_metrics(pose: Pose, residual: Array, true: Pose | None = None) -> Metrics:
    """Return LOCALIZATION_METRICS of poses (S,), residuals (S, N, 2), px, NaN = no point.

    rms_px: root mean square of the 2-D residual norm; mean_residual_px: mean norm, as Kita's
    tables have it; position errors in the frame of the poses; axis: the viewing axis.
    """
    return {**_fit_metrics(residual), **_pose_errors(pose, true)}


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


def summarise(values: Array) -> Summary:
    """Return the summary of values (N,), NaN = missing; the largest is that of the magnitudes."""
    known = values[np.isfinite(values)]
    missing = len(values) - len(known)
    if not len(known):
        return Summary(0, missing, np.nan, np.nan, np.nan)
    largest = np.abs(known).max()
    return Summary(len(known), missing, *map(float, (np.median(known), known.mean(), largest)))
