"""How far off poses and stereo points are that were solved with a diagnosed lens."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.diagnosis import ErrorParts, LensErrors
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.pose import Pose, identity
from fisheye_svp_ros.scene.observations import Observations, views_of
from fisheye_svp_ros.solve.measured_poses import MeasuredPoses, localize_measured

_MAX_POINTS = 500  # stereo points


def localize_with_errors(
    errors: LensErrors, observations: Observations
) -> tuple[MeasuredPoses, ErrorParts]:
    """Pose every frame of one camera's table that can be posed, and say how far off each may be.

    Raises ObservationError and GeometryError as `localize_measured` does.
    """
    allowed = replace(observations, sigma=np.asarray(errors.inflate_sigma(observations.sigma)))
    found = localize_measured(ForwardModel(errors.lens), allowed)
    kept = found.views._replace(weight=np.where(found.gross, 0.0, found.views.weight))
    parts = errors.of_solved_poses(kept, found.result, found.sigma)
    return found._replace(result=found.result._replace(covariance=parts.total)), parts


def depth_errors(left: LensErrors, right: LensErrors, rig: Pose, points: Array) -> ErrorParts:
    """Return covariances (N, 3, 3), m^2, of stereo points (N, 3), m, in the right camera.

    Of points of least reprojection error; rig: left camera in the right one, taken as it is.  NaN
    where a point is NaN or a camera does not see it.
    """
    found = [np.full((len(points), 3, 3), np.nan) for _ in ErrorParts._fields]
    known = np.flatnonzero(np.isfinite(points).all(axis=1))
    for rows in (known[i:i + _MAX_POINTS] for i in range(0, len(known), _MAX_POINTS)):
        views = views_of(points[rows, None], np.zeros((len(rows), 1, 2)))
        pairs = [(errors, errors.linearize(views, pose)) for errors, pose in (
            (left, rig.broadcast_to(len(rows))), (right, identity(len(rows))))]
        by = [linear.whiten(linear.linear.d_target) / errors.noise for errors, linear in pairs]
        seen = np.asarray(np.isfinite(by[0] + by[1]).all(axis=(1, 2)))
        by = [np.where(seen[:, None, None], one, np.eye(2, 3)) for one in by]
        rows_of_both = np.concatenate(by, axis=1)
        information = np.swapaxes(rows_of_both, -1, -2) @ rows_of_both
        information[~seen] = np.eye(3)
        for (errors, linear), one in zip(pairs, by, strict=True):
            maps = np.linalg.solve(information * errors.noise, np.swapaxes(one, -1, -2))
            parts = errors.model.propagate(linear, np.asarray(maps))
            parts = parts._replace(noise=parts.noise * errors.noise**2)
            for whole, part in zip(found, parts, strict=True):
                whole[rows] = np.nan_to_num(whole[rows]) + part
        for whole in found:
            whole[rows[~seen]] = np.nan
    return ErrorParts(*found)
