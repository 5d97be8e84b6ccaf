"""Variance components by restricted maximum likelihood (REML), and which the data call for.

Newton's method on the logarithms with the average information (Gilmour, Thompson, Cullis, Average
information REML, Biometrics 51 (1995)); where that does not help, the fixed point
tau_k^2 = b_k' b_k / gamma_k, with gamma_k the number of coefficients that the data determine
(Searle, Casella, McCulloch, Variance Components (1992), section 7.6; MacKay, Bayesian
interpolation, Neural Computation 4 (1992)).  Rao's MINQUE (1971) is its first step.
Offsets of units follow a t distribution, a normal one whose scale each unit draws anew: a few that
are far off do not widen the bulk.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import special

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.mixed_model.equations import (
    LAMBDA_ABSENT,
    Equations,
    FactoredEquations,
    Variances,
    factor_equations,
    no_variances,
)
from fisheye_svp_ros.mixed_model.score_tests import score_components
from fisheye_svp_ros.mixed_model.solution import (
    Posterior,
    Solution,
    deviance_without,
    posterior_covariance,
    posterior_variances,
    solution_without,
    solve_equations,
)
from fisheye_svp_ros.mixed_model.threads import map_in_threads

T_FREEDOM = 3.0  # of the t distribution of units' offsets
_MAX_STEPS = 25
_TOLERANCE = 0.1  # of log lambda
_OVERRELAXATION = 1.4
_VANISHING_SHARE = 3e-4  # of the noise variance: a component that adds less has vanished
_MAX_SHARE = 1e8  # times the noise variance: no component adds more, whatever a fit says
_SCREENING_P, _ADDITION_P = 0.3, 0.01  # p-values to start with a component, and to add one
_INITIAL_SHARE = 0.02  # of the noise
_REMOVAL_P = 0.05
_UNCERTAIN_LOG = 0.3  # standard error of log tau^2 above which a component may be chance
_WARM_STEPS = 6  # from the variances of a similar state
# Likelihood ratios between which the other variances follow; beyond the last they take up no such
# part that a component would be removed.
_UNDECIDED_RATIOS, _REMOVABLE_RATIO = (2.7, 25.0), 10.0


def initial_variances(eq: Equations, share: float = 0.03) -> Variances:
    """Return variances with which every component adds a share of the noise."""
    squares = _sum_by_component(
        eq, np.diagonal(eq.blocks.ee, axis1=-2, axis2=-1), np.diag(eq.blocks.rr)
    )
    counts = _sum_by_component(
        eq, np.ones(eq.blocks.e_label.shape), np.ones(len(eq.blocks.r_label))
    )
    lam = np.where(counts > 0, squares / share / eq.rows, LAMBDA_ABSENT)
    return Variances(1.0, np.maximum(lam, 1e-9), np.ones(len(eq.units)))


def estimate_variances(
    eq: Equations, start: Variances, steps: int = _MAX_STEPS
) -> tuple[Variances, Equations]:
    """Estimate the variances; the border must be of full rank.

    A component whose variance runs to zero is switched off and stays so.  Returns the variances
    with their covariance, and the equations without what has vanished.
    """
    now, eq, f, solution = _iterate(eq, start, steps)
    information = average_information(f, solution)
    free = np.append(now.alive, True)
    covariance = np.zeros(information.shape)
    # A component on its way to zero must not lend its uncertainty to all others.
    part = information[np.ix_(free, free)] + 0.01 * np.eye(int(free.sum()))
    covariance[np.ix_(free, free)] = np.linalg.inv(part)
    return replace(now, covariance=covariance), eq


def _iterate(
    eq: Equations, start: Variances, steps: int
) -> tuple[Variances, Equations, FactoredEquations, Solution]:
    """Return the variances after some steps, the equations, and what the last step solved."""
    now, eq, deviance = start, eq.select(start.alive), np.inf
    floor = initial_variances(eq, _MAX_SHARE).lam
    for step in range(steps):
        now = replace(now, lam=np.maximum(now.lam, floor))
        f = factor_equations(eq, now.lam, now.weight)
        solution = solve_equations(f, posterior_variances(f))
        newton = step > 0 and solution.deviance < deviance + 1e-3 * eq.rows
        before, now, deviance = now, update_variances(f, solution, now, newton), solution.deviance
        if (now.alive != before.alive).any():
            eq, deviance = eq.select(now.alive), np.inf
            continue
        change = np.abs(np.log(now.lam / before.lam)[now.alive]).max(initial=0.0)
        shift = np.abs(np.log(now.weight / before.weight)).mean() if len(now.weight) else 0.0
        if change < _TOLERANCE and shift < _TOLERANCE / 2:
            break
    return now, eq, f, solution


def update_variances(
    f: FactoredEquations, solution: Solution, now: Variances, newton: bool = False
) -> Variances:
    """Return the variances after one step; newton: by Newton's method, not the fixed point."""
    eq, alive = f.equations, now.alive
    size = f.prior_squares(solution.e, solution.r) / solution.variance
    e, r = f.precision
    gamma = _sum_by_component(eq, 1 - e * solution.spread_e, 1 - r * solution.spread_r)
    slope = np.where(alive, (size - gamma) / 2, 0.0)
    if newton:
        change = _newton_step(f, solution, now, slope)
    else:
        ratio = np.log(np.maximum(size, 1e-9) / np.maximum(gamma, 1e-9))
        change = np.where(alive, np.clip(ratio * _OVERRELAXATION, -2, 2), 0.0)
    lam = np.where(alive, now.lam * np.exp(-change), LAMBDA_ABSENT)
    ceiling = initial_variances(eq, _VANISHING_SHARE).lam
    vanished = (slope < 0) & ((lam > ceiling) | (gamma < 0.3))
    return Variances(
        float(np.sqrt(solution.variance)),
        np.where(vanished, LAMBDA_ABSENT, lam),
        _unit_weights(eq, now, solution),
    )


def _newton_step(f: FactoredEquations, solution: Solution, now: Variances, slope: Array) -> Array:
    """Return the change of log tau^2 (K,) by average information, noise profiled out."""
    information = average_information(f, solution)
    free = np.append(now.alive, True)
    change = np.zeros(len(free))
    part = information[np.ix_(free, free)]
    part = part + np.diag(1e-3 * np.diag(part) + 1e-9)
    change[free] = np.linalg.solve(part, np.append(slope, 0.0)[free])
    change = np.clip(change - change[-1], -3.0, 2.0)
    return np.asarray(change[:-1])


def average_information(f: FactoredEquations, solution: Solution) -> Array:
    """Return the average information (K + 1, K + 1) on log tau^2 and, last, log sigma^2."""
    eq = f.equations
    b, count = eq.blocks, eq.components.count
    kinds = np.arange(count)
    e = np.where((b.e_label[..., None] == kinds), solution.e[..., None], 0.0)
    r = np.where((b.r_label[:, None] == kinds), solution.r[:, None], 0.0)
    ge, gr, gx = eq.multiply(e, r)
    prior_e, prior_r = f.precision
    # The residual's products with all columns follow from the equations it solves.
    de, dr = prior_e * solution.e, prior_r * solution.r
    ge = np.concatenate([ge, de[..., None]], axis=-1)
    gr = np.concatenate([gr, dr[:, None]], axis=-1)
    gx = np.concatenate([gx[:-1], np.zeros((len(gx) - 1, 1))], axis=1)
    own = np.zeros((count + 1, count + 1))
    flat_e, flat_ge = e.reshape(-1, count), ge.reshape(-1, count + 1)
    own[:count] = flat_e.T @ flat_ge + r.T @ gr
    own[:count, -1] = flat_e.T @ de.ravel() + r.T @ dr
    own[-1, :count] = own[:count, -1]
    ridge = float((de * solution.e).sum() + dr @ solution.r)
    own[-1, -1] = solution.variance * f.freedom - ridge
    return np.asarray((own - f.project(ge, gr, gx)) / 2 / solution.variance)


def _sum_by_component(eq: Equations, e: Array, r: Array) -> Array:
    """Sum values (E, k), (R,) of coefficients by component (K,)."""
    label, values = eq.label, np.append(e, r)
    random = label >= 0
    sums = np.bincount(label[random], weights=values[random], minlength=eq.components.count)
    return np.asarray(sums, dtype=float)


def _unit_weights(eq: Equations, now: Variances, solution: Solution) -> Array:
    """Return the expected precisions of units' offsets (EM of the scale mixture)."""
    if not len(eq.units):
        return now.weight
    label = unit_labels(eq)
    present = (label >= 0) & (now.lam[label] < LAMBDA_ABSENT)
    offset = eq.unit_rows(solution.e, solution.r)
    spread = eq.unit_rows(solution.spread_e, solution.spread_r)
    lam = np.where(present, now.lam[label], 0.0)
    squares = (lam * (offset**2 / solution.variance + spread)).sum(axis=1)
    weight = np.ones_like(now.weight)
    weight[eq.units] = (T_FREEDOM + present.sum(axis=1)) / (T_FREEDOM + squares)
    return weight


def unit_labels(eq: Equations) -> Index:
    """Return the components (m, w) of units' offsets."""
    return np.asarray(eq.unit_rows(eq.blocks.e_label, eq.blocks.r_label))


def find_variances(eq: Equations, before: Variances | None = None) -> Variances:
    """Return the variances of the components that the data call for.

    eq: with everything that may be fixed in its border, of full rank, or a real fixed effect would
    widen the component that resembles it; before: variances of a similar state to start from.
    """
    first, numerous = initial_variances(eq, _INITIAL_SHARE), eq.components.numerous
    if before is None:
        p = score_components(
            eq,
            no_variances(len(numerous), len(first.weight)),
            np.flatnonzero(~numerous),
            _SCREENING_P,
        )
        lam = np.where(p < _SCREENING_P, first.lam, LAMBDA_ABSENT)
        now, _ = estimate_variances(eq, Variances(1.0, lam, first.weight))
    else:
        now, _ = estimate_variances(eq, before, _WARM_STEPS)
    # What the data do not call for beside large residuals they may call for beside smaller ones.
    p = score_components(eq, now, np.flatnonzero(~now.alive), _ADDITION_P)
    lam = np.where(p < _ADDITION_P, first.lam, now.lam)
    if (lam < LAMBDA_ABSENT).sum() > now.alive.sum():
        now, _ = estimate_variances(eq, Variances(now.sigma, lam, now.weight))
    return _remove_chance(eq.select(now.alive), now)


def remove_contradicted(eq: Equations, fewer: Equations, now: Variances) -> Variances:
    """Switch off components that a model with fewer fixed columns is likelier without.

    eq: equations that `now` was estimated with; fewer: those of what is in the model alone.  Where
    all that may be fixed leaves few numbers to a component of few groups, its variance can be
    anything; what is not in the model can only widen it there.
    """
    while True:
        kinds = np.intersect1d(_uncertain_components(now), np.flatnonzero(~eq.components.of_units))
        if not len(kinds):
            return now
        ratios = _deviance_ratios(_solve_whole(fewer, now), kinds)
        kind = min(ratios, key=ratios.__getitem__)
        if ratios[kind] >= 0:
            return now
        now, eq = estimate_variances(eq, now.without_component(kind), _WARM_STEPS)


def is_called_for(eq: Equations, now: Variances, kind: int) -> bool:
    """Return whether the data call for one more component beside those that are there."""
    return bool(score_components(eq, now, [kind], _ADDITION_P)[kind] < _ADDITION_P)


def component_p_values(eq: Equations, now: Variances) -> Array:
    """Return p-values (K,) of the components, each by leaving it out; 1 for those not there.

    Restricted likelihood ratio on the boundary: half the tail of chi-square(1) (Self and Liang,
    JASA 82 (1987)); the other variances follow.  Offsets of units are drawn as alike there: a
    scale for each would fit chance with as many numbers as there are units.
    """
    of_units = eq.components.of_units
    p_values = np.ones(len(of_units))
    for kinds, variances in ((~of_units, now), (of_units, now.with_equal_weights(of_units))):
        if (now.alive & kinds).any():
            whole = _solve_whole(eq, variances)
            ratios = _deviance_ratios(whole, np.flatnonzero(now.alive & kinds))
            for kind, ratio in _follow_variances(eq, variances, whole, ratios).items():
                p_values[kind] = _boundary_p_value(ratio)
    return p_values


def _remove_chance(eq: Equations, now: Variances) -> Variances:
    """Switch off what may be chance: a variance hardly known makes every test unsure.

    One at a time: two that do the same are each dispensable, but not both.
    """
    while len(uncertain := _uncertain_components(now)):
        whole = _solve_whole(eq, now)
        ratios = _deviance_ratios(whole, uncertain)
        if _boundary_p_value(min(ratios.values())) <= _REMOVAL_P:
            doubtful = {kind: ratio for kind, ratio in ratios.items() if ratio < _REMOVABLE_RATIO}
            ratios |= _follow_variances(eq, now, whole, doubtful)
        kind = min(ratios, key=ratios.__getitem__)
        if _boundary_p_value(ratios[kind]) <= _REMOVAL_P:
            break
        now, eq = estimate_variances(eq, now.without_component(kind), _WARM_STEPS)
    return now


def _uncertain_components(now: Variances) -> Index:
    """Return the components whose variance is not known well enough to be beyond doubt."""
    assert now.covariance is not None
    spread = np.sqrt(np.diag(now.covariance)[:-1])
    return np.flatnonzero(now.alive & (spread > _UNCERTAIN_LOG))


def _boundary_p_value(ratio: float) -> float:
    return float(special.chdtrc(1, max(ratio, 0.0))) / 2


class _FullModel(NamedTuple):
    """The equations of all components, solved."""

    factored: FactoredEquations
    solution: Solution
    posterior: Posterior


def _solve_whole(eq: Equations, now: Variances) -> _FullModel:
    f = factor_equations(eq.select(now.alive), now.lam, now.weight)
    posterior = posterior_covariance(f)
    return _FullModel(f, solve_equations(f, posterior.variances), posterior)


def _deviance_ratios(whole: _FullModel, kinds: Iterable[int]) -> dict[int, float]:
    """Return by how much the deviance rises without each of some components."""
    return {int(kind): deviance_without(*whole, int(kind)) for kind in kinds}


def _follow_variances(
    eq: Equations, now: Variances, whole: _FullModel, ratios: dict[int, float]
) -> dict[int, float]:
    """Return likelihood ratios once the other variances have taken up what they can.

    They only ever take up a part of it, so that only undecided ones are asked for.  The variances
    need not be the best of these equations: with all components they take the same step.
    """

    def deviance(after: Variances) -> float:
        after = replace(after, weight=now.weight)  # or likelihoods of different data are compared
        return solve_equations(
            factor_equations(eq.select(after.alive), after.lam, after.weight)
        ).deviance

    low, high = _UNDECIDED_RATIOS
    undecided = [kind for kind, ratio in ratios.items() if low < ratio < high]
    if not undecided:
        return ratios
    before = whole.solution.deviance
    best = min(before, deviance(update_variances(whole.factored, whole.solution, now)))

    def follow(kind: int) -> float:
        return min(before + ratios[kind], deviance(_step_without(eq, now, whole, kind))) - best

    followed = map_in_threads(follow, undecided, len(undecided) * whole.factored.products)
    return ratios | dict(zip(undecided, followed, strict=True))


def _step_without(eq: Equations, now: Variances, whole: _FullModel, kind: int) -> Variances:
    f, others = whole.factored, now.without_component(kind)
    if (f.equations.blocks.r_label == kind).any():
        return update_variances(f, solution_without(*whole, kind), others)
    f = factor_equations(eq.select(others.alive), others.lam, others.weight)
    return update_variances(f, solve_equations(f, posterior_variances(f)), others)
