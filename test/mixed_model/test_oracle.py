"""The engine against statsmodels' MixedLM, on a model that both can hold."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse

from fisheye_svp_ros.mixed_model import (
    LAMBDA_ABSENT,
    Components,
    RandomColumns,
    Variances,
    component_p_values,
    component_squares,
    estimate_variances,
    factor_equations,
    initial_variances,
    leave_groups_out,
    make_equations,
    pseudo_inverse,
    score_columns,
    solve_equations,
)

GROUPS, ROWS = 15, 12
SIGMA, INTERCEPT, SLOPE = 0.5, 0.8, 0.3  # standard deviations of noise and random effects


@pytest.fixture(scope='module')
def oracle():
    """Return the module, which takes a second to import: where these tests run alone."""
    return pytest.importorskip(
        'statsmodels.regression.mixed_linear_model',
        reason="statsmodels is not installed (pip install 'fisheye-svp-ros[test]')",
    )


def growth_curves(seed):
    """Return y (G, M), fixed columns X (G, M, 2) and random ones (G, M, 2): intercept, slope."""
    rng = np.random.default_rng(seed)
    time = np.linspace(-1.0, 1.0, ROWS)
    random = np.stack([np.ones(ROWS), time], axis=-1) * np.ones((GROUPS, 1, 1))
    fixed = np.stack([np.ones((GROUPS, ROWS)), rng.normal(size=(GROUPS, ROWS))], axis=-1)
    own = rng.normal(size=(GROUPS, 2)) * [INTERCEPT, SLOPE]
    y = fixed @ [2.0, -1.0] + (random @ own[..., None])[..., 0]
    return y + SIGMA * rng.normal(size=y.shape), fixed, random


def equations_of(y, fixed, random):
    """Return random columns and the equations of groups with two components and nothing else."""
    components = Components(np.zeros(2, dtype=bool), np.zeros(2, dtype=bool))
    columns = RandomColumns(
        random,
        np.arange(2),
        np.zeros((GROUPS, ROWS // 2, 2, 1)),
        np.full((GROUPS, ROWS // 2), -1),
        np.zeros((0, 1), dtype=np.int64),
        sparse.csr_array((GROUPS * ROWS, 0)),
        sparse.csr_array((0, 0)),
        np.zeros(0, dtype=np.int64),
        components,
    )
    border = np.concatenate([fixed, y[..., None]], axis=-1)
    return columns, make_equations(columns, np.zeros((GROUPS, ROWS, 0)), border), border


def converged(eq):
    """Return the variances, iterated until they no longer change."""
    now, _ = estimate_variances(eq, initial_variances(eq))
    for _ in range(8):
        now, _ = estimate_variances(eq, now)
    return now


def fixed_covariance(model, result):
    """Return the covariance of fixed effects by generalized least squares, densely."""
    information = 0.0
    for x, z in zip(model.exog_li, model.exog_re_li, strict=True):
        v = result.scale * np.eye(len(z)) + z @ result.cov_re @ z.T
        information = information + x.T @ np.linalg.solve(v, x)
    return np.linalg.inv(information)


@pytest.fixture(scope='module', params=[1, 2, 3])
def case(request, oracle):
    """Return the data, our variances and solution, and the oracle's model and result."""
    y, fixed, random = growth_curves(request.param)
    columns, eq, border = equations_of(y, fixed, random)
    now = converged(eq)
    f = factor_equations(eq, now.lam, now.weight)
    model = oracle.MixedLM(
        y.ravel(), fixed.reshape(-1, 2), np.repeat(np.arange(GROUPS), ROWS), random.reshape(-1, 2)
    )
    free = oracle.MixedLMParams.from_components(fe_params=np.ones(2), cov_re=np.eye(2))
    result = model.fit(reml=True, free=free, method='bfgs')
    return (y, columns, border), eq, now, f, model, result


def test_variances_are_those_of_restricted_maximum_likelihood(case):
    _, _, now, _, _, result = case
    assert now.sigma**2 == pytest.approx(result.scale, rel=1e-3)
    np.testing.assert_allclose(now.tau**2, np.diag(result.cov_re), rtol=5e-3)


def test_estimates_predictions_and_their_errors_agree(case):
    _, eq, now, f, model, result = case
    solution = solve_equations(f)
    np.testing.assert_allclose(solution.values, result.fe_params, rtol=1e-3)
    covariance = now.sigma**2 * np.linalg.inv(f.information[:-1, :-1])
    np.testing.assert_allclose(covariance, fixed_covariance(model, result), rtol=5e-3, atol=1e-6)
    own, _, _ = eq.split(solution.e, solution.r)
    expected = np.array([result.random_effects[g] for g in range(GROUPS)])
    np.testing.assert_allclose(own, expected, atol=2e-3 * np.abs(expected).max())


def test_the_deviance_is_twice_the_log_likelihood(case, oracle):
    """Up to a constant: differences between variances, the noise profiled out in both."""
    _, eq, now, _, model, _ = case
    ours, theirs = [], []
    for factor in (1.0, 2.0, 0.3):
        lam = now.lam * factor
        ours.append(solve_equations(factor_equations(eq, lam, now.weight)).deviance)
        relative = oracle.MixedLMParams.from_components(
            fe_params=np.zeros(2), cov_re=np.diag(1 / lam)
        )
        theirs.append(-2 * model.loglike(relative, profile_fe=True))
    np.testing.assert_allclose(np.diff(ours), np.diff(theirs), rtol=1e-6, atol=1e-7)


def test_a_score_test_is_a_wald_test_where_the_variances_are_held(case):
    """Of a linear model both are the same: the estimate over its error, squared."""
    _, _, now, f, model, result = case
    information, inside = f.information / now.sigma**2, np.array([0])
    inverse = pseudo_inverse(information[np.ix_(inside, inside)])
    remaining = information - information[:, inside] @ inverse @ information[inside]
    score = score_columns(remaining, np.array([1]), np.ones(2), now.sigma**2)
    wald = result.fe_params[1] ** 2 / fixed_covariance(model, result)[1, 1]
    assert score.rank == 1 and score.estimate[0] == pytest.approx(result.fe_params[1], rel=1e-3)
    assert score.statistic == pytest.approx(wald, rel=5e-3)


def test_a_group_left_out_is_predicted_as_by_a_fit_without_it(case):
    (_, columns, border), _, now, f, _, _ = case
    left_out = leave_groups_out(f, columns, np.zeros((GROUPS, ROWS, 0)), border)
    keep = np.arange(GROUPS) != 4
    gone = columns._replace(group=columns.group * keep[:, None, None])
    rest = make_equations(gone, np.zeros((GROUPS, ROWS, 0)), border * keep[:, None, None])
    direct = factor_equations(rest, now.lam, now.weight)
    np.testing.assert_allclose(
        f.information - left_out.information[4], direct.information, rtol=1e-6, atol=1e-8
    )
    # Nothing is shared but fixed columns: the others predict nothing more of the group.
    np.testing.assert_allclose(left_out.rows[4], border[4], atol=1e-9)


def test_some_of_the_columns_are_left_out_as_all_of_them_are(case):
    (_, columns, border), _, _, f, _, _ = case
    at, none = np.array([1, 2]), np.zeros((GROUPS, ROWS, 0))
    some = leave_groups_out(f.select_border(at), columns, none, border[..., at])
    for one, other in zip(
        some, leave_groups_out(f, columns, none, border).select(at), strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)


def with_offsets(columns, unit):
    """Return random columns with offsets (1,) of units beside them, unit (G, N), component 2."""
    units = int(unit.max()) + 1
    return columns._replace(
        offset=np.random.default_rng(0).normal(size=(*unit.shape, 2, 1)),
        unit=unit,
        fields=sparse.csr_array((units, 0)),
        unit_label=np.full((units, 1), 2),
        components=Components(np.array([False, False, True]), np.zeros(3, dtype=bool)),
    )


@pytest.mark.parametrize('by_group', [True, False])
def test_what_units_add_is_what_their_offsets_are_expected_to(case, by_group):
    """By dense algebra: mean and covariance of the offsets given y."""
    (_, columns, border), _, now, _, _, _ = case
    points = np.arange(GROUPS * ROWS // 2).reshape(GROUPS, -1)
    crossed = with_offsets(columns, points % (ROWS // 2) if by_group else points)
    intercepts = np.ones((GROUPS, ROWS, 1))
    border = border[..., 1:]
    eq = make_equations(crossed, intercepts, border)
    assert eq.by_group == by_group
    weight = np.random.default_rng(1).uniform(0.1, 2.0, len(crossed.unit_label))
    lam = np.array([np.inf, now.lam[1], 2.0])
    known = Variances(1.0, np.minimum(lam, LAMBDA_ABSENT), weight)
    f = factor_equations(eq.select(known.alive), known.lam, weight)
    added = component_squares(eq, f, known)

    def flat(blocks):
        own = np.zeros((GROUPS, ROWS, GROUPS, blocks.shape[-1]))
        own[range(GROUPS), :, range(GROUPS)] = blocks
        return own.reshape(GROUPS * ROWS, -1)

    z = crossed.unit_columns.toarray()
    slopes = flat(columns.group[..., 1:])
    fixed = np.concatenate([flat(intercepts), border[..., :-1].reshape(len(z), -1)], axis=1)
    y = border[..., -1].ravel()
    v = np.eye(len(z)) + slopes @ slopes.T / lam[1] + z @ np.diag(1 / (2 * weight)) @ z.T
    inverse = np.linalg.inv(v)
    p = inverse - inverse @ fixed @ np.linalg.inv(fixed.T @ inverse @ fixed) @ fixed.T @ inverse
    prior = np.diag(1 / (2 * weight))
    offset, covariance = prior @ z.T @ p @ y, prior - prior @ z.T @ p @ z @ prior
    variance = y @ p @ y / (len(y) - fixed.shape[1])
    left = z - (z.reshape(GROUPS, ROWS, -1).mean(axis=1)).repeat(ROWS, axis=0)
    expected = (left**2).sum(axis=0) @ (offset**2 / variance + np.diag(covariance))
    np.testing.assert_allclose(added[2], expected, rtol=1e-6)
    assert added[0] == 0


def test_units_that_are_exact_leave_all_as_it_is(case):
    """Offsets of units, a second grouping factor, of which the variance is zero."""
    (_, columns, border), _, now, f, _, _ = case
    crossed = with_offsets(columns, np.tile(np.arange(ROWS // 2), (GROUPS, 1)))
    eq = make_equations(crossed, np.zeros((GROUPS, ROWS, 0)), border)
    lam = np.append(now.lam, 1e12)
    alive = replace(now, lam=lam, weight=np.ones(ROWS // 2))
    found = factor_equations(eq.select(alive.alive), lam, alive.weight)
    np.testing.assert_allclose(found.information, f.information, rtol=1e-9)


@pytest.mark.parametrize('kind', [0, 1])
def test_a_component_that_begins_at_next_to_nothing_grows(kind):
    _, eq, _ = equations_of(*growth_curves(1))
    usual, _ = estimate_variances(eq, initial_variances(eq))
    lam = usual.lam.copy()
    lam[kind] = initial_variances(eq, 1e-5).lam[kind]
    found, _ = estimate_variances(eq, replace(usual, lam=lam))
    assert found.alive.all()
    np.testing.assert_allclose(found.tau, usual.tau, rtol=0.05)


def test_nothing_has_no_rank():
    assert pseudo_inverse(np.zeros((0, 0))).shape == (0, 0)


@pytest.mark.parametrize('factor', [0.1, 8.0])
@pytest.mark.parametrize('seed', [1, 3, 5])
def test_variances_that_are_not_the_best_hide_no_component(seed, factor):
    """What other variances gain by a step, they gain with the component as well."""
    _, eq, _ = equations_of(*growth_curves(seed))
    best = converged(eq)
    far = replace(best, lam=best.lam * [factor, 1.0])
    p, expected = (component_p_values(eq, now)[1] for now in (far, best))
    assert expected < 0.001
    assert p < 3 * expected
