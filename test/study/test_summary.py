"""Summaries of metrics."""

from __future__ import annotations

import numpy as np

from fisheye_svp_ros.study.summary import summarize


def test_only_finite_values_count() -> None:
    assert summarize(np.array([3.0, np.nan, -5.0, 1.0, np.inf])) == (3, 2, 1.0, -1 / 3, 5.0)


def test_without_a_value_there_is_none() -> None:
    for values in (np.empty(0), np.full(5, np.nan)):
        result = summarize(values)
        assert result[:2] == (0, len(values)) and np.isnan(result[2:]).all()
