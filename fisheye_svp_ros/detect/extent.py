"""Whether the squares of a chessboard go on beyond the corners that were looked for."""

from __future__ import annotations

import cv2
import numpy as np

from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.detect.patterns import Pattern
from fisheye_svp_ros.detect.photographs import Pixels
from fisheye_svp_ros.detect.points import Points

# By three corners of a line, how far a parabola gets one and a half squares before the first
_EXTRAPOLATION = np.array([35.0, -42.0, 15.0]) / 8
_CONTRAST_TOLERANCE = 0.35  # of the step from dark to bright
_MIN_MATCH_SHARE = 0.8  # of the squares of a side
_MIN_SQUARES = 3
_SMOOTHING = 1.0  # px


def goes_on(pixels: Pixels, points: Points, pattern: Pattern) -> bool:
    """Return whether a further row of squares lies beyond a side of a chessboard's grid.

    Outside the inner corners is one row, of the board's edge.  The next has the colors of the
    row inside, where there is one.
    """
    corners = np.full((len(pattern.points), 2), np.nan)
    corners[points.ids] = points.uv
    grid = corners.reshape(pattern.rows, pattern.columns, 2)
    smooth = cv2.GaussianBlur(pixels.astype(np.float32), (0, 0), _SMOOTHING)
    sides = (grid, grid[::-1], grid.swapaxes(0, 1), grid.swapaxes(0, 1)[::-1])
    return any(_side_goes_on(smooth, side) for side in sides)


def _side_goes_on(image: Array, grid: Array) -> bool:
    """Do so for the side of the first row of a grid (R, C, 2), px."""
    middles = (grid[:, 1:] + grid[:, :-1]) / 2
    inside = (middles[0] + middles[1]) / 2
    beyond = np.tensordot(_EXTRAPOLATION, middles[:3], axes=1)
    own, next_ones = _light(image, inside), _light(image, beyond)
    known = np.isfinite(own) & np.isfinite(next_ones)
    if known.sum() < _MIN_SQUARES:
        return False
    own, next_ones = own[known], next_ones[known]
    step = np.ptp(own)
    return bool((np.abs(next_ones - own) < _CONTRAST_TOLERANCE * step).mean() >= _MIN_MATCH_SHARE)


def _light(image: Array, uv: Array) -> Array:
    """Return the image (H, W) at places (N, 2), px; NaN outside."""
    height, width = image.shape
    there: Mask = np.asarray(np.isfinite(uv).all(axis=1))
    column, row = np.round(np.where(there[:, None], uv, -1)).astype(int).T
    there &= (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return np.where(there, image[np.where(there, row, 0), np.where(there, column, 0)], np.nan)
