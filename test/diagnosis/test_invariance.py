"""Better or more data, of the same world, never lead to a worse answer."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from helpers.flawed_sets import Camera, board, draw_views, observe

from fisheye_svp_ros.diagnosis import Diagnosis, DiagnosisOptions, diagnose
from fisheye_svp_ros.mixed_model import pseudo_inverse
from fisheye_svp_ros.solve.lens_calibration import calibrate

# One process makes each diagnosis once.
pytestmark = pytest.mark.xdist_group('invariance')
# The best answer is 0: a lens to use now is one, as given or extended.
RANKS = {
    'lens': {'keep': 0, 'use_extended': 0, 'undecided': 1, 'recalibrate': 2},
    'target': {'keep': 0, 'correct': 1, 'measure_again': 2, 'undecided': 3},
    'photographs': {'enough': 0, 'more': 1, 'retake': 2},
}
NOISES = (0.3, 0.1, 0.03, 0.01)


@cache
def diagnosed(
    noise: float, frames: int = 16, angle: float = 0.9, bend: float = 0.0, offset: float = 0.0
) -> Diagnosis:
    """Diagnose views of one world; offset: rms, m, of landmarks; bend: of the sheet, by frame."""
    points, camera = board(), Camera()
    true = points + offset * np.random.default_rng(5).normal(size=points.shape)
    views = draw_views(np.random.default_rng(3), true, frames, angle, bend=bend)
    table = observe(np.random.default_rng(4), [camera] * frames, views, points, noise)
    lens = calibrate(table, 'kannala_brandt', camera.size).adjusted.lens
    return diagnose(table, lens, options=DiagnosisOptions(quick=True))


def ranks(found: Diagnosis) -> dict[str, int]:
    return {about: RANKS[about][one.say] for about, one in found.decision.items()}


def assert_not_worse(before: Diagnosis, after: Diagnosis) -> None:
    was, now = ranks(before), ranks(after)
    assert all(now[about] <= was[about] for about in was), (was, now, after.adequacy.flaws)


@pytest.mark.parametrize('world', [{}, {'bend': 1e-3}, {'offset': 5e-5}], ids=str)
def test_less_noise_never_leads_to_a_worse_answer(world: dict[str, float]) -> None:
    """A sheet that bends was "Keep the lens" at .1 px, and "Do not use" at .03 px."""
    found = [diagnosed(noise, **world) for noise in NOISES]
    for before, after in pairwise(found):
        assert_not_worse(before, after)
    assert not any(ranks(found[-1]).values())


def test_more_frames_and_wider_views_never_lead_to_a_worse_answer() -> None:
    found = diagnosed(0.1, bend=1e-3)
    assert_not_worse(found, diagnosed(0.1, frames=32, bend=1e-3))
    assert_not_worse(found, diagnosed(0.1, angle=1.2, bend=1e-3))


def test_a_sheet_that_bends_by_frame_is_told_with_its_size_and_forbids_nothing() -> None:
    found = diagnosed(0.03, bend=1e-3)
    facts = found.decision['target'].facts
    assert facts.bend_m == pytest.approx(1e-3, rel=0.4) and facts.bend_share > 0.9
    assert not found.adequacy.flaws


def test_a_refit_beside_boards_that_bend_much_ends_at_its_minimum() -> None:
    """It stopped on the way: rays of the extended lens were 8 times as wrong as those as given."""
    found = diagnosed(0.1, bend=3e-3)
    null = found.evaluation.null
    own = null.included_columns
    inverse = pseudo_inverse(null.information[np.ix_(own, own)], 1e-13)
    step = np.abs(inverse @ null.information[own, -1]) / np.sqrt(np.diag(inverse))
    assert step.max() < 1.5 * null.variances.sigma  # what is left to go, in standard errors
