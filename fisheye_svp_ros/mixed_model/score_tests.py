"""Score tests of added fixed columns and of variances at zero, from one factorization.

Once groups' columns and random effects are eliminated, what is left is a small information matrix
of all fixed columns that could be added, with the score as its last row and column.
Source: Rao, Large sample tests of statistical hypotheses concerning several parameters,
Proceedings of the Cambridge Philosophical Society 44 (1948).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import special

from fisheye_svp_ros.arrays import Array, Index, Mask, flat_rows
from fisheye_svp_ros.mixed_model.equations import (
    Equations,
    FactoredEquations,
    Variances,
    factor_equations,
    no_variances,
    solve_lower,
)
from fisheye_svp_ros.mixed_model.model_columns import project_out
from fisheye_svp_ros.mixed_model.solution import (
    Solution,
    posterior_variances,
    solve_equations,
)
from fisheye_svp_ros.mixed_model.threads import map_in_threads

IDENTIFIABLE = 1e-8  # of a normalized column's square: what is left less cannot be told apart


class Score(NamedTuple):
    """A score test: statistic, rank, p-value, estimate (P,), degrees of freedom of its scale."""

    statistic: float
    rank: int
    p_value: float
    estimate: Array
    freedom: float


def score_columns(information: Array, columns: Index, scale: Array, variance: float) -> Score:
    """Test columns for which this information remains beside what is in the model.

    information (X, X): its last row and column the score; scale (X,): norms that the columns were
    divided by; variance: of the noise, that a normalized column alone has 1 / variance of.
    """
    return score_each(information, [columns], scale, variance)[0]


def score_each(
    information: Array, choices: Sequence[Index], scale: Array, variance: float
) -> list[Score]:
    """Test each of some choices of columns as `score_columns` does, those of a size together."""
    scores: dict[int, Score] = {}
    sizes = np.array([len(columns) for columns in choices])
    for size in np.unique(sizes):
        mine = np.flatnonzero(sizes == size).tolist()
        at = np.array([choices[i] for i in mine], dtype=np.int64).reshape(len(mine), size)
        block, gradient = information[at[:, :, None], at[:, None]], information[at, -1]
        values, vectors = np.linalg.eigh((block + np.swapaxes(block, -1, -2)) / 2)
        least = np.maximum(IDENTIFIABLE * values[:, -1:], IDENTIFIABLE / variance)
        kept = values > least
        along = (gradient[:, None] @ vectors)[:, 0] / np.where(kept, values, np.inf)
        estimate = (vectors @ along[..., None])[..., 0]
        statistic, rank = (estimate * gradient).sum(axis=1), kept.sum(axis=1)
        p = special.chdtrc(np.maximum(rank, 1), np.maximum(statistic, 0.0))
        p = np.where(rank > 0, p, 1.0)
        for j, i in enumerate(mine):
            scores[i] = Score(
                float(statistic[j]), int(rank[j]), float(p[j]), estimate[j] / scale[at[j]], np.inf
            )
    return [scores[i] for i in range(len(choices))]


def satterthwaite_freedom(f: FactoredEquations, combination: Array, covariance: Array) -> float:
    """Return the degrees of freedom of the information of a combination (X,) of the border.

    covariance: of log tau^2 and, last, log sigma^2.
    Source: Satterthwaite, An approximate distribution of estimates of variance components,
    Biometrics Bulletin 2 (1946).
    """
    size = float(combination @ f.information @ combination)
    shares = f.prior_squares(*f.coefficients(combination)) / max(size, 1e-300)
    slope = -np.append(shares, 1 - shares.sum())
    spread = float(slope @ covariance @ slope)
    return float(np.clip(2 / max(spread, 1e-9), 2.0, 1e6))


def integrate_columns(
    f: FactoredEquations, columns: Index, prior: float | Array
) -> tuple[float, Array]:
    """Return log determinant and information with columns of the border random; prior: lambda."""
    priors = np.broadcast_to(prior, columns.shape)
    inner = f.information[np.ix_(columns, columns)] + np.diag(priors)
    across = f.information[columns]
    logs = f.log_determinant + np.linalg.slogdet(inner)[1] - np.log(priors).sum()
    return float(logs), f.information - across.T @ np.linalg.solve(inner, across)


def eliminate(information: Array, included: Index) -> Array:
    """Return the information with the included columns eliminated (Schur complement)."""
    inverse = pseudo_inverse(information[np.ix_(included, included)])
    return np.asarray(information - information[:, included] @ inverse @ information[included])


def subtract_fit(
    information: Array, included: Index, combination: Array, floor: float = IDENTIFIABLE
) -> Array:
    """Return a combination (X,) of the border, less what included columns take up of it."""
    found = combination.copy()
    inverse = pseudo_inverse(information[np.ix_(included, included)], floor)
    found[included] -= inverse @ (information[included] @ combination)
    return found


def pseudo_inverse(matrix: Array, floor: float = IDENTIFIABLE, least: float = 1e-300) -> Array:
    """Return the pseudoinverse of a symmetric matrix.

    floor: of its largest eigenvalue, and least: below which an eigenvalue is taken as zero.
    """
    if not len(matrix):
        return matrix
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    kept = values > max(floor * float(values[-1]), least)
    return np.asarray((vectors[:, kept] / values[kept]) @ vectors[:, kept].T)


def identifiable_basis(group_fixed: Array, columns: Array, chosen: Index) -> Array:
    """Return combinations (X, m) of chosen columns (G, M, X), orthonormal beside groups' own."""
    flat = flat_rows(project_out(columns[..., chosen], group_fixed))
    values, vectors = np.linalg.eigh(flat.T @ flat)
    kept = values > IDENTIFIABLE
    basis = np.zeros((columns.shape[-1], int(kept.sum())))
    basis[chosen] = vectors[:, kept] / np.sqrt(values[kept])
    return basis


def score_components(
    eq: Equations, now: Variances, kinds: Iterable[int], limit: float = 1.0
) -> Array:
    """Return p-values (K,) of variances at zero, NaN for those not asked or not testable.

    limit: where a p-value is certainly not less, a lower bound of it is enough.
    The sum of squares of the columns' products with the residual (Rao's score, 1948) against a
    gamma distribution of the same mean and variance.  Source: Lin, Variance component testing in
    generalised linear models with random effects, Biometrika 84 (1997).
    """
    p_values = np.full(eq.components.count, np.nan)
    # The largest first: one of many coefficients takes longer than all others.
    kinds = sorted(kinds, key=lambda kind: -np.count_nonzero(eq.label == kind))
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
        mean = remaining.trace
        if mean <= IDENTIFIABLE * float(np.einsum('gww->', columns.own)):
            return np.nan  # fixed columns take it up: what is left is rounding
        least = _least_p_value(size / mean, columns.own.shape[0] * columns.own.shape[1])
        if least >= limit:
            return least
        spread = 2 * remaining.sum_of_squares
        if spread <= 0:
            return np.nan
        return float(special.gammaincc(mean**2 / spread, size * mean / spread))

    p_values[kinds] = map_in_threads(score, kinds, f.products)
    return p_values


def _least_p_value(ratio: float, count: int) -> float:
    """Return the least p-value of a sum of squares that is so many times its mean.

    Its gamma distribution is of a shape between those of 1 and of `count` alike squares; between
    them a p-value has no minimum.
    """
    return float(min(special.gammaincc(shape, shape * ratio) for shape in (0.5, count / 2)))


def component_squares(eq: Equations, f: FactoredEquations, now: Variances) -> Array:
    """Return the sums of squares that components add, over the noise variance (K,).

    Once the fixed columns of groups are projected out; 0 for what is not there.  By the variance
    of a component; offsets of units, which have a scale each, by what their squares are expected
    to be, given y.  eq: with all components; f: of those that are there, the border of full rank.
    """
    nothing = no_variances(eq.components.count, len(now.weight))
    bare = factor_equations(eq.select(nothing.alive), nothing.lam, now.weight)
    solution, labels = solve_equations(f, posterior_variances(f)), f.equations.label
    values = np.append(solution.e, solution.r)
    spread = np.append(solution.spread_e, solution.spread_r)
    squares = values**2 / solution.variance + spread
    sums = np.zeros(len(nothing.lam))
    for kind in np.flatnonzero(now.alive):
        columns = _component_columns(eq, nothing.alive, int(kind))
        if columns is None:
            continue
        own = _remaining_information(bare, columns, False).diagonal.ravel()
        of_units = eq.components.of_units[kind]
        sums[kind] = own @ squares[labels == kind] if of_units else own.sum() / now.lam[kind]
    return sums


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
    """The information of columns beside others: own (g, w, w) less what they share.

    first (b, k, w): with the blocks of some of the sets, `present` (g,), or of the one that there
    is; u (C, g, w): with all the rest.
    """

    own: Array
    first: Array
    present: Mask
    u: Array

    @property
    def trace(self) -> float:
        return float(self.diagonal.sum())

    @property
    def diagonal(self) -> Array:
        """What is left of the square of each column (g, w)."""
        diagonal = np.einsum('gww->gw', self.own) - (self.u**2).sum(axis=0)
        shared = np.einsum('bkw,bkw->bw', self.first, self.first)
        if len(diagonal) > 1:
            diagonal[self.present] -= shared
        else:
            diagonal -= shared.sum(axis=0)
        return np.asarray(diagonal)

    @property
    def block(self) -> Array:
        """What is left beside the blocks (g, w, w)."""
        block = self.own.copy()
        if len(block) > 1:
            block[self.present] -= np.swapaxes(self.first, -1, -2) @ self.first
        else:
            flat = self.first.reshape(-1, self.first.shape[-1])
            block -= flat.T @ flat
        return block

    @property
    def sum_of_squares(self) -> float:
        """The sum of the squares of all its elements."""
        block = self.block
        u = self.u.reshape(len(self.u), block.shape[0] * block.shape[1])
        both = u @ u.T if u.shape[0] < u.shape[1] else u.T @ u
        across = np.moveaxis(self.u, 1, 0) @ block
        mixed = np.einsum('gcw,cgw->', across, self.u)
        return float((block**2).sum() - 2 * mixed + (both**2).sum())


def _component_columns(eq: Equations, alive: Mask, kind: int) -> _ComponentColumns | None:
    b = eq.blocks
    keep, columns, rest = eq.find_present(alive)
    in_r = np.flatnonzero(b.r_label == kind)
    if len(in_r):
        return _ComponentColumns(
            b.rr[np.ix_(in_r, in_r)][None],
            np.arange(int(keep.sum())),
            b.er[..., in_r][keep][:, columns],
            b.rr[np.ix_(rest, in_r)][:, None],
            b.rx[in_r].T[:, None],
        )
    mine = b.e_label == kind
    block = np.flatnonzero(mine.any(axis=1))
    if not len(block):
        return None
    column = np.nonzero(mine)[1].reshape(len(block), -1)
    own = b.ee[block[:, None, None], column[:, :, None], column[:, None]]
    place, chosen = np.where(keep, np.cumsum(keep) - 1, -1), np.flatnonzero(columns)
    e = b.ee[block[:, None, None], chosen[:, None], column[:, None]]
    r, x = b.er[block[:, None], column][..., rest], b.ex[block[:, None], column]
    return _ComponentColumns(own, place[block], e, np.moveaxis(r, -1, 0), np.moveaxis(x, -1, 0))


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

    at = c.at[present]
    r = c.r - multiply_blocks(f.coupled[at])
    u = solve_lower(f.factor, r.reshape(len(r), groups * width))
    if fixed:
        x = c.x[:-1] - multiply_blocks(f.block_border[at, :, :-1])
        flat = x.reshape(len(x), groups * width) - f.border[:, :-1].T @ u
        u = np.concatenate([u, solve_lower(f.root, flat)])
    return _Information(c.own, first, present, u.reshape(len(u), groups, width))
