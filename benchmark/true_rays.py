"""How far the rays of a lens are off those of the true one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.solve.ray_errors import RANGES, points_on_rays, without_motion


def ray_errors(
    lens: Lens, truth: Lens, uv: Array, ranges: Sequence[float] = RANGES
) -> Array:
    """Return rms angles (R,), mrad, between rays of two lenses at ranges, m.

    uv (G, 2): image points, px; a motion that is common to all ranges is taken out.
    """
    points = points_on_rays(truth, uv, ranges)
    change = points_on_rays(lens, uv, ranges) - points
    there = np.isfinite(change + points).all(axis=(0, 2))
    angles = without_motion(points[:, there], change[:, there])
    return np.asarray(1e3 * np.sqrt((angles**2).sum(axis=-1).mean(axis=-1)))


def ray_error(lens: Lens, truth: Lens, uv: Array, ranges: Sequence[float] = RANGES) -> float:
    """Return the rms angle, mrad, over all ranges together; see `ray_errors`."""
    return float(np.sqrt((ray_errors(lens, truth, uv, ranges) ** 2).mean()))
