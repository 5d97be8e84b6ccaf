"""Henderson's equations against the inverse of the whole covariance of y."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.mixed_models import FIELD, GROUP, KINDS, PLACE, SHARED, SIDE, TURN

from fisheye_svp_ros.mixed_model import (
    LAMBDA_ABSENT,
    Variances,
    factor_equations,
    make_equations,
    no_variances,
    solve_lower,
)

UNITS = {True: 7, False: 24}
ABSENT = [(), (GROUP,), (PLACE,), (PLACE, SIDE), (SHARED,), (TURN, SIDE, FIELD), KINDS]


def by_kind(eq, e, r):
    """Return coefficients of groups, of all units (zero where one has none) and shared ones."""
    group, some, shared = eq.split(e, r)
    unit = np.zeros((UNITS[eq.by_group], *some.shape[1:]))
    unit[eq.units] = some
    return group, unit, shared


@pytest.mark.parametrize('absent', ABSENT, ids=str)
def test_the_information_is_that_of_generalized_least_squares(model, absent):
    """All components or some: what is switched off leaves no trace."""
    model = model.with_lam(*absent)
    f, p = model.factored(), model.projector(shared=False)
    np.testing.assert_allclose(f.information, model.flat.T @ p @ model.flat, rtol=1e-7)
    assert f.log_determinant == pytest.approx(model.log_determinant(shared=False), abs=1e-6)


def test_degrees_of_freedom_are_rows_less_all_fixed_coefficients(model):
    """Padding is no row, a column of zeros no coefficient."""
    f = model.factored()
    assert f.equations.rows == model.used.sum() == 72 - 6
    assert f.equations.group_rank == 11
    assert f.freedom == 66 - 11 - 2


def test_rows_count_where_only_one_kind_of_fixed_column_is(model):
    border = np.zeros_like(model.border)
    alone = make_equations(model.random, model.group_fixed, border)
    assert alone.rows == model.used.sum()


def test_coefficients_of_a_combination_are_its_predictions(model):
    """Of groups, units and what is shared: D Z' P c, the fixed columns of the border known."""
    f, combination = model.factored(), np.array([0.3, -0.7, 1.0])
    group, unit, shared = by_kind(f.equations, *f.coefficients(combination))
    z, label, weight = model.columns()
    prior = np.where(label < 0, 0.0, 1 / (model.lam[label] * weight))
    rest = model.projector(shared=False) @ model.flat @ combination
    expected = prior * (z.T @ rest)
    found = np.concatenate([group[:, 2:].ravel(), unit.ravel(), shared])
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_solutions_and_projections_are_those_of_the_whole_matrix(model):
    """All columns side by side, priors on the diagonal."""
    f = model.factored()
    eq = f.equations
    z, label, weight = model.columns()
    groups = [
        np.concatenate([fixed / scale, own], axis=1)
        for fixed, scale, own in zip(
            model.group_fixed, eq.group_scale, model.random.group, strict=True
        )
    ]
    own = model._spread(groups)
    own_prior = np.tile([0.0, 0.0, *model.lam[[GROUP, TURN]]], len(groups))
    own_prior[(~np.isfinite(eq.group_scale)).nonzero()[0] * 4 + 1] = 1.0
    skip = own.shape[1] - 2 * len(groups)
    rest_prior = np.where(label < 0, 1.0, model.lam[label] * weight)[skip:]
    z = np.where(label < 0, 0.0, z)[:, skip:]
    columns = np.concatenate([own, z, model.flat[:, :-1]], axis=1)
    prior = np.concatenate([own_prior, rest_prior, np.zeros(2)])
    vectors = np.random.default_rng(1).normal(size=(len(columns), 3))
    solution = np.linalg.solve(columns.T @ columns + np.diag(prior), columns.T @ vectors)

    right = columns.T @ vectors
    count = own.shape[1]
    units = model.random.unit_label.size
    products = eq.join(
        right[:count].reshape(len(groups), -1, 3),
        right[count : count + units].reshape(-1, 2, 3),
        right[count + units : -2],
    )
    e, r, x = f.solve(*products, right[-2:])
    group, unit, shared = by_kind(eq, e, r)
    found = np.concatenate([group.reshape(-1, 3), unit.reshape(-1, 3), shared, x])
    np.testing.assert_allclose(found, solution, atol=1e-7)
    np.testing.assert_allclose(f.project(*products, right[-2:]), right.T @ solution, rtol=1e-7)
    # And products of coefficients with all columns.
    ge, gr, gx = eq.multiply(e, r)
    group, unit, shared = by_kind(eq, ge, gr)
    expected = columns[:, :-2].T @ columns[:, :-2] @ solution[:-2]
    found = np.concatenate([group.reshape(-1, 3), unit.reshape(-1, 3), shared])
    np.testing.assert_allclose(found, expected, atol=1e-6)
    np.testing.assert_allclose(
        gx, model.flat.T @ columns[:, :-2] @ solution[:-2], rtol=1e-7, atol=1e-7
    )


def test_squares_over_their_prior_variances_are_summed_by_component(model):
    f = model.factored()
    e, r = f.coefficients(np.array([0.0, 0.0, 1.0]))
    found = f.prior_squares(e, r)
    rest = model.projector(shared=False) @ model.y
    for kind in KINDS:
        z, weight = model.of(kind)
        assert found[kind] == pytest.approx(
            ((z.T @ rest) ** 2 / (model.lam[kind] * weight)).sum(), rel=1e-7
        )


@pytest.mark.parametrize('kind', [SHARED, FIELD])
def test_a_shared_component_without_a_prior_is_fixed(model, kind):
    found = factor_equations(model.equations().free_component(kind), model.lam, model.weight)
    rest, columns = model.with_lam(kind), model.of(kind)[0]
    border = np.concatenate([columns, model.flat], axis=1)
    p = rest.projector(shared=False)
    np.testing.assert_allclose(found.information, border.T @ p @ border, rtol=1e-6, atol=1e-9)


def test_pseudo_observations_and_combinations_change_the_border_alone(model):
    eq, f = model.equations(), model.factored()
    basis = np.array([[1.0], [2.0]])
    both = np.array([[1.0, 0.0], [2.0, 0.0], [0.0, 1.0]])
    combined = factor_equations(eq.combine_columns(basis), model.lam, model.weight)
    np.testing.assert_allclose(combined.information, both.T @ f.information @ both, rtol=1e-9)
    ridge = factor_equations(eq.with_ridge(0.25), model.lam, model.weight)
    np.testing.assert_allclose(ridge.information - f.information, np.diag([0.25, 0.25, 0.0]))
    some = f.select_border(np.array([0, 2]))
    np.testing.assert_array_equal(some.information, f.information[np.ix_([0, 2], [0, 2])])


def test_the_factorization_kept_in_memory_is_that_of_the_same_variances(model):
    """One set of equations, asked for several variances, one after the other and back."""
    eq = model.equations()
    for lam in (model.lam, 3 * model.lam, model.lam):
        again = factor_equations(eq, lam, model.weight).information
        np.testing.assert_array_equal(
            again, factor_equations(model.equations(), lam, model.weight).information
        )
    whole = make_equations(model.random, model.group_fixed, model.border)
    for absent in ((GROUP,), (SIDE,), (GROUP,)):
        some = model.with_lam(*absent)
        f = factor_equations(whole.select(some.alive), some.lam, some.weight)
        np.testing.assert_allclose(f.information, some.factored().information, rtol=1e-12)


def test_a_root_is_found_where_rounding_takes_the_information_of_a_column(model):
    """Two directions, of which one has a square of next to nothing, below zero."""
    f = model.factored()
    information = f.information.copy()
    information[:2, :2] = [[4.0, 2.0], [2.0, 1.0 - 1e-9]]
    root = replace(f, information=information).root
    ridged = information[:2, :2] + 1e-5 * np.diag([4.0, 1.0])
    np.testing.assert_allclose(root @ root.T, ridged, atol=1e-8)


def test_standard_deviations_follow_from_ratios_and_noise():
    now = Variances(0.2, np.array([4.0, LAMBDA_ABSENT, 0.25]), np.ones(0))
    assert now.alive.tolist() == [True, False, True]
    np.testing.assert_allclose(now.tau, [0.1, 0.0, 0.4])
    assert now.without_component(0).alive.tolist() == [False, False, True]
    assert not no_variances(3, 2).alive.any()


def test_units_of_equal_weights_have_the_same_mean_square():
    """tau^2 times the mean of 1 / weight; other components stay."""
    now = Variances(1.0, np.array([4.0, 4.0, LAMBDA_ABSENT]), np.array([0.5, 1.0, 4.0]))
    alike = now.with_equal_weights(np.array([True, False, True]))
    np.testing.assert_allclose(alike.lam, [4.0 / np.mean([2.0, 1.0, 0.25]), 4.0, LAMBDA_ABSENT])
    assert alike.weight.tolist() == [1.0, 1.0, 1.0]


def test_nothing_is_solved_for_nothing():
    assert solve_lower(np.zeros((0, 0)), np.zeros((0, 2))).shape == (0, 2)
