"""Ray errors of halves: the table; the figures are in docs/results/ray_halves.md."""

from dataclasses import replace

import numpy as np
from helpers.scenes import lens, observe, scene

from benchmark.studies.ray_halves import set_rows
from fisheye_svp_ros.solve.ray_errors import RayError


def test_rows_say_how_far_a_half_is_from_all_frames() -> None:
    rng = np.random.default_rng(1)
    table = observe(lens(), (), *scene(rng, frames=4), 0.1, rng)
    stated = [RayError(1.0, 4e-3, 3e-3, 5e-3), RayError(1.0, 1e-3, 0.0, 2e-3)]
    wide = replace(lens(), fx=1.01 * lens().fx, fy=1.01 * lens().fy)
    half, whole = set_rows(
        'set', table, {'even frames': (wide, lens(), stated), 'all frames': (wide, lens(), stated)}
    )
    off = float(half[3])
    assert 0.1 < off < 10  # mrad: a hundredth of the angles, but for a common motion
    assert half[4:] == ['1.00 (0.00 to 2.00)', '0.00']
    whole_row = ['set', 'all frames', '4.00 (3.00 to 5.00)', half[3], '1.00 (0.00 to 2.00)', '-']
    assert whole == whole_row
