"""Where rays of a moving viewpoint cross: by where neighboring rays meet."""

from __future__ import annotations

import numpy as np
import pytest

from fisheye_svp_ros.optics.curves import Gennery
from fisheye_svp_ros.optics.rays import caustic_range, search_limit

LIMIT = 1.5  # rad
SHIFTS = {
    'ahead': Gennery(0.03),
    'behind': Gennery(-0.03),
    'forward': Gennery(0.0, 0.004, 0.001),
    'backward': Gennery(0.0, -0.004, -0.001),
    'behind and forward': Gennery(-0.05, 0.002),
    'ahead and backward': Gennery(0.01, -0.02),
    'far out': Gennery(0.0, 0.05, 0.02),
}


def crossings(shift: Gennery) -> np.ndarray:
    """Return the distances, m, at which rays of the grid meet neighbors ahead of the axis."""
    theta = np.linspace(0.0, LIMIT, 257)[1:]
    near = theta - 1e-6

    def start(angle: np.ndarray) -> np.ndarray:
        return shift.value_and_slope(angle, np.tan(angle / 2))[0]

    # (0, s1) + a (sin t1, cos t1) = (0, s2) + b (sin t2, cos t2)
    along = (start(near) - start(theta)) * np.sin(near) / np.sin(near - theta)
    away = np.hypot(along * np.sin(theta), start(theta) + along * np.cos(theta))
    return away[along > 1e-9]


@pytest.mark.parametrize('shift', SHIFTS.values(), ids=SHIFTS)
def test_no_two_rays_meet_beyond_the_range_of_the_caustic(shift: Gennery) -> None:
    """Nor does one begin there: viewpoints behind the origin count as those ahead of it."""
    theta = np.linspace(0.0, LIMIT, 257)
    starts = np.abs(shift.value_and_slope(theta, np.tan(theta / 2))[0])
    expected = max(starts.max(), crossings(shift).max(initial=0.0))
    assert expected > 0.003
    assert caustic_range(shift, LIMIT) == pytest.approx(expected, rel=1e-4)


def test_rays_are_searched_for_a_little_beyond_the_field_of_view() -> None:
    shift = SHIFTS['forward']
    narrow = search_limit(shift, 1.0)
    assert 1.0 < narrow < 1.2
    assert search_limit(shift, 3.2) <= min(shift.limit, np.pi)
