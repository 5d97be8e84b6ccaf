"""Thirds of the frames: chi^2 of estimates; the figures are in docs/results/thirds.md."""

import numpy as np

from benchmark.studies.thirds import NAMES, agreement, report


def test_estimates_that_scatter_as_stated_have_a_mean_of_one():
    rng = np.random.default_rng(3)
    errors = rng.uniform(0.5, 2.0, (4000, 3, 1))
    value = 7.0 + errors * rng.normal(size=errors.shape)
    chi2 = agreement(np.stack([value, errors], axis=-1))
    assert chi2.shape == (4000, 1)
    assert abs(chi2.mean() - 1.0) < 0.05
    assert abs(agreement(np.stack([value, errors / 2], axis=-1)).mean() - 4.0) < 0.2


def test_a_number_that_is_left_open_counts_in_no_mean():
    values = np.full((2, len(NAMES)), 3.0)
    values[0, 0], values[:, 1] = np.nan, np.nan
    page = report({'set | its own': values}, 2, 'python -m benchmark.studies.thirds')
    assert '| set | its own | 3.0 | - | 3.0 |' in page
