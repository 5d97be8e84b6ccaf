"""Errors where the truth is known: their intervals."""

from __future__ import annotations

import numpy as np
import pytest

from fisheye_svp_ros.diagnosis.cross_validation import compare_errors


def test_the_interval_of_a_gain_holds_95_percent() -> None:
    rng = np.random.default_rng(5)
    count, before, after = 400, 10.0, 5.0
    found = compare_errors(before + rng.standard_normal(count), after + rng.standard_normal(count))
    error = np.sqrt((1 + (after / before) ** 2) / count) / before  # of a ratio of means
    assert found.high - found.low == pytest.approx(2 * 1.96 * error, rel=0.1)
    assert found.low < found.value < found.high
    assert found.value == pytest.approx(1 - after / before, abs=4 * error)


def test_a_sample_without_an_error_before_gains_nothing() -> None:
    """Five rigs, of which one is the middle of all, divided by zero in the bootstrap."""
    found = compare_errors(np.array([0.0, 1.0]), np.array([0.1, 0.5]))
    assert np.isfinite(found).all()
    assert compare_errors(np.zeros(3), np.ones(3)).value == 0.0
