"""Images of two cameras side by side in one: found by their shape and by where the board is."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import islice

import numpy as np

from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.detect.finders import default_detector
from fisheye_svp_ros.detect.patterns import Pattern
from fisheye_svp_ros.detect.photographs import Photograph
from fisheye_svp_ros.detect.points import find_points
from fisheye_svp_ros.errors import FisheyeSvpError
from fisheye_svp_ros.scene.observations import Observations

MIN_ASPECT = 1.9  # width over height: of two square images 2, of one sensor 1.78 at most
_TRIED, _NEEDED = 6, 2  # photographs that are searched, and that must show the board twice
_MIN_VIEWS = 3  # on either side of the middle
_CHANCE = 0.05  # of frames of one camera to stay away from the middle so far


def count_cameras(photographs: Iterable[Photograph], pattern: Pattern, detector: str = '') -> int:
    """Return how many cameras lie side by side: 2 where both halves show the board at once."""
    detector, both = detector or default_detector(pattern), 0
    for photograph in islice(photographs, _TRIED):
        try:
            pixels = photograph.pixels()
        except FisheyeSvpError:
            continue
        if pixels.shape[1] < MIN_ASPECT * pixels.shape[0]:
            return 1
        halves = (part.pixels() for part in photograph.split(2))
        both += all(not isinstance(find_points(half, pattern, detector), str) for half in halves)
        if both == _NEEDED:
            return 2
    return 1


def looks_side_by_side(table: Observations, size: tuple[int, int]) -> bool:
    """Whether no frame of one camera lies across the middle of wide images, or near it."""
    width, height = size
    if width < MIN_ASPECT * height or not len(table):
        return False
    views = [table.uv[table.frame == frame, 0] for frame in table.frames]
    low, high = (np.array([end(view) for view in views]) for end in (np.min, np.max))
    middle = (width - 1) / 2
    left, right = high < middle, low > middle
    if (left ^ right).all() and min(left.sum(), right.sum()) >= _MIN_VIEWS:
        return _chance((low + high) / 2 / width, left) < _CHANCE
    return False


def _chance(center: Array, left: Mask) -> float:
    """Return how often places (F,), spread evenly over 0 to 1, leave such a gap at a half."""
    gap, others = center[~left].min() - center[left].max(), len(center) - 1
    return float((1 - gap) ** others * (1 + others * gap))
