"""Rendered photographs of boards of any kind, those of the benchmark of detectors."""

from __future__ import annotations

from functools import cache

import numpy as np

from benchmark.studies.detectors import LENS, PRINTED
from benchmark.studies.prints import printed
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.detect.patterns import Pattern
from fisheye_svp_ros.optics.camera import Rays, project
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.simulate.render import Exposure, pixel_rays, render
from fisheye_svp_ros.simulate.targets import board_views


@cache
def _rays() -> Rays:
    return pixel_rays(LENS)


def pattern_photograph(
    pattern: Pattern, number: int, exposure: Exposure | None = None, lens: Lens = LENS
) -> tuple[Array, Array]:
    """Return a photograph of a pattern, and where its points really are in it."""
    board = printed(pattern)
    middle = (board.corners.min(axis=0) + board.corners.max(axis=0)) / 2
    view = board_views(LENS, PRINTED, 8, (0.1, 0.3), np.random.default_rng(0)).take(number)
    pose = Pose(view.rotation, view.position + middle - PRINTED.corners.mean(axis=0))
    rays = _rays() if lens is LENS else None
    rng = np.random.default_rng(number)
    image = render(lens, board, pose, exposure or Exposure(), rng, rays=rays)
    return image, project(lens, pose.into_body(board.corners)).uv
