"""Sets of few photographs: their image points, ray errors against the truth, the page."""

from __future__ import annotations

import numpy as np
import pytest

from benchmark.studies.averaging import Outcome, report
from benchmark.studies.boards import draw_lens, draw_set, image_points
from benchmark.study import ray_error
from fisheye_svp_ros.effects.forward import project_corrected
from fisheye_svp_ros.optics.curves import Gennery


def test_points_are_imaged_as_by_the_package() -> None:
    lens = draw_lens(np.random.default_rng(5)).with_shift(Gennery(0.0, 0.004, 0.001))
    points = np.random.default_rng(6).normal([0.0, 0.0, 0.25], 0.1, (50, 3))
    theirs = project_corrected(lens, points)
    uv, _ = image_points(lens, points)
    assert uv[theirs.valid] == pytest.approx(theirs.uv[theirs.valid], abs=1e-6)


def test_a_set_is_seen_and_its_lens_has_no_ray_error_to_itself() -> None:
    table, truth = draw_set(3)
    assert 5 <= len(table.frames) <= 8 and len(table) >= 25 * len(table.frames)
    assert ray_error(truth, truth, table.uv) == 0.0
    assert ray_error(truth.with_shift(Gennery(0.0, 0.003)), truth, table.uv) > 0.05


def test_the_page_has_geometric_means_and_lenses_that_got_worse() -> None:
    outcomes = [
        Outcome(0.002, 0.001, 0.001, 0.5, False, (1.0, 0.5, 0.25)),
        Outcome(0.002, 0.001, 0.001, 0.5, False, (1.0, 2.0, 1.0)),
    ]
    page = report(outcomes, 'command')
    assert '| a shift that is not named | 2 | 1.000 (1) | 0.500 (0) |' in page
    assert 'no shift |' not in page and '`command`' in page
