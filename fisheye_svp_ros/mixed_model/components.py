"""Which variance components the data call for: score tests of variances at zero, then REML."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from scipy import special

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.mixed_model.equations import (
    Equations,
    FactoredEquations,
    factor_equations,
    map_in_threads,
    solve_lower,
)
from fisheye_svp_ros.mixed_model.reml import (
    LAMBDA_ABSENT,
    Variances,
    estimate_variances,
    initial_variances,
    no_variances,
    update_variances,
)
from fisheye_svp_ros.mixed_model.solution import (
    Posterior,
    Solution,
    deviance_without,
    posterior_covariance,
    posterior_variances,
    solution_without,
    solve_equations,
)

_SCREENING_P, _ADDITION_P = 0.3, 0.01  # p-values to start with a component, and to add one
_INITIAL_SHARE = 0.02  # of the noise
_REMOVAL_P = 0.05
_UNCERTAIN_LOG = 0.3  # standard error of log tau^2 above which a component may be chance
_WARM_STEPS = 6  # from the variances of a similar state
_UNDECIDED_RATIOS = (2.7, 25.0)  # likelihood ratios between which the other variances follow


def find_variances(eq: Equations, before: Variances | None = None) -> Variances:
    """Return the variances of the components that the data call for.

    eq: with everything that may be fixed in its border, of full rank, or a real fixed effect would
    widen the component that resembles it; before: variances of a similar state to start from.
    """
    first, numerous = initial_variances(eq, _INITIAL_SHARE), eq.components.numerous
    if before is None:
        p = score_components(
            eq, no_variances(len(numerous), len(first.weight)), np.flatnonzero(~numerous))
        lam = np.where(p < _SCREENING_P, first.lam, LAMBDA_ABSENT)
        now, _ = estimate_variances(eq, Variances(1.0, lam, first.weight))
    else:
        now, _ = estimate_variances(eq, before, _WARM_STEPS)
    # What the data do not call for beside large residuals they may call for beside smaller ones.
    p = score_components(eq, now, np.flatnonzero(~now.alive))
    lam = np.where(p < _ADDITION_P, first.lam, now.lam)
    if (lam < LAMBDA_ABSENT).sum() > now.alive.sum():
        now, _ = estimate_variances(eq, Variances(now.sigma, lam, now.weight))
    return _remove_chance(eq.select(now.alive), now)


def is_called_for(eq: Equations, now: Variances, kind: int) -> bool:
    """Return whether the data call for one more component beside those that are there."""
    return bool(score_components(eq, now, [kind])[kind] < _ADDITION_P)


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
            ratios = _follow_variances(eq, now, whole, ratios)
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

    They only ever take up a part of it, so that only undecided ones are asked for.
    """

    def follow(kind: int) -> float:
        after = _step_without(eq, now, whole, kind)
        f = factor_equations(eq.select(after.alive), after.lam, after.weight)
        return solve_equations(f).deviance - whole.solution.deviance

    low, high = _UNDECIDED_RATIOS
    undecided = [kind for kind, ratio in ratios.items() if low < ratio < high]
    followed = map_in_threads(follow, undecided, len(undecided) * _products(whole.factored))
    return ratios | dict(zip(undecided, followed, strict=True))


def _products(f: FactoredEquations) -> float:
    """Return how many products of numbers another factorization takes."""
    return float(f.coupled.size * len(f.factor))


def _step_without(eq: Equations, now: Variances, whole: _FullModel, kind: int) -> Variances:
    f, others = whole.factored, now.without_component(kind)
    if (f.equations.blocks.r_label == kind).any():
        return update_variances(f, solution_without(*whole, kind), others)
    f = factor_equations(eq.select(others.alive), others.lam, others.weight)
    return update_variances(f, solve_equations(f, posterior_variances(f)), others)


def score_components(eq: Equations, now: Variances, kinds: Iterable[int]) -> Array:
    """Return p-values (K,) of variances at zero, NaN for those not asked or not testable.

    The sum of squares of the columns' products with the residual (Rao's score, 1948) against a
    gamma distribution of the same mean and variance.  Source: Lin, Variance component testing in
    generalised linear models with random effects, Biometrika 84 (1997).
    """
    p_values, kinds = np.full(eq.components.count, np.nan), list(kinds)
    if not kinds:
        return p_values
    f = factor_equations(eq.select(now.alive), now.lam, now.weight)
    solution = solve_equations(f)

    def score(kind: int) -> float:
        columns = _component_columns(eq, now.alive, int(kind))
        if columns is None:
            return np.nan
        size = float((_score(columns, solution) ** 2).sum()) / solution.variance
        remaining = _remaining_information(f, columns, True)
        mean, spread = remaining.trace, 2 * remaining.sum_of_squares
        if mean <= 1e-9 or spread <= 0:
            return np.nan
        return float(special.gammaincc(mean**2 / spread, size * mean / spread))

    p_values[kinds] = map_in_threads(score, kinds, _products(f))
    return p_values


def component_traces(eq: Equations, now: Variances) -> Array:
    """Return what each component adds per unit of its variance (K,), groups' columns out.

    Sums of squares of its columns once the fixed columns of groups are projected out, units by
    their weights; 0 for what is not there.
    """
    nothing = no_variances(eq.components.count, len(now.weight))
    f = factor_equations(eq.select(nothing.alive), nothing.lam, now.weight)
    traces = np.zeros(len(nothing.lam))
    for kind in np.flatnonzero(now.alive):
        columns = _component_columns(eq, nothing.alive, int(kind))
        if columns is not None:
            traces[kind] = _remaining_information(f, columns, False).trace
    return traces


class _ComponentColumns(NamedTuple):
    """Products of a component's g sets of w columns with each other and with all that is there.

    own (g, w, w): within the sets, between which there are none; e (b, k, w): with the blocks
    `at` (b,), -1 for one that is not there: of several sets with a block each, of one with all;
    r (R, g, w): with the rest; x (X, g, w): with the border.
    """

    own: Array
    at: Index
    e: Array
    r: Array
    x: Array


class _Information(NamedTuple):
    """The information of columns beside others: block (g, w, w) less u' u, u (C, g, w)."""

    block: Array
    u: Array

    @property
    def trace(self) -> float:
        return float(np.einsum('gww->', self.block) - (self.u**2).sum())

    @property
    def sum_of_squares(self) -> float:
        """The sum of the squares of all its elements."""
        u = self.u.reshape(len(self.u), self.block.shape[0] * self.block.shape[1])
        both = u @ u.T if u.shape[0] < u.shape[1] else u.T @ u
        across = np.moveaxis(self.u, 1, 0) @ self.block
        mixed = np.einsum('gcw,cgw->', across, self.u)
        return float((self.block**2).sum() - 2 * mixed + (both**2).sum())


def _component_columns(eq: Equations, alive: Mask, kind: int) -> _ComponentColumns | None:
    b = eq.blocks
    keep, columns, rest = eq.find_present(alive)
    in_r = np.flatnonzero(b.r_label == kind)
    if len(in_r):
        return _ComponentColumns(
            b.rr[np.ix_(in_r, in_r)][None], np.arange(int(keep.sum())),
            b.er[..., in_r][keep][:, columns], b.rr[np.ix_(rest, in_r)][:, None],
            b.rx[in_r].T[:, None])
    mine = b.e_label == kind
    block = np.flatnonzero(mine.any(axis=1))
    if not len(block):
        return None
    column = np.nonzero(mine)[1].reshape(len(block), -1)
    own = b.ee[block[:, None, None], column[:, :, None], column[:, None]]
    place, chosen = np.where(keep, np.cumsum(keep) - 1, -1), np.flatnonzero(columns)
    e = b.ee[block[:, None, None], chosen[:, None], column[:, None]]
    r, x = b.er[block[:, None], column][..., rest], b.ex[block[:, None], column]
    return _ComponentColumns(
        own, place[block], e, np.moveaxis(r, -1, 0), np.moveaxis(x, -1, 0))


def _score(c: _ComponentColumns, solution: Solution) -> Array:
    """Return the products (g, w) of columns with what is left of the residual."""
    present, change = c.at >= 0, np.append(-solution.values, 1.0)
    score = np.tensordot(change, c.x, 1) - np.tensordot(solution.r, c.r, 1)
    by_blocks = np.einsum('bkw,bk->bw', c.e[present], solution.e[c.at[present]])
    if len(c.own) > 1:
        score[present] -= by_blocks
    else:
        score -= by_blocks.sum(axis=0)
    return np.asarray(score)


def _remaining_information(
    f: FactoredEquations, c: _ComponentColumns, fixed: bool
) -> _Information:
    """Return the information of columns beside all that is there; fixed: the border's, too."""
    present, (groups, width, _) = c.at >= 0, c.own.shape
    first = f.inverse[c.at[present]] @ c.e[present]

    def multiply_blocks(part: Array) -> Array:
        """Return the products (C, g, w) of coefficients (b, k, C) with the columns."""
        if groups == 1:
            flat = first.reshape(first.size // width, width)
            return (part.reshape(len(flat), part.shape[-1]).T @ flat)[:, None]
        products = np.zeros((part.shape[-1], groups, width))
        products[:, present] = np.moveaxis(np.swapaxes(part, -1, -2) @ first, 1, 0)
        return products

    block = c.own.copy()
    if groups > 1:
        block[present] -= np.swapaxes(first, -1, -2) @ first
    else:
        block -= multiply_blocks(first)[:, 0]
    at = c.at[present]
    r = c.r - multiply_blocks(f.coupled[at])
    u = solve_lower(f.factor, r.reshape(len(r), groups * width))
    if fixed:
        x = c.x[:-1] - multiply_blocks(f.block_border[at, :, :-1])
        flat = x.reshape(len(x), groups * width) - f.border[:, :-1].T @ u
        u = np.concatenate([u, solve_lower(f.root, flat)])
    return _Information(block, u.reshape(len(u), groups, width))
