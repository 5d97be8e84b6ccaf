"""Mahalanobis distances of ray errors: those of the dense covariance, whatever its rank."""

import numpy as np
import pytest

from fisheye_svp_ros.diagnosis import lens_evidence


@pytest.mark.parametrize('rank', [10, 100])
def test_distances_are_those_of_the_dense_covariance(monkeypatch, rank):
    rng, floor, sizes = np.random.default_rng(0), 5e-5, []
    columns = rng.normal(size=(360, rank)) * 10.0 ** rng.uniform(-6, -2, rank)
    samples = columns @ rng.normal(size=(rank, 200))
    off = 1e-4 * rng.normal(size=360) + samples[:, 3]
    covariance = samples @ samples.T / 200 + floor**2 * 360 / 3 * np.eye(360)
    both = np.column_stack([off, samples])
    expected = np.sqrt((both * np.linalg.solve(covariance, both)).sum(axis=0))

    def solve_lower(root, right):
        sizes.append(len(root))
        return np.linalg.solve(root, right)

    monkeypatch.setattr(lens_evidence, 'solve_lower', solve_lower)
    distance, drawn = lens_evidence._distances(
        off.reshape(-1, 3), samples.reshape(-1, 3, 200), floor
    )
    assert distance == pytest.approx(expected[0], rel=1e-6)
    assert drawn == pytest.approx(expected[1:], rel=1e-6)
    assert sizes == [64 if rank < 64 else 360]
