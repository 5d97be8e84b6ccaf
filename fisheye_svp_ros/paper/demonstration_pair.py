"""A rectified pair for the demo: a board before the paper's vergent rig, at one range."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.rectify.cameras import camera_for
from fisheye_svp_ros.rectify.stereo import RectifiedPair, rectify_pair
from fisheye_svp_ros.scene.rigs import rig
from fisheye_svp_ros.simulate.render import Exposure, Print, render

RANGE = 0.5  # m, of the paper's nearer landmarks
_BOARD = Print(9, 6, 0.065)
_DIRECTION = np.array([0.0, -0.25, 0.9])  # the board, in the left camera: above the axes


def rectified_pair(lens: Lens) -> tuple[RectifiedPair, tuple[NDArray[Any], ...]]:
    """Return the pair of two cameras with the lens, and their rectified photographs."""
    place, both = _board_in_left(), rig('vergent')
    camera = camera_for([lens], 'pinhole', (640, 480), np.radians(110.0), along_baseline=True)
    pair = rectify_pair(lens, lens, both, camera, RANGE)
    left = place.inverse()
    images = [side.remap(render(lens, _BOARD, pose, Exposure(), np.random.default_rng(0)))
              for side, pose in ((pair.left, left), (pair.right, left.compose(both.inverse())))]
    return pair, tuple(images)


def _board_in_left() -> Pose:
    """Return the board, which faces the left camera."""
    ahead: Array = _DIRECTION / np.linalg.norm(_DIRECTION)
    right = np.cross([0.0, 1.0, 0.0], ahead)
    right /= np.linalg.norm(right)
    turn = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    return Pose(turn, RANGE * ahead - turn @ _BOARD.corners.mean(axis=0))
