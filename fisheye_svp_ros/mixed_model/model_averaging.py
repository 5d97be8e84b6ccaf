"""Which added columns are there, and how large: all likely subsets, by marginal likelihood.

A model is a set of options: columns with normal coefficients of a known prior size.  With all
else eliminated, a small matrix of products is left, from which the marginal likelihood of any
subset follows in closed form.  Subsets are found best first, by adding and taking away one option
at a time, until none that is left can count; means over them need no sample.
Source: Mitchell and Beauchamp, Bayesian variable selection in linear regression, Journal of the
American Statistical Association 83 (1988); Madigan and Raftery, Model selection and accounting for
model uncertainty in graphical models using Occam's window, ibid. 89 (1994).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy import special

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.mixed_model.score_tests import pseudo_inverse

_EXPANDED_LOG, _KEPT_LOG = 5.0, 8.0  # log weight below the best: not expanded, not kept
_BATCH = 16  # models that are expanded at once
_MOST_EXPANDED = 64  # beside each of several products
_LEAST_REST = 1e-9  # of the squares of the residual
_LEAST = 1e-280  # where nothing is left of it, or was
_ROUNDING = 1e-10  # of the largest eigenvalue of a block
_OPEN = 1e-13  # of the largest eigenvalue: what the data leave open


class Options(NamedTuple):
    """What models are made of, O options of at most p columns each.

    columns (O, p): of the matrix; sd (O, p): prior standard deviations of their coefficients over
    that of the noise, 0 where an option has fewer columns; log_odds (O,): before the data, of a
    model with the option to one without; positive (O,): whether its one coefficient is; conflict
    (O, O): which are not in one model, none with itself.
    """

    columns: Index
    sd: Array
    log_odds: Array
    positive: Mask
    conflict: Mask


class Products(NamedTuple):
    """Products (P + 1, P + 1) of columns and, last, the residual, all else eliminated.

    freedom: numbers beyond what was eliminated; log_likelihood: of the model without options, up
    to a constant that all have in common.  fixed, follow, inverse: what was eliminated without a
    prior: estimates (K,), what a coefficient of each column takes off them (K, P), the inverse
    (K, K) of their information.
    """

    matrix: Array
    freedom: float
    log_likelihood: float = 0.0
    fixed: Array = np.zeros(0)
    follow: Array = np.zeros((0, 0))
    inverse: Array = np.zeros((0, 0))

    @classmethod
    def eliminating(
        cls, information: Array, fixed: Index, columns: Index, rows: float, logs: float = 0.0
    ) -> Products:
        """Eliminate some columns (K,) of an information (X, X), the residual last; others: (P,).

        rows: numbers that the information is of; logs: log likelihood up to these.
        """
        both = np.append(columns, len(information) - 1)
        own = information[np.ix_(fixed, fixed)]
        inverse = pseudo_inverse(own, _OPEN)
        across = inverse @ information[np.ix_(fixed, both)]
        left = information[np.ix_(both, both)] - information[np.ix_(both, fixed)] @ across
        values = np.linalg.eigvalsh(own)
        logs -= np.log(np.maximum(values, _OPEN * values.max(initial=1e-300))).sum() / 2
        return cls(
            (left + left.T) / 2,
            max(float(rows - len(fixed)), 1.0),
            float(logs),
            across[:, -1],
            across[:, :-1],
            inverse,
        )


class Coefficients(NamedTuple):
    """Of N models, in w places: columns (N, w), means (N, w), roots (N, w, w) of covariances.

    Means and covariances are 0 in places that a model does not have; roots are over the standard
    deviation of the noise; variance (N,): of the noise, of so many degrees of freedom as products.
    """

    columns: Index
    mean: Array
    root: Array
    variance: Array


@dataclass(frozen=True)
class Models:
    """The likely models, N of them.

    there (N, O): their options; base (N,): which products they are of; weight (N,): posterior
    probabilities, which sum to one.
    """

    there: Mask
    base: Index
    weight: Array

    def probability(self, chosen: Mask) -> float:
        """Return the probability that at least one of the chosen options (O,) is there."""
        return min(float(self.weight @ self.there[:, chosen].any(axis=1)), 1.0)

    def take(self, rows: Index | Mask) -> Models:
        """Return some of the models, their weights to sum to one."""
        weight = self.weight[rows]
        return Models(self.there[rows], self.base[rows], weight / weight.sum())


@dataclass(frozen=True)
class _Solved:
    """Models (N, O) of some products, solved in w places each.

    at (N, w), sd (N, w): columns and prior sizes of these, 0 where a model has fewer; positive (N,
    w): which can only be that; root (N, w, w): lower, of the scaled information; half (N, w): the
    score after forward substitution.
    """

    at: Index
    sd: Array
    positive: Mask
    root: Array
    half: Array

    @classmethod
    def solve(cls, products: Products, options: Options, there: Mask) -> _Solved:
        most = int(there.sum(axis=1).max(initial=0))
        chosen = np.argsort(~there, axis=1, kind='stable')[:, :most]
        real = np.take_along_axis(there, chosen, axis=1)[..., None] & (options.sd[chosen] > 0)
        shape = len(there), most * options.columns.shape[1]
        real = real.reshape(shape)
        # Models have few columns, however many one of the options may have.
        order = np.argsort(~real, axis=1, kind='stable')[:, : int(real.sum(axis=1).max(initial=0))]

        def gather(values: Any) -> Any:
            return np.take_along_axis(values[chosen].reshape(shape), order, axis=1)

        real = np.take_along_axis(real, order, axis=1)
        at, sd = gather(options.columns), gather(options.sd) * real
        signed = np.broadcast_to(options.positive[:, None], options.sd.shape)
        block = products.matrix[at[:, :, None], at[:, None]] * sd[:, :, None] * sd[:, None]
        root = _root_beside_prior(block)
        score = (products.matrix[at, -1] * sd)[..., None]
        return cls(at, sd, gather(signed) & real, root, _solve_roots(root, score)[..., 0])

    @cached_property
    def inverse(self) -> Array:
        """Inverses (N, w, w) of the roots, transposed."""
        identity = np.broadcast_to(np.eye(self.root.shape[-1]), self.root.shape)
        return np.swapaxes(_solve_roots(self.root, identity), -1, -2)

    def positive_scores(self) -> tuple[Index, Array]:
        """Return the models (m,) and the means over errors (m,) of what can only be positive.

        Errors over the standard deviation of the noise.
        """
        model, place = np.nonzero(self.positive)
        unit = np.eye(self.root.shape[-1])[place, :, None]
        column = _solve_roots(self.root[model], unit)[..., 0]
        return model, (column * self.half[model]).sum(axis=1) / np.linalg.norm(column, axis=1)

    def rest(self, products: Products) -> Array:
        """Return the squares (N,) that are left of the residual."""
        whole = products.matrix[-1, -1]
        least = max(_LEAST_REST * whole, _LEAST)
        return np.asarray(np.maximum(whole - (self.half**2).sum(axis=1), least))

    def log_evidence(self, products: Products) -> Array:
        """Return log marginal likelihoods (N,)."""
        logs = np.log(np.diagonal(self.root, axis1=-2, axis2=-1)).sum(axis=1)
        return np.asarray(_log_likelihood(products, self.rest(products)) - logs)


def _solve_roots(root: Array, right: Array) -> Array:
    """Solve the equations of lower roots (N, w, w), all at once; right (N, w, C)."""
    found = np.empty(right.shape)
    for i in range(right.shape[1]):
        known = root[:, None, i, :i] @ found[:, :i]
        found[:, i] = (right[:, i] - known[:, 0]) / root[:, i, i, None]
    return found


def _root_beside_prior(block: Array) -> Array:
    """Return lower roots (..., w, w) of blocks and the identity.

    Without noise, prior sizes are large beside it without limit, and rounding of what columns
    have in common leaves no root: no eigenvalue is less than that rounding then.
    """
    whole = block + np.eye(block.shape[-1])
    try:
        return np.asarray(np.linalg.cholesky(whole), dtype=float)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(whole)
        least = np.maximum(1.0, _ROUNDING * np.abs(values).max(axis=-1, keepdims=True))
        whole = (vectors * np.maximum(values, least)[..., None, :]) @ np.swapaxes(vectors, -1, -2)
        return np.asarray(np.linalg.cholesky(whole), dtype=float)


def _log_likelihood(products: Products, rest: Array) -> Array:
    return np.asarray(products.log_likelihood - products.freedom / 2 * np.log(rest))


def log_evidence(products: Products, options: Options, there: Mask) -> Array:
    """Return log marginal likelihoods (N,) of models (N, O), with their odds before the data."""
    return _log_evidence_of(_Solved.solve(products, options, there), products, options, there)


def _log_evidence_of(solved: _Solved, products: Products, options: Options, there: Mask) -> Array:
    found = solved.log_evidence(products) + there @ options.log_odds
    if solved.positive.any():
        noise = np.sqrt(solved.rest(products) / products.freedom)
        model, score = solved.positive_scores()
        logs = special.log_ndtr(score / noise[model]) + np.log(2)
        found = found + np.bincount(model, logs, len(found))
    return np.asarray(found)


def find_coefficients(products: Products, options: Options, there: Mask) -> Coefficients:
    """Return what coefficients models (N, O) have."""
    solved = _Solved.solve(products, options, there)
    root = solved.sd[..., None] * solved.inverse
    mean = (root @ solved.half[..., None])[..., 0]
    return Coefficients(solved.at, mean, root, solved.rest(products) / products.freedom)


class Estimates(NamedTuple):
    """Of N models: values (N, K + P) and covariances (N, C, C), of C combinations of these.

    Of what is always there and then of all columns, zeros for those that a model does not have.
    """

    values: Array
    covariance: Array


def estimate_models(
    products: Products, options: Options, there: Mask, into: Array | None = None
) -> Estimates:
    """Return what models (N, O) make of all columns.

    into (C, K + P): combinations that covariances are asked of, None for all columns themselves.
    """
    found = find_coefficients(products, options, there)
    (count, width), (always, columns) = found.columns.shape, products.follow.shape
    rows, places = np.arange(count)[:, None], always + found.columns
    values = np.zeros((count, always + columns))
    root = np.zeros((count, always + columns, width))
    np.add.at(values, (rows, places), found.mean)
    np.add.at(root, (rows[..., None], places[..., None], np.arange(width)), found.root)
    values[:, :always] = products.fixed - values[:, always:] @ products.follow.T
    root[:, :always] = -products.follow @ root[:, always:]
    into = np.eye(always + columns) if into is None else into
    root, own = into @ root, into[:, :always]
    covariance = root @ np.swapaxes(root, -1, -2) + own @ products.inverse @ own.T
    return Estimates(values, covariance * found.variance[:, None, None])


def find_models(bases: Sequence[Products], options: Options, first: Mask) -> Models:
    """Return all models that are likely beside any of several products, best first.

    first (N, O): models to begin with, beside the one without options.
    """
    count = len(options.log_odds)
    there, base, logs = np.zeros((0, count), dtype=bool), np.zeros(0, dtype=int), np.zeros(0)
    for number, products in enumerate(bases):
        best = float(logs.max(initial=-np.inf))
        # What is likely beside other products is likely beside these.
        begin = np.concatenate([first, there[logs > best - _EXPANDED_LOG]])
        more, theirs = _search(products, options, begin, best)
        there, logs = np.concatenate([there, more]), np.append(logs, theirs)
        base = np.append(base, np.full(len(theirs), number))
    kept = logs > logs.max() - _KEPT_LOG
    order = np.flatnonzero(kept)[np.argsort(-logs[kept], kind='stable')]
    return Models(there[order], base[order], np.asarray(special.softmax(logs[order])))


def _search(products: Products, options: Options, first: Mask, best: float) -> tuple[Mask, Array]:
    """Return models (N, O) of some products and their log marginal likelihoods (N,).

    first: models to begin with, beside the one without options; best: the best elsewhere.
    """
    count = len(options.log_odds)
    marks = np.random.default_rng(0).integers(0, 2**63, count, dtype=np.uint64)
    there = np.unique(np.concatenate([np.zeros((1, count), dtype=bool), first]), axis=0)
    logs = log_evidence(products, options, there)
    waiting, expanded = np.ones(len(there), dtype=bool), 0
    while expanded < _MOST_EXPANDED:
        best = max(best, float(logs.max()))
        likely = np.flatnonzero(waiting & (logs > best - _EXPANDED_LOG))
        if not len(likely):
            break
        now = likely[np.argsort(-logs[likely], kind='stable')[:_BATCH]]
        waiting[now], expanded = False, expanded + len(now)
        more, theirs = _neighbors(products, options, there[now], best - _KEPT_LOG)
        _, new = np.unique(more @ marks, return_index=True)
        new = new[~np.isin(more[new] @ marks, there @ marks)]
        there, logs = np.concatenate([there, more[new]]), np.append(logs, theirs[new])
        waiting = np.append(waiting, np.ones(len(new), dtype=bool))
    return there, logs


def _neighbors(
    products: Products, options: Options, there: Mask, least: float
) -> tuple[Mask, Array]:
    """Return models with one option more or less than some (N, O), if their logs are not less."""
    logs = _log_with_one_more(products, options, there)
    row, option = np.nonzero(logs > least)
    larger = there[row]
    larger[np.arange(len(row)), option] = True
    rows, options_there = np.nonzero(there)
    smaller = there[rows]
    smaller[np.arange(len(rows)), options_there] = False
    less = log_evidence(products, options, smaller)
    kept = less > least
    return np.concatenate([larger, smaller[kept]]), np.append(logs[row, option], less[kept])


def _log_with_one_more(products: Products, options: Options, there: Mask) -> Array:
    """Return log marginal likelihoods (N, O) of models (N, O) with one more option each.

    -inf for what is there or in conflict.  By an update of the rank of the option.
    """
    solved = _Solved.solve(products, options, there)
    across = products.matrix[solved.at] * solved.sd[..., None]
    half = _solve_roots(solved.root, across)
    left = products.matrix - np.swapaxes(half, -1, -2) @ half
    rest = solved.rest(products)
    logs = _log_evidence_of(solved, products, options, there)[:, None] + options.log_odds
    widths = (options.sd > 0).sum(axis=1)
    for width in np.unique(widths):
        mine = np.flatnonzero(widths == width)
        at, sd = options.columns[mine, :width], options.sd[mine, :width]
        block = left[:, at[:, :, None], at[:, None]] * sd[:, :, None] * sd[:, None]
        root = _root_beside_prior(block)
        z = np.linalg.solve(root, (left[:, at, -1] * sd)[..., None])[..., 0]
        share = np.minimum((z**2).sum(axis=-1) / rest[:, None], 1 - _LEAST_REST)
        determinant = np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(axis=-1)
        logs[:, mine] -= determinant + products.freedom / 2 * np.log1p(-share)
        if (signed := options.positive[mine]).any():
            noise = np.sqrt(rest[:, None] * (1 - share[:, signed]) / products.freedom)
            logs[:, mine[signed]] += special.log_ndtr(z[:, signed, 0] / noise) + np.log(2)
    logs[there | (there @ options.conflict)] = -np.inf
    return np.asarray(logs)
