"""Estimates, predictions, their errors and groups left out, against dense algebra."""

import numpy as np
import pytest
from helpers.mixed_models import FIELD, GROUP, KINDS, PLACE, SHARED, SIDE, TURN, mixed_model

from fisheye_svp_ros.mixed_model import (
    leave_groups_out,
    posterior_covariance,
    posterior_variances,
    solve_equations,
    unit_covariances,
)
from fisheye_svp_ros.mixed_model.solution import deviance_without, solution_without


def test_estimates_are_those_of_generalized_least_squares(model):
    f = model.factored()
    solution = solve_equations(f)
    v, x = model.covariance(), model.fixed()
    weighted = np.linalg.solve(v, x).T
    fixed = np.linalg.solve(weighted @ x, weighted @ model.y)
    np.testing.assert_allclose(solution.values, fixed[-2:], rtol=1e-6)
    assert solution.variance == pytest.approx(model.variance, rel=1e-7)
    assert solution.deviance == pytest.approx(model.deviance, abs=1e-5)


@pytest.mark.parametrize('kind', KINDS)
def test_predictions_and_their_errors_are_those_given_y(model, kind):
    f = model.factored()
    variances = posterior_variances(f)
    solution = solve_equations(f, variances)
    mean, covariance = model.posterior(kind)
    at = f.equations.label == kind
    values = np.append(solution.e, solution.r)[at]
    np.testing.assert_allclose(values, mean, atol=1e-8)
    spread = np.append(solution.spread_e, solution.spread_r)[at]
    np.testing.assert_allclose(spread, np.diag(covariance), rtol=1e-7)
    posterior = posterior_covariance(f)
    for found, expected in zip(posterior.variances, variances, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-8)


def test_covariances_between_coefficients_are_those_given_y(model):
    """Of all random coefficients that are there, and of the shared fixed ones with them."""
    f = model.factored()
    posterior, label = posterior_covariance(f), f.equations.label
    size, width = posterior.block[..., 0].size, posterior.block.shape[-1]
    found = posterior.root @ posterior.root.T
    for i, block in enumerate(posterior.block):
        part = slice(i * width, (i + 1) * width)
        found[part, part] += block
    assert size == len(posterior.block) * width
    for kind in KINDS:
        at = label == kind
        expected = model.posterior(kind)[1]
        np.testing.assert_allclose(found[np.ix_(at, at)], expected, atol=1e-8)
        # Cov(b, u) = -(X' inv(V) X)^-1 X' inv(V) Z D
        z, weight = model.of(kind)
        x, inverse = model.fixed(), np.linalg.inv(model.covariance())
        fixed = np.linalg.inv(x.T @ inverse @ x) @ x.T @ inverse
        across = -fixed @ z / (model.lam[kind] * weight)
        np.testing.assert_allclose(posterior.shared @ posterior.root[at].T, across[-2:], atol=1e-8)
    np.testing.assert_allclose(
        posterior.shared @ posterior.shared.T, np.linalg.inv(f.information[:-1, :-1]), rtol=1e-8
    )


@pytest.mark.parametrize('by_group', [True, False])
def test_offsets_of_a_unit_have_one_covariance(by_group):
    model = mixed_model(by_group)
    f = model.factored()
    found = unit_covariances(f)
    z, label, weight = model.columns()
    chosen = np.isin(label, (PLACE, SIDE))
    prior = np.diag(1 / (model.lam[label[chosen]] * weight[chosen]))
    z, p = z[:, chosen], model.projector()
    covariance = prior - prior @ z.T @ p @ z @ prior
    # The units of which both places are there.
    both = np.flatnonzero((model.random.unit_label >= 0).all(axis=1))
    place = np.cumsum((model.random.unit_label >= 0).ravel()).reshape(-1, 2) - 1
    order = {unit: i for i, unit in enumerate(f.equations.units.tolist())}
    for unit in both:
        at = place[unit]
        np.testing.assert_allclose(
            found[order[unit]], covariance[np.ix_(at, at)], rtol=1e-6, atol=1e-9
        )


@pytest.mark.parametrize('points', [6, 40], ids=['few rows', 'many rows'])
@pytest.mark.parametrize('by_group', [True, False])
@pytest.mark.parametrize('kind', KINDS)
def test_the_deviance_without_a_component_is_that_of_a_model_without_it(by_group, kind, points):
    """Blocks of more coefficients than there are others, and of fewer."""
    model = mixed_model(by_group, points=points, groups=6 if points == 6 else 5)
    f = model.factored()
    solution, posterior = solve_equations(f), posterior_covariance(f)
    rise = deviance_without(f, solution, posterior, kind)
    assert rise == pytest.approx(model.with_lam(kind).deviance - model.deviance, abs=1e-5)


@pytest.mark.parametrize('kind', [SHARED, FIELD])
def test_the_solution_without_a_shared_component_is_that_of_a_model_without_it(model, kind):
    f, fewer = model.factored(), model.with_lam(kind)
    solution = solve_equations(f, posterior_variances(f))
    found = solution_without(f, solution, posterior_covariance(f), kind)
    freedom = fewer.freedom
    assert found.variance * freedom == pytest.approx(fewer.variance * freedom, rel=1e-7)
    assert found.deviance == pytest.approx(fewer.deviance, abs=1e-5)
    label = f.equations.label
    for other in set(KINDS) - {kind}:
        mean, covariance = fewer.posterior(other)
        at = label == other
        np.testing.assert_allclose(np.append(found.e, found.r)[at], mean, atol=1e-8)
        spread = np.append(found.spread_e, found.spread_r)[at]
        np.testing.assert_allclose(spread, np.diag(covariance), rtol=1e-6)
    gone = label == kind
    assert np.abs(np.append(found.e, found.r)[gone]).max() < 1e-9
    assert np.abs(np.append(found.spread_e, found.spread_r)[gone]).max() < 1e-9


@pytest.mark.parametrize('absent', [(), (GROUP, TURN), (PLACE, SIDE), (SHARED, FIELD)], ids=str)
def test_a_group_left_out_is_what_the_others_predict_of_it(model, absent):
    """By the definition: mean and covariance of its rows given those of all others."""
    model = model.with_lam(*absent)
    f, random = model.factored(), model.random.select(model.alive)
    found = leave_groups_out(f, random, model.group_fixed, model.border)
    groups, height, _ = model.border.shape
    v, flat = model.covariance(), model.flat
    columns = random.shared.toarray()
    label = random.shared_label[: columns.shape[1]]
    by_all = columns / model.lam[label] @ columns.T if columns.size else np.zeros_like(v)
    for g in range(groups):
        own = np.zeros(len(v), dtype=bool)
        own[g * height : (g + 1) * height] = True
        own &= model.used
        rest = ~own & model.used
        rest[g * height : (g + 1) * height] = False
        among = model._spread(np.delete(model.group_fixed, g, axis=0))
        among = among[np.delete(model.used, np.arange(g * height, (g + 1) * height))]
        among = among[:, np.linalg.norm(among, axis=0) > 0]
        inverse = np.linalg.inv(v[np.ix_(rest, rest)])
        weighted = inverse @ among
        m = inverse - weighted @ np.linalg.inv(among.T @ weighted) @ weighted.T
        across = v[np.ix_(own, rest)] @ m
        left = flat[own] - across @ flat[rest]
        spread = v[np.ix_(own, own)] - across @ v[np.ix_(rest, own)]
        fixed = model.group_fixed[g][own[g * height : (g + 1) * height]]
        fixed = fixed[:, np.linalg.norm(fixed, axis=0) > 0]
        weighted = np.linalg.solve(spread, fixed)
        left -= fixed @ np.linalg.solve(weighted.T @ fixed, weighted.T @ left)
        np.testing.assert_allclose(
            found.information[g], left.T @ np.linalg.solve(spread, left), rtol=1e-6, atol=1e-7
        )
        within = own[g * height : (g + 1) * height]
        # In the rows that fixed columns leave, projected onto them.
        basis = np.linalg.qr(fixed)[0]
        expected = left - basis @ (basis.T @ left)
        rows = found.rows[g][within]
        np.testing.assert_allclose(rows - basis @ (basis.T @ rows), expected, atol=1e-7)
        np.testing.assert_allclose(
            found.fields[g][within],
            by_all[np.ix_(own, rest)] @ m @ flat[rest],
            atol=1e-7,
        )
        assert not found.rows[g][~within].any() and not found.fields[g][~within].any()


def test_some_of_the_border_is_left_out_as_all_of_it_is(model):
    found = leave_groups_out(model.factored(), model.random, model.group_fixed, model.border)
    some = found.select(np.array([0, 2]))
    np.testing.assert_array_equal(some.information, found.information[:, [0, 2]][:, :, [0, 2]])
    np.testing.assert_array_equal(some.rows, found.rows[..., [0, 2]])
