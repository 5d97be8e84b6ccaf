"""What engines are asked with and answer with."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Batch, Index, Mask
from fisheye_svp_ros.pose import Pose

PLANARITY = 0.1  # thickness of a target relative to its length, below which it counts as flat

# Points (S, N, 3), m; image points (S, N, 2), px; weights (S, N), 1/px
Seen = tuple[Array, Array, Array]


class Incidence(NamedTuple):
    """Where points have their ray through the lens, and whether they do.

    theta (...), rad; unit (2, ...): direction of the image height; valid (...).
    """

    theta: Array
    unit: Array
    valid: Mask


class _PoseFields(NamedTuple):
    pose: Pose
    covariance: Array
    residual: Array
    cost: Array
    converged: Mask
    iterations: Index
    other: Pose
    gap: Array
    added: Array
    tail: Array


class Localization(_PoseFields, Batch):
    """Solved poses of S views.

    pose: camera in the world; covariance (S, 6, 6), m and rad, of the change in `Pose.retract`;
    residual (S, N, 2), px, measured minus predicted, NaN for padding; cost (S,): whitened sum of
    squares; converged, iterations (S,).  other (S,): the second minimum, as far as one is known,
    and gap (S,): by how much its cost is larger, infinite where none is known.  added (S, 6, 6):
    what the covariance holds beyond the linearized noise, see `solve.weak_geometry`.  tail (S,):
    the factor on the covariance by which its 99.9 % ellipsoid holds, 1 for normal errors.  A view
    whose points do not fix a pose (they lie on one line, say) has not converged; where that is so
    the covariance is NaN.
    """

    __slots__ = ()

    @classmethod
    def of_one_minimum(
        cls,
        pose: Pose,
        covariance: Array,
        residual: Array,
        cost: Array,
        converged: Mask,
        iterations: Index,
    ) -> Localization:
        """Return poses of which no second minimum is known."""
        return cls(
            pose,
            covariance,
            residual,
            cost,
            converged,
            iterations,
            Pose(pose.rotation.copy(), pose.position.copy()),
            np.full(len(cost), np.inf),
            np.zeros_like(covariance),
            np.ones(len(cost)),
        )


class Rigs(NamedTuple):
    """S rigs at their minima: state, cost and iterations (S,), normal equations (an arrow)."""

    state: tuple[Array, ...]
    cost: Array
    iterations: Index
    normal: tuple[Array, ...]
