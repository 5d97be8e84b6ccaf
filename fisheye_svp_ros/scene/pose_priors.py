"""What is known of the pose of a camera before an image: a robot that drives on a plane."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Batch
from fisheye_svp_ros.pose import Pose

PRIOR_ROWS = 3  # of a planar prior: height, roll, pitch


class _PlanarPrior(NamedTuple):
    mount: Pose
    height: Array
    sigma: Array


class PlanarPrior(_PlanarPrior, Batch):
    """Height and tilt of the bases that carry S cameras, normally distributed.

    mount (S,): base in camera; height (S,), m, along z of the world; sigma (S, 2): of the height,
    m, and of roll and pitch, rad, whose mean is 0: z of base and world are parallel.
    """

    __slots__ = ()

    def equations(self, pose: Pose) -> tuple[Array, Array, Array]:
        """Return what it adds to costs (S,) and normal equations (S, 6, 6), (S, 6) of poses (S,).

        By the change in `Pose.retract`.
        """
        base = pose.compose(self.mount)
        arm, up = base.position - pose.position, base.rotation[..., 2]
        sine = np.hypot(up[:, 0], up[:, 1])
        turn = np.where(sine < 1e-9, 1.0, np.arctan2(sine, up[:, 2]) / np.maximum(sine, 1e-9))
        roll, pitch = -turn * up[:, 1], turn * up[:, 0]
        columns = np.zeros((len(arm), 3, 6))
        columns[:, 0, 2] = 1.0
        columns[:, 0, 3], columns[:, 0, 4] = arm[:, 1], -arm[:, 0]
        columns[:, 1, 3] = columns[:, 2, 4] = 1.0
        columns[:, 1, 5], columns[:, 2, 5] = -pitch, roll
        scale = self.sigma[:, [0, 1, 1]]
        off = np.stack([base.position[:, 2] - self.height, roll, pitch], axis=-1) / scale
        columns /= scale[..., None]
        transposed = np.swapaxes(columns, -1, -2)
        gradient = (transposed @ off[..., None])[..., 0]
        return (off**2).sum(axis=-1), transposed @ columns, gradient
