"""The residual of every observation, before and after the model was extended."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.solve.rig_state import Linearization


class PointResiduals(NamedTuple):
    """K observations by frame and camera.

    frame, camera, landmark (K,); t (K,), s, NaN where unknown; uv (K, 2), px; before and after
    (K, 2), px: measured minus predicted by the fitted base and the fitted extended model; theta
    (K,), rad, and range (K,), m, under the latter; outlier (K,): an outlier, left out of fits.
    """

    frame: Index
    camera: Index
    landmark: Index
    t: Array
    uv: Array
    before: Array
    after: Array
    theta: Array
    range: Array
    outlier: Mask


def point_residuals(before: Linearization, after: Linearization) -> PointResiduals:
    """Return the residuals of two states of the same data."""
    views = after.data.views
    seen = views.landmark >= 0
    per_point = np.ones_like(seen, dtype=np.int64)
    distance = np.linalg.norm(after.scene.pose.into_body(views.points), axis=-1)
    return PointResiduals(
        frame=(views.frame[:, None] * per_point)[seen],
        camera=(views.camera[:, None] * per_point)[seen],
        landmark=views.landmark[seen],
        t=views.t[seen],
        uv=views.uv[seen],
        before=(views.uv - before.linear.uv)[seen],
        after=(views.uv - after.linear.uv)[seen],
        theta=after.scene.theta[seen],
        range=distance[seen],
        outlier=~views.used[seen],
    )
