"""Which poses a robot may act on: those known well enough, and those that odometry bears out.

A pose on /tf has no covariance.  So it is held against limits of its standard deviation, against
a second pose that fits as well, and against where odometry carries the poses before it (innovation
gating: Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001,
section 3.7.2).  The majority of the latest poses decides, so that a wrong first pose does not keep
out all that follow.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.pose import Pose, carried_pose, vector_from_rotation
from fisheye_svp_ros.solve.localization import squared_distances
from fisheye_svp_ros.solve.weak_geometry import MIN_ODDS, share_outside

MAX_MISFIT = 3.0  # times sigma: residuals of a wrong lens, image or map
_HISTORY = 15  # poses that the next one is held against


class GateLimits(NamedTuple):
    """Largest standard deviations, m and rad, and innovation, sigmas; 0: no limit of this kind.

    ambiguous: whether poses pass beside which a second one fits; odom_error: of the odometry, by
    the way and by the angle.
    """

    max_std_m: float = 0.2
    max_std_rad: float = 0.1
    ambiguous: bool = False
    max_innovation: float = 5.0
    odom_error: float = 0.05


class GatedPose(NamedTuple):
    """The pose of a base in its world, covariance (6, 6), m and rad, and what speaks against it.

    ambiguous: a second pose fits; misfit: residuals over sigma; suspects: tags that may have moved
    and make it wrong, with the probability that they did, see `tag_units.suspect_tags`.
    """

    base: Pose
    covariance: Array
    ambiguous: bool = False
    misfit: float = 1.0
    suspects: Mapping[int, float] = MappingProxyType({})


def weakness(pose: GatedPose, limits: GateLimits) -> str:
    """Say why a pose is not known well enough, with the figure first; '' where it is."""
    if pose.ambiguous and not limits.ambiguous:
        return 'a second pose fits as well'
    if pose.misfit > MAX_MISFIT:
        return f'residuals of {pose.misfit:.3g} sigma_px contradict the pose'
    blocks = pose.covariance[:3, :3], pose.covariance[3:, 3:]
    for block, most, name, unit in zip(
        blocks,
        (limits.max_std_m, limits.max_std_rad),
        ('max_std_m', 'max_std_rad'),
        ('m', 'rad'),
        strict=True,
    ):
        finite = np.isfinite(block).all()
        size = float(np.sqrt(np.linalg.eigvalsh(block)[-1])) if finite else np.inf
        if most and not size <= most:
            return f'standard deviation {size:.2g} {unit}, above {name} ({most:g})'
    return ''


class Verdict(NamedTuple):
    """What odometry says of a pose: why it is refused, and why it is not confirmed."""

    refused: str = ''
    unconfirmed: str = ''


class _Known(NamedTuple):
    """A pose before, where odometry had the base then, and the way and angle up to then."""

    pose: GatedPose
    odometry: Pose
    way: float
    angle: float


class OdometryGate:
    """Holds each pose against the latest ones, carried on by odometry."""

    def __init__(self, limits: GateLimits) -> None:
        self._limits = limits
        self._history: deque[_Known] = deque(maxlen=_HISTORY)

    def judge(self, pose: GatedPose, odometry: Pose) -> Verdict:
        """Return what the poses before say of one; odometry: the base in the odometry's frame."""
        history, limits = [*self._history], self._limits
        way, angle = 0.0, 0.0
        if history:
            last = history[-1]
            turn = vector_from_rotation(odometry.rotation @ last.odometry.rotation.T)
            way = last.way + float(np.linalg.norm(odometry.position - last.odometry.position))
            angle = last.angle + float(np.linalg.norm(turn))
        current = _Known(pose, odometry, way, angle)
        self._history.append(current)
        if not limits.max_innovation:
            return Verdict()
        carried = [self._carry(before, current) for before in history]
        off = np.array([_sigmas(pose, *before) for before in carried])
        agree = off <= limits.max_innovation
        if history and 2 * np.count_nonzero(agree) <= len(agree):
            return Verdict(
                f'{np.median(off):.3g} sigmas off where odometry has it (max_innovation '
                f'{limits.max_innovation:g})'
            )
        wrong = np.array([_wrong_beside(pose, *before) for before in carried])
        unconfirmed = [
            tag
            for tag, odds in sorted(pose.suspects.items())
            if not any(
                odds * share <= MIN_ODDS and tag not in before.pose.suspects
                for before, share in zip(history, wrong, strict=True)
            )
        ]
        if unconfirmed:
            names = ' and '.join(map(str, unconfirmed))
            return Verdict('', f'no other tag confirms the pose by tag {names}')
        return Verdict()

    def _carry(self, before: _Known, now: _Known) -> tuple[Pose, Array]:
        """Return where odometry carries a pose, and the covariance (6, 6) of that."""
        moved = before.odometry.inverse().compose(now.odometry)
        carried, covariance = carried_pose(before.pose.base, before.pose.covariance, moved)
        drift = np.repeat([now.way - before.way, now.angle - before.angle], 3)
        return carried, covariance + np.diag((self._limits.odom_error * drift) ** 2)


def _sigmas(pose: GatedPose, there: Pose, covariance: Array) -> float:
    """Return how far a pose is off another with a covariance (6, 6), in sigmas of both."""
    change = pose.base.difference(there)
    squares = squared_distances(change[None, None], (covariance + pose.covariance)[None])
    return float(np.sqrt(squares[0, 0]))


def _wrong_beside(pose: GatedPose, there: Pose, covariance: Array) -> float:
    """Return how probably a pose is outside its ellipsoid, of what another pose alone says."""
    change = pose.base.difference(there)
    spread = covariance + np.outer(change, change)
    return float(share_outside(np.trace(np.linalg.solve(pose.covariance, spread))))
