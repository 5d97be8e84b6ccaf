"""Held-out points: a pose is fitted to each view, all else is as it was fitted before."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import least_squares

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.pose import Pose

Project = Callable[[Array], Array]
_LOST = 1e3  # px: what a point counts that a model cannot project


def residuals(project: Project, frame: Index, xyz: Array, uv: Array, pose: Pose) -> Array:
    """Return distances (N,), px, once the six numbers of each view's pose are fitted.

    project: points (M, 3), m, in the camera to image points (M, 2), px; xyz (N, 3): the target as
    the model has it; pose: of the camera, one a frame in ascending order, to start from.
    """
    apart = np.empty(len(frame))
    for i, number in enumerate(np.unique(frame)):
        mine = frame == number
        apart[mine] = np.linalg.norm(_fitted(project, xyz[mine], uv[mine], pose.take(i)), axis=1)
    return apart


def _fitted(project: Project, xyz: Array, uv: Array, pose: Pose) -> Array:
    size = np.repeat([np.median(np.linalg.norm(pose.into_body(xyz), axis=1)), 1.0], 3)

    def misfit(change: Array) -> Array:
        seen = project(pose.retract(size * change).into_body(xyz))
        return np.nan_to_num(uv - seen, nan=_LOST, posinf=_LOST, neginf=-_LOST).ravel()

    found = least_squares(misfit, np.zeros(6), method='lm', x_scale=1e-2)
    return np.asarray(found.fun).reshape(-1, 2)


def rms(apart: Array) -> float:
    """Return the root mean square of distances (N,)."""
    return float(np.sqrt((apart**2).mean()))
