"""What the readout of a rolling shutter does to a pose, where the lens does not model it."""

from __future__ import annotations

from collections import deque
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


class Readout:
    """Covers what a rolling shutter may do to poses that follow each other.

    seconds: from the first row to the last; 0: a global shutter, nothing is covered.
    """

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._motion: deque[tuple[float, Pose]] = deque(maxlen=3)  # times, s, and poses

    def cover(self, time: float, solved: SolvedPoses, covariance: Array) -> tuple[Array, str]:
        """Return the covariance (1, 6, 6) of the next set with its bias, and what is to be said.

        time: of the set, s.  As it is where the bias is less than it states, where the camera does
        not move on as it did, and where the lens knows.
        """
        self._motion.append((time, solved.pose.take(0)))
        velocity = steady_velocity(*zip(*self._motion, strict=True))
        models_it = solved.model.without_motion() is not solved.model
        if not self._seconds or models_it or velocity is None:
            return covariance, ''
        bias = readout_bias(solved, velocity, self._seconds)
        if not exceeds(bias[0], covariance[0]):
            return covariance, ''
        turn, off = (float(np.linalg.norm(part)) for part in (velocity[3:], bias[0, :3]))
        return covariance + bias[:, :, None] * bias[:, None, :], (
            f'a rolling shutter of {1e3 * self._seconds:.0f} ms moves the pose by '
            f'{1e3 * off:.2g} mm at {turn:.2g} rad/s. The covariance covers that. Set '
            'readout_time (0: global shutter)'
        )


def cover_readouts(solved: SolvedPoses, seconds: float) -> SolvedPoses:
    """Return poses (S,) of one camera or rig, by their times, with what a readout may do to them.

    Sets without a time stay as they are.
    """
    time = np.fmax.reduce(solved.views.t, axis=1)  # NaN where none is known
    readout, number = Readout(seconds), np.arange(len(time))
    covariance, reasons = solved.covariance.copy(), list(solved.reasons)
    for i in np.argsort(time, kind='stable'):
        if np.isfinite(time[i]):
            one = solved.select(number == i)
            covariance[[i]], reason = readout.cover(float(time[i]), one, one.covariance)
            reasons[i] = '; '.join(filter(None, (reasons[i], reason)))
    added = solved.result.added + covariance - solved.covariance
    result = solved.result._replace(covariance=covariance, added=added)
    return solved._replace(result=result, reasons=tuple(reasons))
