"""What the mixed-model equations say: of all coefficients, their spread, and without some."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import linalg

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.mixed import Factored, log_square, solve_lower, solve_upper


class Posterior(NamedTuple):
    """The covariance of all coefficients, over the noise variance.

    root (E k + R, C): root root' is that of all, blocks first, but for what each block (E, k, k)
    adds within itself.
    """

    block: Array
    root: Array

    @property
    def spread(self) -> tuple[Array, Array]:
        """Variances of the coefficients (E, k), (R,)."""
        own = np.diagonal(self.block, axis1=-2, axis2=-1)
        squares = np.einsum('ic,ic->i', self.root, self.root)
        return own + squares[: own.size].reshape(own.shape), squares[own.size :]


def random_roots(f: Factored) -> tuple[Array, Array]:
    """Return roots e (E k, R), r (R, R) of the covariance given the fixed columns.

    That of the rest is r r'; of the blocks it is e e' and, within each, inverse' inverse.
    """
    count, width, rest = f.coupled.shape
    flat = (np.swapaxes(f.inverse, -1, -2) @ f.coupled).reshape(count * width, rest)
    if not rest:
        return flat, np.zeros((0, 0))
    inverse = linalg.lapack.dtrtri(f.factor, lower=1)[0]
    return linalg.blas.dtrmm(-1.0, inverse, flat.T, lower=1).T, inverse.T


def posterior(f: Factored) -> Posterior:
    """Return the covariance of all coefficients; the border must be of full rank."""
    inverse_t = np.swapaxes(f.inverse, -1, -2)
    by_border = solve_upper(f.factor, f.border[:, :-1])
    bent = inverse_t @ (f.block_border[..., :-1] - f.coupled @ by_border)
    roots = [np.concatenate(random_roots(f))]
    if len(f.root):
        fixed = linalg.lapack.dtrtri(f.root, lower=1)[0].T
        both = np.concatenate([bent.reshape(-1, len(fixed)), by_border])
        roots.append(both @ fixed)
    return Posterior(inverse_t @ f.inverse, np.concatenate(roots, axis=1))


class Solution(NamedTuple):
    """What the equations say: of the fixed columns, the noise variance, every coefficient.

    values (X - 1,), variance, e (E, k), r (R,); deviance: -2 log restricted likelihood; spread_e
    (E, k), spread_r (R,): posterior variances of the coefficients over the noise variance, or
    empty.
    """

    values: Array
    variance: float
    e: Array
    r: Array
    deviance: float
    spread_e: Array
    spread_r: Array


def solve(f: Factored, known: Posterior | None = None) -> Solution:
    """Solve for all coefficients; the border must be of full rank.

    known: their posterior, for their spread.
    """
    root, gradient = f.root, f.information[:-1, -1]
    half = solve_lower(root, gradient)
    values = solve_lower(root, half, trans=1)
    freedom = f.freedom
    variance = float(f.information[-1, -1] - half @ half) / max(freedom, 1)
    e, r = f.coefficients(np.append(-values, 1.0))
    spread = (np.zeros(0), np.zeros(0)) if known is None else known.spread
    return Solution(values, variance, e, r, _deviance(f, freedom, variance), *spread)


def ratio_without(f: Factored, solution: Solution, known: Posterior, kind: int) -> float:
    """Return by how much the deviance rises without a component, all other variances as they are.

    Of posterior mean b and covariance S of its coefficients: what is left grows by b' inv(S) b,
    the determinant by that of S.
    """
    mine = np.flatnonzero(f.equations.blocks.label == kind)
    values, prior = (np.append(e, r)[mine] for e, r in ((solution.e, solution.r), f.precision))
    half, logs = _whitened(known, mine, values)
    growth = np.log1p(half / solution.variance / max(f.freedom, 1))
    return float(f.freedom * growth + logs + np.log(prior).sum())


def _whitened(known: Posterior, mine: Index, values: Array) -> tuple[float, float]:
    """Return b' inv(S) b of coefficients (n,), by place, and the log determinant of S.

    S = D + r r' with D in blocks; of many small blocks nothing so large as S itself is made.
    """
    root, (count, width, _) = known.root[mine], known.block.shape
    if mine[0] >= count * width:
        return _squared(linalg.cholesky(root @ root.T, lower=True), values)
    block, column = (part.reshape(len(np.unique(mine // width)), -1)
                     for part in np.divmod(mine, width))
    own = np.asarray(np.linalg.cholesky(
        known.block[block[:, :, None], column[:, :, None], column[:, None]]))
    split = np.column_stack([root, values]).reshape(*block.shape, -1)
    both = np.linalg.solve(own, split).reshape(len(mine), -1)
    root, values = both[:, :-1], both[:, -1]
    if len(root) <= root.shape[1]:
        whole = linalg.cholesky(root @ root.T + np.eye(len(root)), lower=True)
        square, logs = _squared(whole, values)
    else:
        inside = linalg.cholesky(root.T @ root + np.eye(root.shape[1]), lower=True)
        less, logs = _squared(inside, root.T @ values)
        square = float(values @ values) - less
    return square, logs + log_square(own)


def _squared(root: Array, values: Array) -> tuple[float, float]:
    """Return b' inv(S) b and the log determinant of S, from its lower root."""
    half = solve_lower(root, values)
    return float(half @ half), log_square(root)


def without(f: Factored, solution: Solution, known: Posterior, kind: int) -> Solution:
    """Return what the equations say without a component of the rest, given what they say with it.

    Its coefficients are held at nothing, the precisions of the others as they are.
    """
    ratio, count = ratio_without(f, solution, known, kind), solution.e.size
    mine = count + np.flatnonzero(f.equations.blocks.r_label == kind)
    root = linalg.cholesky(known.root[mine] @ known.root[mine].T, lower=True)
    half = solve_lower(root, solution.r[mine - count])
    steps = solve_lower(root, known.root[mine] @ known.root.T)
    moved, less, shape = half @ steps, (steps**2).sum(axis=0), solution.e.shape
    return solution._replace(
        variance=solution.variance + float(half @ half) / max(f.freedom, 1),
        deviance=solution.deviance + ratio,
        e=solution.e - moved[:count].reshape(shape), r=solution.r - moved[count:],
        spread_e=solution.spread_e - less[:count].reshape(shape),
        spread_r=solution.spread_r - less[count:],
    )


def _deviance(f: Factored, freedom: int, variance: float) -> float:
    """Return -2 log restricted likelihood, the noise variance profiled out."""
    logs = f.log_determinant + log_square(f.root)
    return float(freedom * np.log(max(variance, 1e-300)) + logs)
