"""Summaries of metrics that are kept in a file: those of NumPy, to the bit."""

from __future__ import annotations

from io import BytesIO

import numpy as np
import pytest

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.study import summary
from fisheye_svp_ros.study.summary import StoredMetric, Summary


def summarize(values: Array, size: int) -> Summary:
    """Return the summary of values that come some at a time."""
    metric = StoredMetric(BytesIO())
    for first in range(0, len(values), size):
        metric.add(values[first : first + size])
    return metric.summarize()


@pytest.mark.parametrize('scale', [1e-9, 1.0, 1e300])
@pytest.mark.parametrize('decimals', [1, 20])  # many values are equal, or none
@pytest.mark.parametrize('count', [1, 2, 7, 500, 501, 4097, 20_000])
def test_it_is_that_of_an_array(
    count: int, decimals: int, scale: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(summary, '_BLOCK', 1024)
    rng = np.random.default_rng(count)
    known = scale * np.round(rng.normal(0.3, 1.0, count), decimals)
    gaps = rng.integers(0, count, 3)
    result = summarize(np.insert(known, gaps, [np.nan, np.inf, -np.inf]), 300)
    assert result[:2] == (count, 3)
    assert result.median == np.median(known)
    assert result.mean == known.mean()
    assert result.largest == np.abs(known).max()


def test_without_a_value_there_is_none() -> None:
    for values in (np.empty(0), np.full(5, np.nan)):
        result = summarize(values, 2)
        assert result[:2] == (0, len(values)) and np.isnan(result[2:]).all()


def test_values_may_follow_a_summary() -> None:
    metric = StoredMetric(BytesIO())
    metric.add(np.array([3.0, -5.0]))
    assert metric.summarize() == (2, 0, -1.0, -1.0, 5.0)
    metric.add(np.array([2.0, np.nan]))
    assert metric.summarize() == (3, 1, 2.0, 0.0, 5.0)
