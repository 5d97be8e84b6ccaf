"""Frames of similar poses: bursts, and photographs from a tripod.

What light, detector and board do to such frames they do to all of them alike, so that they are no
independent witnesses: a jackknife leaves them out together.
Source: Efron and Tibshirani, An Introduction to the Bootstrap (1993), chapter 11; by clusters:
Bell and McCaffrey, Survey Methodology 28 (2002).
"""

from __future__ import annotations

import numpy as np
from scipy.cluster import hierarchy

from fisheye_svp_ros.arrays import Index
from fisheye_svp_ros.solve.rig_state import Linearization

_SIMILAR_POSE = 0.1  # of the distance, or rad
_MIN_CLUSTERS = 3  # fewer are no sample


def cluster_frames(linear: Linearization) -> Index:
    """Return the cluster (F,) of each frame: those in which the target is seen in one pose.

    Two poses of a cluster differ by at most a tenth: of the distance, or of a radian.  Each frame
    has its own where there are fewer than three clusters.
    """
    pose, points = linear.state.pose, linear.data.views.points[linear.data.views.used]
    frames = np.arange(len(pose.position))
    if len(frames) < _MIN_CLUSTERS:
        return frames
    middle = pose.into_body(np.broadcast_to(points.mean(axis=0), (len(frames), 1, 3)))[:, 0]
    away = np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-300)
    turn = pose.rotation.reshape(-1, 9) / np.sqrt(2)  # so far apart as the angle, if small
    tree = hierarchy.linkage(
        np.concatenate([middle / away, np.log(away), turn], axis=1), 'complete')
    cluster = hierarchy.fcluster(tree, _SIMILAR_POSE, 'distance').astype(np.int64) - 1
    return frames if cluster.max() + 1 < _MIN_CLUSTERS else cluster
