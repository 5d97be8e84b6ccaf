"""All likely subsets of added columns, against every subset with dense covariances."""

import itertools

import numpy as np
import pytest
from scipy import stats

from fisheye_svp_ros.mixed_model import (
    Options,
    Products,
    estimate_models,
    find_coefficients,
    find_models,
    log_evidence,
)
from fisheye_svp_ros.mixed_model.model_averaging import _root_beside_prior

ROWS = 40
NONE = np.zeros((0, 5), dtype=bool)


def problem(seed=0):
    """Return columns (ROWS, 6), y (ROWS,), five options, one of two columns, two in conflict."""
    rng = np.random.default_rng(seed)
    columns = rng.normal(size=(ROWS, 6))
    columns[:, 1] = columns[:, 0] + 0.3 * columns[:, 1]
    y = columns @ [0.8, 0.0, 0.3, 0.2, 0.0, 0.0] + rng.normal(size=ROWS)
    sd = np.array([[0.5, 0.0], [0.5, 0.0], [1.0, 2.0], [0.3, 0.0], [0.6, 0.0]])
    conflict = np.zeros((5, 5), dtype=bool)
    conflict[0, 1] = conflict[1, 0] = True
    options = Options(
        np.array([[0, 0], [1, 0], [2, 3], [4, 0], [5, 0]]),
        sd,
        np.log([0.5, 0.2, 0.3, 0.1, 1.0]),
        np.zeros(5, dtype=bool),
        conflict,
    )
    both = np.column_stack([columns, y])
    return columns, y, options, Products(both.T @ both, float(ROWS))


def all_models(options):
    every = np.array([*itertools.product([False, True], repeat=len(options.log_odds))])
    return every[~(every[:, :, None] & every[:, None] & options.conflict).any(axis=(1, 2))]


def dense_log(columns, y, options, model):
    """Return the log of a multivariate t with no degrees of freedom of its own, and the prior."""
    at = np.concatenate(
        [options.columns[i][options.sd[i] > 0] for i in np.flatnonzero(model)] or [[]]
    )
    sd = np.concatenate([options.sd[i][options.sd[i] > 0] for i in np.flatnonzero(model)] or [[]])
    moved = columns[:, at.astype(int)] * sd
    covariance = np.eye(ROWS) + moved @ moved.T
    square = y @ np.linalg.solve(covariance, y)
    logs = np.linalg.slogdet(covariance)[1]
    return -logs / 2 - ROWS / 2 * np.log(square) + options.log_odds[model].sum()


@pytest.mark.parametrize('seed', range(3))
def test_models_and_their_weights_are_those_of_every_subset(seed):
    columns, y, options, products = problem(seed)
    every = all_models(options)
    logs = np.array([dense_log(columns, y, options, model) for model in every])
    np.testing.assert_allclose(log_evidence(products, options, every), logs, atol=1e-8)
    weight = np.exp(logs - logs.max())
    weight /= weight.sum()
    found = find_models([products], options, NONE)
    for option in range(5):
        chosen = np.arange(5) == option
        expected = weight @ every[:, option]
        assert found.probability(chosen) == pytest.approx(expected, abs=2e-3)
    known = {tuple(model): share for model, share in zip(every.tolist(), weight, strict=True)}
    for model, share in zip(found.there.tolist(), found.weight, strict=True):
        assert share == pytest.approx(known[tuple(model)], abs=2e-3)


def test_a_pair_is_found_behind_what_stands_in_for_it():
    """Best first by additions alone ends beside the stand-in: taking it away leads to the pair."""
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2, 4000))
    stand_in = a + b + 0.3 * rng.normal(size=4000)
    both = np.column_stack([a, b, stand_in, a + b + rng.normal(size=4000)])
    options = Options(
        np.arange(3)[:, None],
        np.ones((3, 1)),
        np.full(3, np.log(0.1)),
        np.zeros(3, dtype=bool),
        np.zeros((3, 3), dtype=bool),
    )
    products = Products(both.T @ both, 4000.0)
    one = log_evidence(products, options, np.eye(3, dtype=bool))
    assert one.argmax() == 2
    found = find_models([products], options, np.zeros((0, 3), dtype=bool))
    assert found.there[0].tolist() == [True, True, False]
    assert found.weight[0] > 0.5


def test_coefficients_are_those_of_ridge_regression():
    columns, y, options, products = problem()
    model = np.array([False, True, True, False, True])
    found = find_coefficients(products, options, np.stack([model, np.zeros(5, dtype=bool)]))
    at, sd = [1, 2, 3, 5], np.array([0.5, 1.0, 2.0, 0.6])
    information = columns[:, at].T @ columns[:, at] + np.diag(sd**-2.0)
    dense = np.zeros(6)
    dense[at] = np.linalg.solve(information, columns[:, at].T @ y)
    mean, square = np.zeros(6), np.zeros((6, 6))
    np.add.at(mean, found.columns[0], found.mean[0])
    np.add.at(
        square,
        (found.columns[0][:, None], found.columns[0][None]),
        found.root[0] @ found.root[0].T,
    )
    np.testing.assert_allclose(mean, dense, atol=1e-10)
    np.testing.assert_allclose(square[np.ix_(at, at)], np.linalg.inv(information), atol=1e-10)
    left = y - columns @ dense
    rest = left @ left + (dense[at] / sd) @ (dense[at] / sd)
    assert found.variance[0] == pytest.approx(rest / ROWS)
    assert not found.mean[1].any() and found.variance[1] == pytest.approx(y @ y / ROWS)


def test_a_size_that_is_only_ever_positive_counts_its_own_side_alone():
    _, _, options, products = problem()
    one = np.eye(5, dtype=bool)[4:]
    signed = options._replace(positive=np.array([False] * 4 + [True]))
    size = (products.matrix[5, 5] + 0.6**-2) ** -0.5
    mean = products.matrix[5, -1] * size**2
    found = find_coefficients(products, options, one)
    share = stats.norm.cdf(mean / size / np.sqrt(found.variance[0]))
    gain = log_evidence(products, signed, one) - log_evidence(products, options, one)
    assert gain[0] == pytest.approx(np.log(2 * share), abs=1e-8)


def test_what_is_always_there_is_fitted_along_without_a_prior():
    columns, y, options, _ = problem()
    always = np.random.default_rng(9).normal(size=(ROWS, 2)) + columns[:, :1]
    whole = np.column_stack([always, columns, y])
    products = Products.eliminating(whole.T @ whole, np.arange(2), np.arange(2, 8), float(ROWS))
    model = np.array([True, False, True, False, False])
    found = estimate_models(products, options, model[None])
    at, sd = [0, 1, 2, 4, 5], np.array([np.inf, np.inf, 0.5, 1.0, 2.0])
    information = whole[:, at].T @ whole[:, at] + np.diag(sd**-2.0)
    dense = np.linalg.solve(information, whole[:, at].T @ y)
    np.testing.assert_allclose(found.values[0, at], dense, atol=1e-9)
    left = y - whole[:, at] @ dense
    variance = (left @ left + (dense / sd) @ (dense / sd)) / (ROWS - 2)
    covariance = variance * np.linalg.inv(information)
    np.testing.assert_allclose(found.covariance[0][np.ix_(at, at)], covariance, atol=1e-9)
    alone, more = np.zeros((1, 5), dtype=bool), np.eye(5, dtype=bool)[:1]
    gain = log_evidence(products, options, more) - log_evidence(products, options, alone)
    flat = np.column_stack([1e3 * always, 0.5 * columns[:, 0]])
    logs = []
    for moved in (flat[:, :2], flat):
        dense = np.eye(ROWS) + moved @ moved.T
        square = y @ np.linalg.solve(dense, y)
        logs.append(-np.linalg.slogdet(dense)[1] / 2 - (ROWS - 2) / 2 * np.log(square))
    assert gain[0] == pytest.approx(logs[1] - logs[0] + options.log_odds[0], abs=1e-3)


def test_products_of_several_kinds_share_the_models_by_their_likelihoods():
    _, _, options, products = problem()
    other = products._replace(log_likelihood=np.log(3.0))
    found = find_models([products, other], options, NONE)
    assert found.weight[found.base == 1].sum() == pytest.approx(0.75, abs=1e-3)


def test_a_block_that_rounding_makes_indefinite_has_a_root():
    """Without noise, prior sizes beside it are large: 1e30, with an eigenvalue of -1e18."""
    rng = np.random.default_rng(5)
    turn = np.linalg.qr(rng.normal(size=(4, 4)))[0]
    block = (turn * [1e30, 1e29, 1e20, -1e18]) @ turn.T
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.cholesky(block + np.eye(4))
    root = _root_beside_prior(block[None])[0]
    assert np.abs(root @ root.T - block).max() < 1e-9 * 1e30
    sound = np.array([[2.0, 1.0], [1.0, 3.0]])
    np.testing.assert_allclose(
        _root_beside_prior(sound), np.linalg.cholesky(sound + np.eye(2)), rtol=1e-15
    )
