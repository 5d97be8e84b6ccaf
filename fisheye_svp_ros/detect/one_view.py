"""What one photograph of a board alone says about how its lens bends the image."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.errors import FisheyeSvpError
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.scene.observations import make_observations
from fisheye_svp_ros.solve.lens_calibration import calibrate

_MAX_RMS = 0.6  # px rms; rough places are off by less, as far as no lens explains it


def imaging(
    points: Array, uv: Array, shape: tuple[int, ...], free: Sequence[str]
) -> Callable[[Array], Array] | None:
    """Return what takes places (..., 3), m, on a board to their images (..., 2), px, or None.

    By the Kannala-Brandt lens, with so many of its parameters, that fits one photograph (H, W)
    best, of points (N, 3), m, at uv (N, 2), px; None where they do not determine it, or it does
    not fit.
    """
    table = make_observations(np.zeros(len(uv), dtype=np.int64), np.arange(len(uv)), uv, points)
    try:
        fitted = calibrate(table, 'kannala_brandt', (shape[1], shape[0]), free).adjusted
    except FisheyeSvpError:
        return None
    if np.sqrt((fitted.residual**2).sum(axis=-1).mean()) > _MAX_RMS:
        return None
    pose = fitted.pose.take(0)
    return lambda places: project(fitted.lens, pose.into_body(places), limited=False).uv
