"""Score tests of added fixed columns, from the information of all columns that could be added.

One factorization serves all tests: once groups' columns and random effects are eliminated, what is
left is a small information matrix of fixed columns, with the score as its last row and column.
Source: Rao, Large sample tests of statistical hypotheses concerning several parameters,
Proceedings of the Cambridge Philosophical Society 44 (1948).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import special

from fisheye_svp_ros.arrays import Array, Index, flat_rows
from fisheye_svp_ros.mixed_model.equations import FactoredEquations

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
            scores[i] = Score(float(statistic[j]), int(rank[j]), float(p[j]),
                              estimate[j] / scale[at[j]], np.inf)
    return [scores[i] for i in range(len(choices))]


def satterthwaite_freedom(
    f: FactoredEquations, combination: Array, covariance: Array
) -> float:
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


def fit_out(
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
    part = columns[..., chosen]
    q = group_basis(group_fixed)
    flat = flat_rows(part - q @ (np.swapaxes(q, -1, -2) @ part))
    values, vectors = np.linalg.eigh(flat.T @ flat)
    kept = values > IDENTIFIABLE
    basis = np.zeros((columns.shape[-1], int(kept.sum())))
    basis[chosen] = vectors[:, kept] / np.sqrt(values[kept])
    return basis


def group_basis(columns: Array) -> Array:
    """Orthonormal bases (G, M, P) of each group's columns; zero columns where rank is missing."""
    scale = np.sqrt((columns**2).sum(axis=1, keepdims=True))
    u, s, _ = np.linalg.svd(columns / np.maximum(scale, 1e-300), full_matrices=False)
    return np.asarray(u * (s > 1e-9)[:, None, :])
