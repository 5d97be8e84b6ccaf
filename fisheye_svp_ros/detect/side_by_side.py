"""Images of two cameras side by side in one: found by the board that both halves show."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import islice

from fisheye_svp_ros.detect.finders import default_detector
from fisheye_svp_ros.detect.patterns import Pattern
from fisheye_svp_ros.detect.photographs import Photograph
from fisheye_svp_ros.detect.points import find_points
from fisheye_svp_ros.errors import FisheyeSvpError
from fisheye_svp_ros.scene.table_checks import MIN_ASPECT

_TRIED, _NEEDED = 6, 2  # photographs that are searched, and that must show the board twice


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
