"""One probability and one status per cause, and nothing that contradicts them."""

from __future__ import annotations

from math import e

import numpy as np
import pytest
from helpers.contradictions import check
from helpers.scenes import lens, observe, scene

from fisheye_svp_ros.diagnosis import (
    Cause,
    DiagnosisOptions,
    Finding,
    Reason,
    Status,
    diagnose,
)
from fisheye_svp_ros.diagnosis.findings import probability_of, status_of
from fisheye_svp_ros.effects.base import ModelTerm
from fisheye_svp_ros.effects.catalogue import CATALOGUE


def test_a_corrected_p_value_bounds_the_probability() -> None:
    """Sellke, Bayarri and Berger print what the null keeps: .289 at .05, .111 at .01."""
    assert probability_of(0.05) == pytest.approx(1 - 0.289, abs=1e-3)
    assert probability_of(0.01) == pytest.approx(1 - 0.111, abs=1e-3)
    assert probability_of(1.0) == probability_of(1 / e) == 0.5 and probability_of(0.0) == 1.0


def test_the_status_follows_from_the_probability() -> None:
    assert status_of(0.97, True) is Status.CONFIRMED
    assert status_of(0.97, False) is status_of(0.7, True) is Status.LIKELY
    assert status_of(0.4, True) is Status.NOT_NEEDED


def test_what_held_out_frames_refute_is_not_probable() -> None:
    """A shift stood under "Not confirmed" with a probability of more than 99 %."""
    refuted = Finding('viewpoint_shift', Reason.REFUTED_BY_FRAMES, 1e-30, 1e-28, z=-1.4)
    assert refuted.status is Status.REFUTED and refuted.probability < 0.3
    far = Finding('viewpoint_shift', Reason.IMPLAUSIBLE, 1e-30, 1e-28)
    assert far.status is Status.REFUTED and far.probability == 0.0


def test_no_gain_refutes_nothing() -> None:
    """Offsets of landmarks may predict the same: a bend with p = 5e-156 was "not confirmed"."""
    bend = Finding('target_shape', Reason.NO_GAIN, 1e-158, 5e-156, z=0.3)
    assert bend.status is Status.LIKELY and bend.probability > 0.99


def test_a_cause_that_loses_on_held_out_frames_is_not_confirmed() -> None:
    assert Cause('sensor_tilt', {}, 1e-9, 0.2, True, 0.1, 0.3).status is Status.CONFIRMED
    assert Cause('sensor_tilt', {}, 1e-9, 0.2, True, 0.1, -0.025).status is Status.LIKELY


HIDDEN: list[tuple[str, list[float], float, int]] = [
    ('', [], 0.1, 8),
    ('viewpoint_shift', [0.008], 0.05, 12),
    ('viewpoint_shift', [0.003], 0.2, 10),
    ('viewpoint_shift', [0.008], 0.01, 1),
    ('sensor_tilt', [0.01, -0.01], 0.1, 10),
]


@pytest.mark.parametrize(('effect', 'values', 'noise', 'frames'), HIDDEN)
def test_nothing_contradicts_the_belief(
    effect: str, values: list[float], noise: float, frames: int
) -> None:
    rng = np.random.default_rng(5)
    terms = [ModelTerm(CATALOGUE[effect](), np.array(values))] if effect else []
    found = diagnose(
        observe(lens(), terms, *scene(rng, frames=frames), noise, rng),
        lens(),
        options=DiagnosisOptions(quick=frames > 10),
    )
    check(found)


def test_what_may_as_well_be_zero_is_not_confirmed() -> None:
    """A tilt of -0.03 +- 0.11 deg was "confirmed, more than 99 %"."""
    tilt = {'about_x': {'value': -6e-4, 'stderr': 2e-3, 'unit': 'rad'}}
    cause = Cause('sensor_tilt', tilt, 1e-9, 0.2, True, 0.1, 0.3)
    assert cause.is_within_error and cause.status is Status.LIKELY
