"""Rigs: the three styles of Kita's figure 7, the poses that calibrate one, cameras all around."""

from __future__ import annotations

import numpy as np

from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.pose import PAPER_FROM_OPTICAL, Pose, rotation_from_vector

BASELINE = 0.15
# Turn of the left camera towards the right one, rad (section 4 of the paper).
STYLES = {'parallel': 0.0, 'vergent': np.radians(10.0), 'divergent': -np.radians(10.0)}


def rig(style: str, baseline: float = BASELINE) -> Pose:
    """Return the pose of the left camera in the right one (optical frames), baseline in m.

    Raises ParameterError for an unknown style or an impossible baseline.
    """
    if style not in STYLES:
        raise ParameterError(f'style {style!r} is unknown; choose from {", ".join(STYLES)}')
    if not (np.isfinite(baseline) and baseline > 0):
        raise ParameterError(f'baseline is {baseline} m; it must be above 0')
    return rig_from_angle(STYLES[style], baseline)


def rig_from_angle(inward: float, baseline: float) -> Pose:
    """Return the left camera in the right one, turned inward by an angle, rad."""
    turn = rotation_from_vector(np.array([0.0, inward, 0.0]))
    return Pose(turn, np.array([-baseline, 0.0, 0.0]))


def paper_pose(*shape: int) -> Pose:
    """Return the paper's true pose: at the origin, gazing along -z of the world."""
    return Pose(np.tile(PAPER_FROM_OPTICAL, (*shape, 1, 1)), np.zeros((*shape, 3)))


def calibration_poses(baseline: float = BASELINE) -> Pose:
    """Return ten poses of the right camera in the world (compare figure 8).

    The paper does not print its poses.  Of some 800 patterns of this kind this one brings the
    position and axis errors and the residuals of tables 3 and 4 nearest to the published ones.
    At 0.2 m both cameras keep 0.09 m from all landmarks, beyond the unique range of both lenses.
    """
    angles = 2 * np.pi * np.arange(9) / 9
    tilt, roll = np.radians(12.0), np.radians(20.0)
    turns = np.zeros((10, 3))
    turns[1:, 0] = tilt * np.cos(angles + 1.25 * np.pi)
    turns[1:, 1] = tilt * np.sin(angles + 1.25 * np.pi)
    turns[1:, 2] = roll * np.sin(3 * angles)
    places = np.zeros((10, 3))
    places[1:, 0], places[1:, 1] = 0.01 * np.cos(4 * angles), 0.01 * np.sin(4 * angles)
    places[1:, 2] = 0.06 * np.cos(angles)
    places[:, 2] += 0.03
    rotation = rotation_from_vector(turns) @ PAPER_FROM_OPTICAL
    return Pose(rotation, places + rotation[..., 0] * baseline / 2)
