"""Levels of maps."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from fisheye_svp_ros.reporting.style import error_levels


@pytest.mark.parametrize(('low', 'high'), [(1e-5, 1e-5), (2e-1, 300.0), (1e-6, 1e3)])
def test_levels_begin_below_what_is_least_and_are_few(low: float, high: float) -> None:
    levels = error_levels(np.geomspace(low, high, 1000))
    assert 2 <= len(levels) <= 9 and levels[0] <= low * 1.2
    assert all(1.9 < b / a < 2.6 for a, b in pairwise(levels))
