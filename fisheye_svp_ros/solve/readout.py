"""What the readout of a rolling shutter does to a pose, where the lens does not model it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.solve.least_squares import never_singular, with_unit_diagonal
from fisheye_svp_ros.solve.solved_poses import SolvedPoses
from fisheye_svp_ros.solve.weak_geometry import CHI2_999

_MAX_INTERVAL = 0.5  # s between poses that follow each other
_MAX_CHANGE = 0.5  # of a velocity from one interval to the next


def steady_velocity(times: Sequence[float], poses: Sequence[Pose]) -> Array | None:
    """Return the velocity (6,), m/s and rad/s, of a camera that moves on as it did.

    times: s, of three poses.  None where intervals are long or it moves otherwise, as noise does.
    """
    if len(times) < 3 or not (np.diff(times) > 0).all() or max(np.diff(times)) > _MAX_INTERVAL:
        return None
    before, now = (poses[i].difference(poses[i - 1]) / (times[i] - times[i - 1]) for i in (1, 2))
    parts = slice(0, 3), slice(3, 6)
    steady = (
        np.linalg.norm(now[part] - before[part]) <= _MAX_CHANGE * np.linalg.norm(now[part])
        for part in parts
    )
    kept = np.concatenate([now[part] * one for part, one in zip(parts, steady, strict=True)])
    return kept if kept.any() else None


def readout_bias(solved: SolvedPoses, velocity: Array, seconds: float) -> Array:
    """Return what rows that are read one after the other move poses (S,) by, (S, 6), m and rad.

    velocity (6,): of the changes in `Pose.retract`; seconds: from the first row to the last, the
    stamp being that of the middle row.
    """
    model, views = solved.model, solved.views
    linear = model.linearize(solved.pose, views)
    seen = ((views.weight > 0) & ~solved.outliers)[..., None, None]
    jacobian = np.where(seen, model.d_pose(linear, views) * views.weight[..., None, None], 0.0)
    late = seconds * np.concatenate(
        [part.views.uv[..., 1] / part.model.lens.height - 0.5 for part in model.parts(views)],
        axis=1,
    )
    moved = (jacobian @ velocity) * late[..., None]
    gradient = np.einsum('snup,snu->sp', jacobian, moved)
    hessian = np.einsum('snup,snuq->spq', jacobian, jacobian)
    relative, scale = with_unit_diagonal(hessian, 0.0)
    step = never_singular(np.linalg.inv, relative) @ (gradient / scale)[..., None]
    return np.asarray(step[..., 0] / scale)


def exceeds(bias: Array, covariance: Array) -> bool:
    """Say whether a bias (6,) takes a pose out of its 99.9 % ellipsoid; covariance (6, 6)."""
    return bool(bias @ np.linalg.solve(covariance, bias) > CHI2_999)
