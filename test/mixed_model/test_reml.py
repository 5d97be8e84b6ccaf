"""Variances against the restricted likelihood itself, and by how often they are wrong."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.mixed_models import (
    FIELD,
    GROUP,
    KINDS,
    LAM,
    PLACE,
    SHARED,
    SIDE,
    TURN,
    drawn,
    mixed_model,
)
from scipy import optimize, sparse, stats

from fisheye_svp_ros.mixed_model import (
    LAMBDA_ABSENT,
    Components,
    RandomColumns,
    Variances,
    component_p_values,
    estimate_variances,
    find_variances,
    initial_variances,
    is_called_for,
    make_equations,
    posterior_variances,
    remove_contradicted,
    score_components,
    solve_equations,
    unit_labels,
)
from fisheye_svp_ros.mixed_model.reml import average_information, update_variances

T_FREEDOM = 3


def solved(model):
    f = model.factored()
    return f, solve_equations(f, posterior_variances(f))


def variances_of(model):
    return Variances(1.0, model.lam, model.weight)


def fixed_point(eq, now, times=40):
    """Return the variances once they no longer change."""
    for _ in range(times):
        before = now
        now, eq = estimate_variances(eq, now)
        change = np.abs(np.log(now.lam / before.lam))[now.alive & before.alive]
        if (
            max(
                change.max(initial=0.0),
                np.abs(np.log(now.weight / before.weight)).max(initial=0.0),
            )
            < 1e-3
        ):
            break
    return now


@pytest.mark.parametrize('seed', [1, 2, 3])
def test_the_likelihood_is_highest_at_the_variances(seed):
    """Weights of units as they are; by the dense likelihood, in every direction."""
    made = mixed_model(True, seed, groups=20)
    whole = make_equations(made.random, made.group_fixed, made.border)
    now = fixed_point(whole, initial_variances(whole))
    model = replace(made, lam=now.lam, weight=now.weight)
    best = model.deviance
    for kind in np.flatnonzero(now.alive):
        for factor in (0.8, 1.25):
            assert model.with_lam(kind, value=factor * now.lam[kind]).deviance > best - 1e-4
    assert now.sigma == pytest.approx(np.sqrt(model.variance), rel=1e-3)


def test_information_on_variances_is_the_average_one(model):
    """Half of y' P (dV / d theta_i) P (dV / d theta_j) P y, of the logarithms."""
    f, solution = solved(model)
    p, variance = model.projector() / model.variance, model.variance
    slopes = []
    for kind in KINDS:
        z, weight = model.of(kind)
        slopes.append(variance * z / (model.lam[kind] * weight) @ z.T)
    slopes.append(variance * np.eye(len(p)))
    moved = np.stack([slope @ p @ model.y for slope in slopes])
    np.testing.assert_allclose(
        average_information(f, solution), moved @ p @ moved.T / 2, rtol=1e-6, atol=1e-9
    )


def test_the_error_of_variances_is_by_that_information(model):
    """And a little information more, lest one that hardly has any lend its error to others."""
    model = model.with_lam(TURN)
    whole = make_equations(model.random, model.group_fixed, model.border)
    now, _ = estimate_variances(whole, variances_of(model), steps=1)
    free = np.append(now.alive, True)
    # One step: solved by the variances that it began with.
    f, solution = solved(model)
    information = average_information(f, solution)[np.ix_(free, free)]
    expected = np.linalg.inv(information + 0.01 * np.eye(free.sum()))
    np.testing.assert_allclose(now.covariance[np.ix_(free, free)], expected, rtol=1e-6)
    assert not now.covariance[TURN].any() and not now.covariance[:, TURN].any()


@pytest.mark.parametrize('newton', [False, True])
def test_the_slope_of_the_likelihood_moves_the_variances(model, newton):
    """By the dense likelihood: a step goes where it rises, Newton's by average information."""
    f, solution = solved(model)
    after = update_variances(f, solution, variances_of(model), newton)
    change = np.log(model.lam / after.lam)
    slope = np.array(
        [
            (model.with_lam(k, value=model.lam[k] * np.exp(-1e-5)).deviance - model.deviance)
            / -2e-5
            for k in KINDS
        ]
    )
    if newton:
        information = average_information(f, solution)
        information += np.diag(1e-3 * np.diag(information) + 1e-9)
        step = np.linalg.solve(information, np.append(slope, 0.0))
        np.testing.assert_allclose(change, np.clip(step - step[-1], -3, 2)[:-1], atol=1e-3)
    else:
        assert (np.sign(change) == np.sign(slope)).all()
        gamma = [
            len(weight) - (np.diag(covariance) * model.lam[k] * weight).sum()
            for k in KINDS
            for weight, covariance in [(model.of(k)[1], model.posterior(k)[1])]
        ]
        size = f.prior_squares(solution.e, solution.r) / model.variance
        np.testing.assert_allclose(slope, (size - gamma) / 2, atol=1e-3)
        np.testing.assert_allclose(change, np.clip(1.4 * np.log(size / gamma), -2, 2), atol=1e-3)
    assert after.sigma == pytest.approx(np.sqrt(model.variance), rel=1e-6)


@pytest.mark.parametrize(('newton', 'least', 'most'), [(False, -2, 2), (True, -3, 2)])
def test_a_step_is_no_larger_than_where_it_can_be_trusted(newton, least, most):
    model = mixed_model(True, groups=20)
    steps = []
    for factor in (1e5, 1e-5):
        far = replace(model, lam=factor * LAM)
        f, solution = solved(far)
        after = update_variances(f, solution, variances_of(far), newton)
        steps.append(np.log(far.lam / after.lam)[after.alive])
    steps = np.concatenate(steps)
    assert steps.max() == pytest.approx(most)
    assert steps.min() >= least - 1e-9
    if not newton:
        assert steps.min() == pytest.approx(least)


def test_units_that_lie_far_off_have_little_weight(model):
    """The expected precision of a t distribution of three degrees of freedom, of unit after unit.

    (3 + number of offsets) / (3 + their expected squares over their variance), given y.
    """
    f, solution = solved(model)
    found = update_variances(f, solution, variances_of(model)).weight
    labels, squares = model.random.unit_label, np.zeros(model.random.unit_label.shape)
    for kind in (PLACE, SIDE):
        mean, covariance = model.posterior(kind)
        squares[labels == kind] = model.lam[kind] * (
            mean**2 / model.variance + np.diag(covariance)
        )
    count = (labels >= 0).sum(axis=1)
    expected = (T_FREEDOM + count) / (T_FREEDOM + squares.sum(axis=1))
    np.testing.assert_allclose(found, np.where(count > 0, expected, 1.0), rtol=1e-6)
    assert set(count.tolist()) == {0, 1, 2} and expected.min() < 0.8 < 1.2 < expected.max()
    np.testing.assert_array_equal(
        unit_labels(f.equations), np.where(labels < 0, -2, labels)[f.equations.units]
    )


def test_units_of_a_component_that_is_off_count_by_the_other(model):
    model = model.with_lam(SIDE)
    f, solution = solved(model)
    found = update_variances(f, solution, variances_of(model)).weight
    mean, covariance = model.posterior(PLACE)
    square = model.lam[PLACE] * (mean**2 / model.variance + np.diag(covariance))
    there = model.random.unit_label[:, 0] == PLACE
    np.testing.assert_allclose(found[there], (T_FREEDOM + 1) / (T_FREEDOM + square), rtol=1e-6)


def one_way(groups, rows, rng, tau, beside=0.0):
    """Return rows of groups with an intercept each, and columns of two components.

    The other component's columns are of groups as well, of this standard deviation.
    """
    group = np.stack([np.ones((groups, rows)), rng.normal(size=(groups, rows))], axis=-1)
    own = rng.normal(size=(groups, 2)) * [tau, beside]
    y = 1.0 + (group @ own[..., None])[..., 0] + rng.normal(size=(groups, rows))
    random = RandomColumns(
        group,
        np.arange(2),
        np.zeros((groups, rows // 2, 2, 1)),
        np.full((groups, rows // 2), -1),
        np.zeros((0, 1), dtype=np.int64),
        sparse.csr_array((groups * rows, 0)),
        sparse.csr_array((0, 0)),
        np.zeros(0, dtype=np.int64),
        Components(np.zeros(2, dtype=bool), np.zeros(2, dtype=bool)),
    )
    border = np.stack([np.ones_like(y), y], axis=-1)
    return make_equations(random, np.zeros((groups, rows, 0)), border), y


def test_the_variance_of_a_balanced_layout_is_that_of_the_analysis_of_variance():
    """Mean squares between and within groups; the textbook's closed form."""
    eq, y = one_way(12, 6, np.random.default_rng(11), 0.9)
    start = initial_variances(eq)
    alone = replace(start, lam=np.array([start.lam[0], LAMBDA_ABSENT]))
    now = fixed_point(eq.select(alone.alive), alone)
    within = ((y - y.mean(axis=1, keepdims=True)) ** 2).sum() / (12 * 5)
    between = 6 * y.mean(axis=1).var(ddof=1)
    assert now.sigma**2 == pytest.approx(within, rel=1e-3)
    assert now.tau[0] ** 2 == pytest.approx((between - within) / 6, rel=5e-3)
    assert now.tau[1] == 0


def test_a_component_begins_with_its_share_of_the_noise(model):
    eq = model.equations()
    for share in (0.03, 0.5):
        start = initial_variances(eq, share)
        for kind in KINDS:
            z, _ = model.of(kind)
            added = (z**2).sum() / start.lam[kind] / eq.rows
            assert added == pytest.approx(share, rel=1e-9)
    rest = model.with_lam(SIDE)
    assert initial_variances(rest.equations()).lam[SIDE] == LAMBDA_ABSENT


def test_a_component_without_data_vanishes_and_stays_so():
    """Where a group's own columns add nothing; one that adds most is no larger than a fit says."""
    vanished = 0
    for seed in range(20):
        eq, _ = one_way(12, 6, np.random.default_rng(seed), 1.0)
        now, rest = estimate_variances(eq, initial_variances(eq))
        assert now.alive[0]
        vanished += not now.alive[1]
        assert rest.find_present(now.alive)[1].sum() == now.alive.sum() == rest.width
    # At half of all sets, or so, the likelihood is highest at zero: by chance 4 of 20 at least.
    assert vanished > 4


def likelihood_ratio(y, z):
    """Return the restricted likelihood ratio of one random component, by dense algebra."""
    x = np.ones((len(y), 1))

    def deviance(log_tau2):
        v = np.eye(len(y)) + np.exp(log_tau2) * z @ z.T
        inverse = np.linalg.inv(v)
        inside = x.T @ inverse @ x
        p = inverse - inverse @ x @ np.linalg.inv(inside) @ x.T @ inverse
        logs = np.linalg.slogdet(v)[1] + np.linalg.slogdet(inside)[1]
        return (len(y) - 1) * np.log(y @ p @ y) + logs

    best = optimize.minimize_scalar(deviance, bounds=(-12, 6), method='bounded').fun
    return deviance(-40.0) - best


@pytest.mark.parametrize('factor', [0.2, 5.0])
def test_weights_settle_from_wherever_they_begin(model, factor):
    """As the ratios do: the last step changes them by a twentieth at most, in the mean."""
    whole = make_equations(model.random, model.group_fixed, model.border)
    begun = fixed_point(whole, initial_variances(whole), 3)
    begun = replace(begun, weight=factor * begun.weight)
    now, eq = estimate_variances(whole, begun)
    again, _ = estimate_variances(eq, now, steps=1)
    assert np.abs(np.log(again.weight / now.weight)).mean() < 0.05


@pytest.mark.parametrize('seed', [0, 1, 2, 3, 4])
def test_a_p_value_is_half_the_tail_of_the_likelihood_ratio(seed):
    """On the boundary (Self and Liang 1987), against the whole likelihood maximized."""
    rng = np.random.default_rng(seed)
    eq, y = one_way(10, 6, rng, 0.8)
    start = initial_variances(eq)
    now = replace(start, lam=np.array([start.lam[0], LAMBDA_ABSENT]))
    now = fixed_point(eq.select(now.alive), now)
    p = component_p_values(eq, now)
    assert p[1] == 1.0
    z = np.kron(np.eye(10), np.ones((6, 1)))
    expected = stats.chi2.sf(likelihood_ratio(y.ravel(), z), 1) / 2
    assert p[0] == pytest.approx(expected, rel=0.05)


def test_components_of_units_are_tested_as_if_units_were_alike(model):
    """Without weights, a scale for each, of which there are as many as units."""
    eq = make_equations(model.random, model.group_fixed, model.border)
    spread = component_p_values(eq, variances_of(model))
    of_units = np.isin(KINDS, (PLACE, SIDE))
    alike = component_p_values(eq, variances_of(model).with_equal_weights(of_units))
    np.testing.assert_allclose(spread[of_units], alike[of_units], rtol=1e-9)
    assert (np.abs(np.log(spread / alike))[~of_units] > 1e-6).any()


def test_components_are_found_where_they_are_and_seldom_elsewhere():
    """False ones in at most 1 in 20 of sets, but for chance: three standard errors of 60."""
    false, missed, rng = 0, 0, np.random.default_rng(12)
    for _ in range(60):
        eq, _ = one_way(12, 6, rng, 1.5)
        now = find_variances(eq)
        missed += not now.alive[0]
        false += bool(now.alive[1])
    assert missed == 0
    assert false <= 60 * (0.05 + 3 * np.sqrt(0.05 * 0.95 / 60))


def test_a_component_is_called_for_at_one_in_a_hundred(model):
    fewer = model.with_lam(GROUP, SHARED)
    eq = make_equations(model.random, model.group_fixed, model.border)
    p = score_components(eq, variances_of(fewer), [GROUP, SHARED])
    for kind in (GROUP, SHARED):
        assert is_called_for(eq, variances_of(fewer), kind) == (p[kind] < 0.01)


@pytest.mark.parametrize(('p_value', 'called'), [(0.0095, True), (0.0105, False)])
def test_the_limit_of_what_is_called_for(p_value, called):
    """Of y a component's own columns by so much that it has this p-value."""
    model = mixed_model(True).with_lam(*KINDS)
    z, _ = model.of(SHARED)
    noise = model.projector() @ model.y

    def equations(size):
        border = model.border.copy()
        border[..., -1] = (noise + size * z[:, 0]).reshape(border.shape[:2])
        return make_equations(model.random, model.group_fixed, border)

    def excess(size):
        now = variances_of(model)
        return score_components(equations(size), now, [SHARED])[SHARED] - p_value

    size = optimize.brentq(excess, 0.0, 20.0)
    assert is_called_for(equations(size), variances_of(model), SHARED) == called


def test_what_was_called_for_is_kept_from_the_variances_of_a_similar_state():
    eq, _ = one_way(12, 6, np.random.default_rng(14), 1.5, 1.0)
    found = find_variances(eq)
    again = find_variances(eq, found)
    assert found.alive.all() and again.alive.all()
    np.testing.assert_allclose(again.tau, found.tau, rtol=0.1)
    # One that was not there before is added.
    less = found.without_component(1)
    assert find_variances(eq, less).alive.all()


def test_a_component_that_a_smaller_model_is_likelier_without_is_removed():
    """Of few groups, whose columns the fixed ones all but take up: its variance was anything."""
    rng = np.random.default_rng(14)
    eq, y = one_way(6, 8, rng, 0.0)
    start = initial_variances(eq, 1.0)
    now, _ = estimate_variances(eq, replace(start, lam=np.array([start.lam[0], LAMBDA_ABSENT])))
    wide = replace(now, lam=np.array([1.0, LAMBDA_ABSENT]), covariance=np.diag([1.0, 0.0, 0.1]))
    z = np.kron(np.eye(6), np.ones((8, 1)))
    assert likelihood_ratio(y.ravel(), z) < 0.5
    found = remove_contradicted(eq, eq, wide)
    assert not found.alive.any()
    # Certain ones, and those that the model needs, stay.
    certain = replace(wide, covariance=np.diag([0.05, 0.0, 0.1]))
    assert remove_contradicted(eq, eq, certain) is certain
    strong, _ = one_way(6, 8, rng, 2.0)
    assert remove_contradicted(strong, strong, wide) is wide


def test_fields_and_shared_columns_vanish_as_others_do():
    """None of them has data: y is noise, and all but few components go."""
    model = drawn(mixed_model(False, groups=10).with_lam(*KINDS), np.random.default_rng(16), 0.5)
    now = find_variances(make_equations(model.random, model.group_fixed, model.border))
    assert not now.alive[[GROUP, TURN, SHARED, FIELD]].any()
    assert now.sigma == pytest.approx(0.5, rel=4 / np.sqrt(2 * model.freedom))
