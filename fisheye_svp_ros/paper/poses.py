"""What tables 3 and 4 owe to the ten poses of the rig, which the paper does not print."""

from __future__ import annotations

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.paper.evaluation import calibrate_rigs
from fisheye_svp_ros.pose import PAPER_FROM_OPTICAL, Pose, rotation_from_vector
from fisheye_svp_ros.scene.rigs import BASELINE

SETS = 40
_TILT, _ROLL = np.radians(12.0), np.radians(20.0)
_ASIDE, _BACK = 0.05, (-0.03, 0.12)  # m


def pose_sets(count: int = SETS) -> list[Pose]:
    """Return sets of ten random poses (10,) of the right camera, the same at every call.

    Tilts of up to some 25 degrees, rolls of some 20; the rig within 0.05 m of the axis of the
    landmarks, 0.03 m before to 0.12 m behind their centre.
    """
    rng = np.random.default_rng(0)
    sets = []
    for _ in range(count):
        turns = rng.standard_normal((10, 3)) * [_TILT, _TILT, _ROLL]
        places = rng.uniform(-_ASIDE, _ASIDE, (10, 3))
        places[:, 2] = rng.uniform(*_BACK, 10)
        rotation = rotation_from_vector(turns) @ PAPER_FROM_OPTICAL
        sets.append(Pose(rotation, places + rotation[..., 0] * BASELINE / 2))
    return sets


def calibration_range(lens: Lens, directions: Array) -> tuple[Array, Array]:
    """Return the 5 % and 95 % quantiles of table 3 or 4, each (3, 3, 5), over all pose sets.

    directions (N, 3), unit: of the landmarks.
    """
    tables = []
    for poses in pose_sets():
        try:
            tables.append(calibrate_rigs(lens, poses=poses, directions=directions)[0])
        except GeometryError:  # too near the landmarks at 0.2 m: no set to calibrate from
            continue
    low, high = np.quantile(tables, [0.05, 0.95], axis=0)
    return low, high
