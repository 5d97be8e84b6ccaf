"""What the readout of a rolling shutter does to a pose, where the lens does not model it.

The rows of an image are read one after the other, in a time that is unknown but bounded: it is
zero of a global shutter.  Motion moves image points by it, and the pose follows part of that.  The
rest stays in the residuals, row by row, which so measure the time (Ait-Aider et al., ECCV 2006).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.solve.least_squares import never_singular, with_unit_diagonal
from fisheye_svp_ros.solve.solved_poses import SolvedPoses
from fisheye_svp_ros.solve.weak_geometry import CHI2_999

_MAX_INTERVAL = 0.5  # s between poses that follow each other
_MAX_CHANGE = 0.5  # of a velocity from one interval to the next
_MEMORY = 0.95  # of the information, from set to set: errors of lens and map repeat
_FINEST = 0.04  # of the longest time: a standard error that repeated errors leave
_MIN_SIGMAS = 3.29  # standard errors above zero of a readout that is not by chance (99.9 %)
_GRID = np.linspace(-1, 1, 201)  # shares of the longest time


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


class RowShift(NamedTuple):
    """What one second of readout does to poses (S,), and what their residuals say of that time.

    bias (S, 6): m/s and rad/s; information, 1/s^2, and gradient, 1/s, (S,): the time that fits
    best is gradient / information, by residuals in units of what that time leaves of them.
    """

    bias: Array
    information: Array
    gradient: Array


def row_shift(solved: SolvedPoses, velocity: Array) -> RowShift:
    """Return what rows that are read one after the other do to poses (S,) of a moving camera.

    velocity (6,): of the changes in `Pose.retract`; the stamp is that of the middle row.
    """
    model, views = solved.model, solved.views
    linear = model.linearize(solved.pose, views)
    seen = ((views.weight > 0) & ~solved.outliers)[..., None]
    weight = np.where(seen, views.weight[..., None], 0.0)
    jacobian = np.where(seen[..., None], model.d_pose(linear, views), 0.0) * weight[..., None]
    late = np.concatenate(
        [part.views.uv[..., 1] / part.model.lens.height - 0.5 for part in model.parts(views)],
        axis=1,
    )
    moved = (jacobian @ velocity) * late[..., None]
    gradient = np.einsum('snup,snu->sp', jacobian, moved)
    hessian = np.einsum('snup,snuq->spq', jacobian, jacobian)
    relative, scale = with_unit_diagonal(hessian, 0.0)
    step = never_singular(np.linalg.inv, relative) @ (gradient / scale)[..., None]
    bias = np.asarray(step[..., 0] / scale)
    rest = moved - np.einsum('snup,sp->snu', jacobian, bias)  # what no pose explains
    residual = np.where(weight > 0, solved.residual, 0.0) * weight
    information, pull = (rest**2).sum(axis=(1, 2)), (rest * residual).sum(axis=(1, 2))
    left = (residual**2).sum(axis=(1, 2)) - pull**2 / np.maximum(information, 1e-12)
    free = np.maximum(2 * np.count_nonzero(seen[..., 0], axis=1) - 7, 1)
    variance = np.maximum(1.0, left / free)
    return RowShift(bias, information / variance, pull / variance)


def exceeds(bias: Array, covariance: Array) -> bool:
    """Say whether a bias (6,) takes a pose out of its 99.9 % ellipsoid; covariance (6, 6)."""
    return bool(bias @ np.linalg.solve(covariance, bias) > CHI2_999)


class Readout:
    """Covers what a rolling shutter may do to poses that follow each other.

    longest: time from the first row to the last, s, in either direction, which is all that is
    known before residuals are; 0: a global shutter, nothing is covered.
    """

    def __init__(self, longest: float) -> None:
        self._longest = longest
        self._motion: deque[tuple[float, Pose]] = deque(maxlen=3)  # times, s, and poses
        self._information = self._gradient = 0.0  # of the sets so far, see `RowShift`

    @property
    def stderr(self) -> float:
        """Standard error, s, of the time by residuals alone."""
        floor = _FINEST * self._longest
        return float(np.hypot(1 / np.sqrt(max(self._information, 1e-12)), floor))

    @property
    def time(self) -> float:
        """The time, s, that fits the residuals best; negative where the last row comes first."""
        return self._gradient / max(self._information, 1e-12)

    def mean_square(self) -> float:
        """Return the expected square of the time, s^2: uniform where residuals say nothing."""
        at = self._longest * _GRID
        near = np.clip(self.time, -self._longest, self._longest)
        odds = np.exp(-0.5 * ((at - near) / self.stderr) ** 2)
        return float((odds * at**2).sum() / odds.sum())

    def cover(self, time: float, solved: SolvedPoses, covariance: Array) -> tuple[Array, str]:
        """Return the covariance (1, 6, 6) of the next set with its bias, and what is to be said.

        time: of the set, s.  As it is where the camera does not move on as it did, and where the
        lens knows.  Said is only what residuals show, and what moves a pose out of the ellipsoid
        that sigma alone leaves it; a longer readout is an error of another kind.
        """
        self._motion.append((time, solved.pose.take(0)))
        velocity = steady_velocity(*zip(*self._motion, strict=True))
        models_it = solved.model.without_motion() is not solved.model
        if not self._longest or models_it or velocity is None:
            return covariance, ''
        shift = row_shift(solved, velocity)
        self._information = _MEMORY * self._information + float(shift.information[0])
        self._gradient = _MEMORY * self._gradient + float(shift.gradient[0])
        bias, found = shift.bias[0], abs(self.time)
        covered = covariance + self.mean_square() * bias[:, None] * bias
        by_noise = covariance[0] / solved.excess[0] ** 2
        margin = _MIN_SIGMAS * self.stderr
        if not margin < found < self._longest + margin or not exceeds(found * bias, by_noise):
            return covered, ''
        turn, off = (float(np.linalg.norm(part)) for part in (velocity[3:], found * bias[:3]))
        return covered, (
            f'a rolling shutter of {1e3 * found:.0f} ± {1e3 * self.stderr:.0f} ms (by the '
            f'residuals) moves the pose by {1e3 * off:.2g} mm at {turn:.2g} rad/s. The covariance '
            'covers that. Turn slower, or name a lens with rolling_shutter (diagnose)'
        )


def cover_readouts(solved: SolvedPoses, longest: float) -> SolvedPoses:
    """Return poses (S,) of one camera or rig, by their times, with what a readout may do to them.

    longest: as of `Readout`.  Sets without a time stay as they are.
    """
    time = np.fmax.reduce(solved.views.t, axis=1)  # NaN where none is known
    readout, number = Readout(longest), np.arange(len(time))
    covariance, reasons = solved.covariance.copy(), list(solved.reasons)
    for i in np.argsort(time, kind='stable'):
        if np.isfinite(time[i]):
            one = solved.select(number == i)
            covariance[[i]], reason = readout.cover(float(time[i]), one, one.covariance)
            reasons[i] = '; '.join(filter(None, (reasons[i], reason)))
    added = solved.result.added + covariance - solved.covariance
    result = solved.result._replace(covariance=covariance, added=added)
    return solved._replace(result=result, reasons=tuple(reasons))
