"""Score tests against the formulas that they stand for, and by how often they are wrong."""

import numpy as np
import pytest
from helpers.mixed_models import (
    FIELD,
    GROUP,
    KINDS,
    PLACE,
    SHARED,
    SIDE,
    TURN,
    drawn,
    mixed_model,
)
from scipy import stats

from fisheye_svp_ros.mixed_model import (
    LAMBDA_ABSENT,
    Variances,
    component_squares,
    eliminate,
    factor_equations,
    identifiable_basis,
    integrate_columns,
    make_equations,
    pseudo_inverse,
    satterthwaite_freedom,
    score_columns,
    score_components,
    score_each,
    subtract_fit,
)
from fisheye_svp_ros.mixed_model.score_tests import _least_p_value

ABSENT = [(GROUP,), (TURN, SIDE), (PLACE, SIDE), (SHARED,), (FIELD, GROUP), KINDS]


def information_of(columns, y, variance):
    """Return the products of columns and y over the noise variance, as of whitened rows."""
    both = np.column_stack([columns, y])
    return both.T @ both / variance


def test_the_statistic_is_the_sum_of_squares_that_a_fit_explains():
    """Over the noise variance, on chi-square of the rank: a column too many counts for none."""
    rng, variance = np.random.default_rng(3), 0.25
    columns = rng.normal(size=(40, 4)) / np.sqrt(40)
    columns[:, 2] = columns[:, 0] - 2 * columns[:, 1]
    y = columns @ [0.5, 0.2, 0.0, 0.3] + np.sqrt(variance) * rng.normal(size=40)
    scale = np.array([2.0, 3.0, 4.0, 5.0])
    found = score_columns(
        information_of(columns, y, variance), np.array([0, 1, 2]), scale, variance
    )
    fit, _, rank, _ = np.linalg.lstsq(columns[:, :3], y, rcond=1e-9)
    explained = np.sum((columns[:, :3] @ fit) ** 2) / variance
    assert found.rank == rank == 2
    assert found.statistic == pytest.approx(explained, rel=1e-9)
    assert found.p_value == pytest.approx(stats.chi2.sf(explained, 2), rel=1e-9)
    assert found.freedom == np.inf
    # The estimate of least norm, over the norms that columns were divided by.
    np.testing.assert_allclose(found.estimate, fit / scale[:3], rtol=1e-7)
    again = score_each(
        information_of(columns, y, variance),
        [np.array([3]), np.array([0, 1, 2]), np.array([1])],
        scale,
        variance,
    )
    assert again[1].statistic == found.statistic and again[0].rank == again[2].rank == 1
    alone = (columns[:, 3] @ y) ** 2 / (columns[:, 3] @ columns[:, 3]) / variance
    assert again[0].statistic == pytest.approx(alone)


def test_a_column_of_which_nothing_is_left_is_not_tested():
    """Less than 1e-8 of the square of a normalized column, which has 1 / variance of it."""
    variance = 0.01
    for left, rank in ((0.5e-8, 0), (2e-8, 1)):
        information = np.array([[left, 3.0 * left], [3.0 * left, 1.0]]) / variance
        found = score_columns(information, np.array([0]), np.ones(1), variance)
        assert found.rank == rank
        assert (found.p_value == 1.0) == (rank == 0)


def test_p_values_are_uniform_where_there_is_nothing():
    """Kolmogorov-Smirnov of 2000 trials: by chance alone, one in ten thousand fails."""
    rng, p = np.random.default_rng(4), []
    columns = rng.normal(size=(30, 3))
    columns /= np.linalg.norm(columns, axis=0)
    for _ in range(2000):
        y = 0.3 * rng.normal(size=30)
        p.append(
            score_columns(information_of(columns, y, 0.09), np.arange(3), np.ones(3), 0.09).p_value
        )
    assert stats.kstest(p, 'uniform').pvalue > 1e-4


def test_columns_are_eliminated_as_by_a_regression_on_them():
    rng = np.random.default_rng(5)
    columns = rng.normal(size=(30, 5))
    columns[:, 1] = -2 * columns[:, 0]
    information, included = columns.T @ columns, np.array([0, 1, 3])
    fit = np.linalg.lstsq(columns[:, included], columns, rcond=1e-9)[0]
    left = columns - columns[:, included] @ fit
    np.testing.assert_allclose(eliminate(information, included), left.T @ left, atol=1e-9)
    combination = np.array([0.0, 0.0, 1.0, 0.0, -2.0])
    found = subtract_fit(information, included, combination)
    np.testing.assert_allclose(columns @ found, left @ combination, atol=1e-9)
    assert found[2] == 1.0 and found[4] == -2.0


def test_a_pseudoinverse_leaves_out_what_is_too_small():
    turn = np.linalg.qr(np.random.default_rng(6).normal(size=(3, 3)))[0]
    values = np.array([4.0, 1.0, 1e-9])
    matrix = turn * values @ turn.T
    without = turn[:, :2] / values[:2] @ turn[:, :2].T
    np.testing.assert_allclose(pseudo_inverse(matrix), without, atol=1e-9)
    np.testing.assert_allclose(
        pseudo_inverse(matrix, 1e-12), np.linalg.inv(matrix), rtol=1e-5, atol=1
    )
    np.testing.assert_allclose(
        pseudo_inverse(matrix, 1e-12, least=2.0), turn[:, :1] / 4 @ turn[:, :1].T, atol=1e-9
    )
    assert not pseudo_inverse(np.zeros((2, 2))).any()


def test_a_basis_is_orthonormal_beside_what_groups_fit(model):
    columns = np.concatenate([model.border, model.border[..., :1] * 2], axis=-1)
    columns = np.concatenate([columns, model.group_fixed[..., :1] * 0.5], axis=-1)
    chosen = np.array([0, 1, 3, 4])
    basis = identifiable_basis(model.group_fixed, columns, chosen)
    assert basis.shape == (5, 2) and not basis[2].any()
    flat = columns.reshape(-1, 5) @ basis
    g = model.fixed(shared=False)
    left = flat - g @ np.linalg.lstsq(g, flat, rcond=None)[0]
    np.testing.assert_allclose(left.T @ left, np.eye(2), atol=1e-9)


@pytest.mark.parametrize('prior', [0.5, np.array([0.5, 4.0])], ids=['one', 'each'])
def test_columns_of_the_border_can_be_random(model, prior):
    f = model.factored()
    logs, information = integrate_columns(f, np.array([0, 1]), prior)
    x, v = model.flat[:, :2], model.covariance()
    wider = v + x / prior @ x.T
    g = model.fixed(shared=False)
    inverse = np.linalg.inv(wider)
    p = inverse - inverse @ g @ np.linalg.inv(g.T @ inverse @ g) @ g.T @ inverse
    assert information[-1, -1] == pytest.approx(model.y @ p @ model.y, rel=1e-7)
    expected = np.linalg.slogdet(wider)[1] + np.linalg.slogdet(g.T @ inverse @ g)[1]
    assert logs == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize('absent', ABSENT, ids=str)
def test_the_score_of_a_component_is_held_against_a_gamma_distribution(model, absent):
    """Of the sum of squares of Z' P y, whose mean and variance are traces of Z' P Z."""
    fewer = model.with_lam(*absent)
    eq = make_equations(model.random, model.group_fixed, model.border)
    now = Variances(1.0, fewer.lam, fewer.weight)
    found = score_components(eq, now, absent)
    p, variance = fewer.projector(), fewer.variance
    for kind in absent:
        z, _ = fewer.of(kind)
        square = ((z.T @ p @ fewer.y) ** 2).sum() / variance
        inside = z.T @ p @ z
        mean, spread = np.trace(inside), 2 * (inside**2).sum()
        expected = stats.gamma.sf(square, mean**2 / spread, scale=spread / mean)
        assert found[kind] == pytest.approx(expected, rel=1e-5)
    assert np.isnan(found[[kind for kind in KINDS if kind not in absent]]).all()
    assert np.isnan(score_components(eq, now, [])).all()


def test_p_values_of_components_are_right_as_often_as_they_say():
    """At 5 %, of 200 sets without them; three standard errors of such a share."""
    base = mixed_model(True, groups=8, sigma=1.0).with_lam(*KINDS)
    rng, p = np.random.default_rng(8), []
    now = Variances(1.0, base.lam, base.weight)
    for _ in range(200):
        one = drawn(base, rng, 0.5)
        eq = make_equations(one.random, one.group_fixed, one.border)
        p.append(score_components(eq, now, KINDS))
    share = (np.array(p) < 0.05).mean(axis=0)
    error = np.sqrt(0.05 * 0.95 / 200)
    assert (np.abs(share - 0.05) < 3 * error + 0.01).all(), share  # Lin's gamma is near, no more


def test_a_component_that_fixed_columns_take_up_cannot_be_tested(model):
    """What is left of its columns is rounding."""
    random = model.random._replace(group=model.group_fixed[..., [0, 0]])
    eq = make_equations(random, model.group_fixed, model.border)
    lam = np.full(len(KINDS), LAMBDA_ABSENT)
    found = score_components(eq, Variances(1.0, lam, model.weight), [GROUP, TURN, SHARED])
    assert np.isnan(found[[GROUP, TURN]]).all() and np.isfinite(found[SHARED])


@pytest.mark.parametrize('count', [1, 4, 60])
@pytest.mark.parametrize('ratio', [0.3, 1.0, 1.7, 4.0])
def test_a_lower_bound_of_a_p_value_is_below_that_of_every_shape(ratio, count):
    """Sums of unequal squares, one of them next to all or all alike: shapes 1/2 to count / 2."""
    shapes = np.geomspace(0.5, count / 2, 30)
    every = stats.gamma.sf(ratio * shapes, shapes)
    bound = _least_p_value(ratio, count)
    assert bound == pytest.approx(every.min(), rel=1e-9)


def test_where_a_bound_decides_the_bound_is_returned(model):
    """Above the limit certainly: a p-value of less work, that is not below the limit either."""
    fewer = model.with_lam(*KINDS)
    eq = make_equations(model.random, model.group_fixed, model.border)
    now = Variances(1.0, fewer.lam, fewer.weight)
    whole, quick = (score_components(eq, now, KINDS, limit) for limit in (1.0, 0.01))
    np.testing.assert_array_equal(whole < 0.01, quick < 0.01)
    assert (quick <= whole).all()


@pytest.mark.parametrize('kind', KINDS)
def test_squares_that_a_component_adds(model, kind):
    """Rows' squares beside what groups fit: of units given y, of others by their variance."""
    f = model.factored()
    eq = make_equations(model.random, model.group_fixed, model.border)
    now = Variances(1.0, model.lam, model.weight)
    z, _ = model.of(kind)
    g = model.fixed(shared=False)
    left = z - g @ np.linalg.lstsq(g, z, rcond=None)[0]
    own = (left**2).sum(axis=0)
    mean, covariance = model.posterior(kind)
    expected = (
        own @ (mean**2 / model.variance + np.diag(covariance))
        if kind in (PLACE, SIDE)
        else own.sum() / model.lam[kind]
    )
    assert component_squares(eq, f, now)[kind] == pytest.approx(expected, rel=1e-6)
    rest = model.with_lam(kind)
    now = Variances(1.0, rest.lam, rest.weight)
    assert component_squares(eq, rest.factored(), now)[kind] == 0


def test_degrees_of_freedom_are_those_of_the_delta_method(model):
    """Twice the information squared over its variance, by how it moves with each variance."""
    f, combination = model.factored(), np.array([1.0, -0.4, 0.0])
    rng = np.random.default_rng(9)
    root = 0.1 * rng.normal(size=(7, 7))
    covariance = root @ root.T

    def log_information(change):
        """Return the logarithm at log tau^2 and log sigma^2 changed so."""
        lam = model.lam * np.exp(change[-1] - change[:-1])
        moved = factor_equations(f.equations, lam, model.weight).information
        return np.log(combination @ moved @ combination) - change[-1]

    step = 1e-5
    slope = [
        (log_information(step * axis) - log_information(-step * axis)) / (2 * step)
        for axis in np.eye(7)
    ]
    expected = 2 / (slope @ covariance @ slope)
    assert 2 < expected < 1e6
    found = satterthwaite_freedom(f, combination, covariance)
    assert found == pytest.approx(expected, rel=1e-5)


def test_degrees_of_freedom_stay_where_tables_end(model):
    f, combination = model.factored(), np.array([1.0, 0.0, 0.0])
    assert satterthwaite_freedom(f, combination, 1e6 * np.eye(7)) == 2.0
    for certain in (1e-12 * np.eye(7), np.zeros((7, 7))):
        assert satterthwaite_freedom(f, combination, certain) == 1e6
    assert np.isfinite(satterthwaite_freedom(f, np.zeros(3), np.eye(7)))
