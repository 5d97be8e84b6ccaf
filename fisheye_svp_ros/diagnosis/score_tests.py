"""Score tests of variances at zero: which random components the data could call for."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import special

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.diagnosis.mixed import Equations, Factored, factored, solve_lower
from fisheye_svp_ros.diagnosis.random_effects import NAMES
from fisheye_svp_ros.diagnosis.reml import GONE, Variances
from fisheye_svp_ros.diagnosis.solution import Solution, solve


def score_components(eq: Equations, now: Variances, names: list[str]) -> dict[str, float]:
    """Return p-values of variances at zero, for components that the data could hold.

    The sum of squares of the columns' products with the residual against a gamma distribution of
    the same mean and variance.  Source: Lin, Variance component testing in generalised linear
    models with random effects, Biometrika 84 (1997).
    """
    f = factored(eq.trimmed(now.alive), now.lam, now.weight)
    solution = solve(f)
    found = {}
    for name in names:
        columns = _columns(eq, now.alive, NAMES.index(name))
        if columns is None:
            continue
        size = float((_pull(columns, solution) ** 2).sum()) / solution.variance
        remaining = _remaining(f, columns, True)
        mean, spread = remaining.trace, 2 * remaining.squares
        if mean > 1e-9 and spread > 0:
            found[name] = float(special.gammaincc(mean**2 / spread, size * mean / spread))
    return found


def component_traces(eq: Equations, now: Variances) -> dict[str, float]:
    """Return what each component that is there adds per unit of its variance, poses out.

    Sums of squares of its columns once poses are projected out, landmarks by their weights.
    """
    nothing = np.full(len(NAMES), GONE)
    f = factored(eq.trimmed(nothing < GONE), nothing, now.weight)
    found = {}
    for name, there in zip(NAMES, now.alive, strict=True):
        columns = _columns(eq, nothing < GONE, NAMES.index(name))
        if there and columns is not None:
            found[name] = _remaining(f, columns, False).trace
    return found


class _Columns(NamedTuple):
    """Products of a component's g groups of w columns with each other and with all that is there.

    own (g, w, w): within the groups, between which there are none; e (b, k, w): with the blocks
    `at` (b,), -1 for one that is not there: of several groups with a block each, of one with all;
    r (R, g, w): with the rest; x (X, g, w): with the border.
    """

    own: Array
    at: Index
    e: Array
    r: Array
    x: Array


class _Remaining(NamedTuple):
    """The information of columns beside others: block (g, w, w) less u' u, u (C, g, w)."""

    block: Array
    u: Array

    @property
    def trace(self) -> float:
        return float(np.einsum('gww->', self.block) - (self.u**2).sum())

    @property
    def squares(self) -> float:
        """The sum of the squares of all its elements."""
        u = self.u.reshape(len(self.u), self.block.shape[0] * self.block.shape[1])
        both = u @ u.T if u.shape[0] < u.shape[1] else u.T @ u
        across = np.moveaxis(self.u, 1, 0) @ self.block
        mixed = np.einsum('gcw,cgw->', across, self.u)
        return float((self.block**2).sum() - 2 * mixed + (both**2).sum())


def _columns(eq: Equations, alive: Mask, kind: int) -> _Columns | None:
    b = eq.blocks
    keep, columns, rest = eq.kept(alive)
    in_r = np.flatnonzero(b.r_label == kind)
    if len(in_r):
        return _Columns(
            b.rr[np.ix_(in_r, in_r)][None], np.arange(int(keep.sum())),
            b.er[keep][:, columns][..., in_r], b.rr[np.ix_(rest, in_r)][:, None],
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
    return _Columns(own, place[block], e, np.moveaxis(r, -1, 0), np.moveaxis(x, -1, 0))


def _pull(c: _Columns, solution: Solution) -> Array:
    """Return the products (g, w) of columns with what is left of the residual."""
    there, change = c.at >= 0, np.append(-solution.values, 1.0)
    pull = np.tensordot(change, c.x, 1) - np.tensordot(solution.r, c.r, 1)
    by_blocks = np.einsum('bkw,bk->bw', c.e[there], solution.e[c.at[there]])
    if len(c.own) > 1:
        pull[there] -= by_blocks
    else:
        pull -= by_blocks.sum(axis=0)
    return np.asarray(pull)


def _remaining(f: Factored, c: _Columns, fixed: bool) -> _Remaining:
    """Return the information of columns beside all that is there; fixed: the border's, too."""
    there, (groups, width, _) = c.at >= 0, c.own.shape
    first = f.inverse[c.at[there]] @ c.e[there]

    def common(part: Array) -> Array:
        """Return the products (C, g, w) of coefficients (b, k, C) with the columns."""
        if groups == 1:
            flat = first.reshape(first.size // width, width)
            return (part.reshape(len(flat), part.shape[-1]).T @ flat)[:, None]
        products = np.zeros((part.shape[-1], groups, width))
        products[:, there] = np.moveaxis(np.swapaxes(part, -1, -2) @ first, 1, 0)
        return products

    block = c.own.copy()
    if groups > 1:
        block[there] -= np.swapaxes(first, -1, -2) @ first
    else:
        block -= common(first)[:, 0]
    at = c.at[there]
    r = c.r - common(f.coupled[at])
    u = solve_lower(f.factor, r.reshape(len(r), groups * width))
    if fixed:
        x = c.x[:-1] - common(f.block_border[at, :, :-1])
        flat = x.reshape(len(x), groups * width) - f.border[:, :-1].T @ u
        u = np.concatenate([u, solve_lower(f.root, flat)])
    return _Remaining(block, u.reshape(len(u), groups, width))
