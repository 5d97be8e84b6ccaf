"""Solutions of the mixed-model equations: BLUE, BLUP, their covariance, and groups left out.

Best linear unbiased estimates of fixed and predictions of random coefficients (Henderson 1975).
Every group left out one by one follows, exactly, from the one factorization of all groups: with
P = V^-1 - V^-1 X (X' V^-1 X)^-1 X' V^-1 of fixed columns X of groups and covariance V, what the
others leave of columns c in group g is inv(P_gg) (P c)_g, and the information that goes with the
group is (P c)_g' inv(P_gg) (P c)_g.
Source: Cook and Weisberg, Residuals and Influence in Regression (1982), for blocks of rows.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from scipy import linalg

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.mixed_model.equations import (
    Equations,
    FactoredEquations,
    log_determinant,
    solve_lower,
    solve_upper,
)
from fisheye_svp_ros.mixed_model.model_columns import RandomColumns, combine_offsets, group_basis
from fisheye_svp_ros.mixed_model.threads import map_in_threads, run_in_threads

_COLUMNS = 128  # of a triangle at a time: few of its zeros are multiplied


class Posterior(NamedTuple):
    """The covariance of all coefficients, over the noise variance.

    root (E k + R, C): root root' is that of all, blocks first, but for what each block (E, k, k)
    adds within itself; shared (X - 1, C): the same of the shared fixed coefficients.
    """

    block: Array
    root: Array
    shared: Array

    @property
    def variances(self) -> tuple[Array, Array]:
        """Variances of the coefficients (E, k), (R,)."""
        own, squares = np.diagonal(self.block, axis1=-2, axis2=-1), _row_squares(self.root)
        return own + squares[: own.size].reshape(own.shape), squares[own.size :]


def covariance_roots(f: FactoredEquations) -> tuple[Array, Array]:
    """Return roots e (E k, R), r (R, R) of the covariance given the shared fixed columns.

    That of the rest is r r'; of the blocks it is e e' and, within each, inverse' inverse.
    """
    count, width, rest = f.coupled.shape
    flat = (np.swapaxes(f.inverse, -1, -2) @ f.coupled).reshape(count * width, rest)
    if not rest:
        return flat, np.zeros((0, 0))
    inverse = linalg.lapack.dtrtri(f.factor, lower=1)[0]
    return linalg.blas.dtrmm(-1.0, inverse, flat.T, lower=1).T, inverse.T


def posterior_covariance(f: FactoredEquations) -> Posterior:
    """Return the covariance of all coefficients; the border must be of full rank."""
    inverse_t = np.swapaxes(f.inverse, -1, -2)
    size, rest, count = f.precision[0].size, len(f.factor), len(f.root)
    root, shared = np.empty((size + rest, rest + count)), np.zeros((count, rest + count))
    root[:size, :rest], root[size:, :rest] = covariance_roots(f)
    root[:size, rest:], root[size:, rest:], fixed = _roots_of_fixed(f)
    # What fixed columns take up, random ones lose.
    shared[:, rest:] = -fixed
    return Posterior(inverse_t @ f.inverse, root, shared)


def posterior_variances(f: FactoredEquations) -> tuple[Array, Array]:
    """Return the variances (E, k), (R,) of all coefficients, over the noise variance.

    As `posterior_covariance` has them, without a root as large as all of it.
    """
    (count, width, rest), inverse_t = f.coupled.shape, np.swapaxes(f.inverse, -1, -2)
    flat = (inverse_t @ f.coupled).reshape(count * width, rest)
    inverse = linalg.lapack.dtrtri(f.factor, lower=1)[0] if rest else f.factor

    def sum_squares(part: slice) -> Array:
        """Return the squares of flat inverse', summed over a part of the columns."""
        return _row_squares(flat[:, : part.stop] @ inverse[part, : part.stop].T)

    starts = range(0, rest, _COLUMNS)[::-1]  # the largest first
    parts = [partial(sum_squares, slice(at, min(at + _COLUMNS, rest))) for at in starts]
    (by_block, by_rest, _), *sums = run_in_threads(
        partial(_roots_of_fixed, f), *parts, products=f.products
    )
    e = _row_squares(by_block) + sum(sums, np.zeros(count * width))
    own = np.einsum('ekj,ekj->ej', f.inverse, f.inverse)
    return own + e.reshape(count, width), _row_squares(inverse.T) + _row_squares(by_rest)


def _row_squares(root: Array) -> Array:
    return np.asarray(np.einsum('ic,ic->i', root, root))


def _roots_of_fixed(f: FactoredEquations) -> tuple[Array, Array, Array]:
    """Return what shared fixed columns add to roots e (E k, X - 1), r (R, X - 1), and their own.

    The border must be of full rank.
    """
    fixed = linalg.lapack.dtrtri(f.root, lower=1)[0].T if len(f.root) else f.root
    by_border = solve_upper(f.factor, f.border[:, :-1] @ fixed)
    (count, width, rest), columns = f.coupled.shape, len(fixed)
    # One large product each, not one for every block.
    by_block = f.block_border.reshape(count * width, columns + 1)[:, :-1] @ fixed
    by_block -= f.coupled.reshape(count * width, rest) @ by_border
    by_block = np.swapaxes(f.inverse, -1, -2) @ by_block.reshape(count, width, columns)
    return by_block.reshape(count * width, columns), by_border, fixed


def unit_covariances(f: FactoredEquations) -> Array:
    """Return the posterior covariances (m, w, w) of units' offsets over the noise variance."""
    eq = f.equations
    size = eq.unit_width * len(eq.units)
    by_block, by_rest, _ = _roots_of_fixed(f)
    if eq.by_group:
        unit = np.zeros((len(f.factor), size))
        unit[-size:] = np.eye(size)
        through, fixed = solve_lower(f.factor, unit), by_rest[-size:]
        own = np.zeros((len(eq.units), eq.unit_width, eq.unit_width))
    else:
        back = np.swapaxes(f.inverse, -1, -2)
        through = solve_lower(f.factor, (back @ f.coupled).reshape(size, -1).T)
        own, fixed = back @ f.inverse, by_block
    return np.asarray(own + _unit_products(through, eq) + _unit_products(fixed.T, eq))


def _unit_products(columns: Array, eq: Equations) -> Array:
    """Return the products (m, w, w) of each unit's columns (R, m w) with each other."""
    by_unit = columns.reshape(-1, len(eq.units), eq.unit_width)
    return np.asarray(np.einsum('rla,rlb->lab', by_unit, by_unit))


class Solution(NamedTuple):
    """Estimates: of the shared fixed columns, the noise variance, every coefficient.

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


def solve_equations(f: FactoredEquations, spread: tuple[Array, Array] | None = None) -> Solution:
    """Solve for all coefficients; the border must be of full rank.

    spread: their variances, where the solution is to have them.
    """
    root, gradient = f.root, f.information[:-1, -1]
    half = solve_lower(root, gradient)
    values = solve_lower(root, half, trans=1)
    freedom = f.freedom
    variance = float(f.information[-1, -1] - half @ half) / max(freedom, 1)
    e, r = f.coefficients(np.append(-values, 1.0))
    logs = f.log_determinant + log_determinant(root)
    # The noise variance is profiled out.
    deviance = float(freedom * np.log(max(variance, 1e-300)) + logs)
    return Solution(values, variance, e, r, deviance, *(spread or (np.zeros(0), np.zeros(0))))


def deviance_without(
    f: FactoredEquations, solution: Solution, posterior: Posterior, kind: int
) -> float:
    """Return by how much the deviance rises without a component, all other variances as they are.

    Of posterior mean b and covariance S of its coefficients: what is left grows by b' inv(S) b,
    the determinant by that of S.
    """
    mine = np.flatnonzero(f.equations.label == kind)
    values, prior = (np.append(e, r)[mine] for e, r in ((solution.e, solution.r), f.precision))
    half, logs = _whiten_coefficients(posterior, mine, values)
    growth = np.log1p(half / solution.variance / max(f.freedom, 1))
    return float(f.freedom * growth + logs + np.log(prior).sum())


def _whiten_coefficients(posterior: Posterior, mine: Index, values: Array) -> tuple[float, float]:
    """Return b' inv(S) b of coefficients (n,), by place, and the log determinant of S.

    S = D + r r' with D in blocks; of many small blocks nothing so large as S itself is made.
    """
    root, (count, width, _) = posterior.root[mine], posterior.block.shape
    if mine[0] >= count * width:
        return _whiten(linalg.cholesky(root @ root.T, lower=True), values)
    block, column = (
        part.reshape(len(np.unique(mine // width)), -1) for part in np.divmod(mine, width)
    )
    own = np.asarray(
        np.linalg.cholesky(posterior.block[block[:, :, None], column[:, :, None], column[:, None]])
    )
    split = np.column_stack([root, values]).reshape(*block.shape, -1)
    both = np.linalg.solve(own, split).reshape(len(mine), -1)
    root, values = both[:, :-1], both[:, -1]
    if len(root) <= root.shape[1]:
        whole = linalg.cholesky(root @ root.T + np.eye(len(root)), lower=True)
        square, logs = _whiten(whole, values)
    else:
        inside = linalg.cholesky(root.T @ root + np.eye(root.shape[1]), lower=True)
        less, logs = _whiten(inside, root.T @ values)
        square = float(values @ values) - less
    return square, logs + log_determinant(own)


def _whiten(root: Array, values: Array) -> tuple[float, float]:
    """Return b' inv(S) b and the log determinant of S, from its lower root."""
    half = solve_lower(root, values)
    return float(half @ half), log_determinant(root)


def solution_without(
    f: FactoredEquations, solution: Solution, posterior: Posterior, kind: int
) -> Solution:
    """Return the solution without a shared component, given the one with it.

    Its coefficients are held at zero, the precisions of the others as they are.
    """
    ratio, count = deviance_without(f, solution, posterior, kind), solution.e.size
    mine = count + np.flatnonzero(f.equations.blocks.r_label == kind)
    root = linalg.cholesky(posterior.root[mine] @ posterior.root[mine].T, lower=True)
    half = solve_lower(root, solution.r[mine - count])
    steps = solve_lower(root, posterior.root[mine] @ posterior.root.T)
    change, less, shape = half @ steps, (steps**2).sum(axis=0), solution.e.shape
    return solution._replace(
        variance=solution.variance + float(half @ half) / max(f.freedom, 1),
        deviance=solution.deviance + ratio,
        e=solution.e - change[:count].reshape(shape),
        r=solution.r - change[count:],
        spread_e=solution.spread_e - less[:count].reshape(shape),
        spread_r=solution.spread_r - less[count:],
    )


class LeaveOneOut(NamedTuple):
    """Each group, seen from all the others.

    information (G, X, X): of the border, that the group brings, in units of 1 / noise variance;
    rows (G, M, X): what is left of the border once the others have predicted units' offsets and
    shared columns, and the group has fitted its own fixed columns; fields (G, M, X): what the
    others predict by the columns of all groups alone (`RandomColumns.shared`).
    """

    information: Array
    rows: Array
    fields: Array

    def select(self, at: Index) -> LeaveOneOut:
        """Return the same of some of the border (m,)."""
        return LeaveOneOut(
            self.information[:, at[:, None], at], self.rows[..., at], self.fields[..., at]
        )


def leave_groups_out(
    f: FactoredEquations, random: RandomColumns, group_fixed: Array, border: Array
) -> LeaveOneOut:
    """Leave out every group, one at a time.

    random: columns of the components in the factored equations; group_fixed (G, M, P) and border
    (G, M, X): the columns that these were made of.
    """
    eq, (e, r) = f.equations, covariance_roots(f)
    # Roots of the covariance of the coefficients and, given the border, their predictions.
    e, r = (np.concatenate([root, root @ f.border], axis=1) for root in (e, r))
    group, unit, shared = eq.split(e.reshape(*f.coupled.shape[:2], r.shape[1]), r)
    roots = group, combine_offsets(random, unit, shared, eq.units), shared
    found = LeaveOneOut(
        np.empty((len(border), *f.information.shape)), np.zeros_like(border), np.zeros_like(border)
    )

    def leave_out(group: int) -> None:
        remaining = _leave_out(f, roots, random, group, group_fixed[group], border[group], found)
        np.matmul(remaining.T, found.rows[group], out=found.information[group])

    map_in_threads(leave_out, range(len(border)), border.size * len(f.factor))
    return found


def _leave_out(
    f: FactoredEquations,
    roots: tuple[Array, Array, Array],
    random: RandomColumns,
    group: int,
    fixed: Array,
    border: Array,
    left_out: LeaveOneOut,
) -> Array:
    """Write what the others leave of a group's rows (M, X); return it before inv(P_gg), as wide.

    roots: of the covariance and the predictions given the border: by group, by unit with what
    fields add to it, shared; left_out: where rows and fields of the group are written.
    """
    used = np.flatnonzero(np.abs(fixed).sum(axis=1) + np.abs(border).sum(axis=1))
    height, found = len(fixed), np.zeros_like(border)
    own = np.concatenate(
        [fixed[used] / f.equations.group_scale[group], random.group[group][used]], axis=1
    )
    by_group, by_unit, by_all = roots
    shared = random.shared[group * height + used]
    fields = shared @ by_all[: shared.shape[1]]
    both = own @ by_group[group] + fields
    unit = random.unit[group]
    known = np.flatnonzero(unit >= 0)
    moved = np.zeros((*random.offset.shape[1:3], both.shape[1]))
    moved[known] = random.offset[group, known] @ by_unit[unit[known]]
    both += moved.reshape(height, -1)[used]
    unit, offset = _unit_rows(f.equations, random, group)
    root, predicted = np.split(both, [len(f.factor)], axis=1)
    rows_of_unit, width = np.repeat(unit, offset.shape[1])[used], offset.shape[2]
    inside, at_border = _eliminated_products(
        f, group, own, rows_of_unit, offset.reshape(height, width)[used]
    )
    # P of this group's rows, and P border
    p = root @ root.T
    p += inside
    np.negative(p, out=p)
    p[np.diag_indices_from(p)] += 1.0
    remaining = border[used] - at_border - predicted
    (basis,) = group_basis(fixed[None, used])
    remaining -= basis @ (basis.T @ remaining)
    p += basis @ basis.T
    left, found[used] = np.linalg.solve(p, remaining), remaining
    left_out.rows[group, used] = left
    if shared.shape[1]:  # what the group itself adds to the prediction by all is taken away
        by_root, by_border = np.split(fields, [len(f.factor)], axis=1)
        left_out.fields[group, used] = by_border - by_root @ (root.T @ left)
    return found


def _unit_rows(eq: Equations, random: RandomColumns, group: int) -> tuple[Index, Array]:
    """Return a group's units (N,) in the equations and their columns (N, p, w) or zero."""
    order = np.full(len(random.unit_label) + 1, -1)
    present = np.zeros((len(order), random.unit_label.shape[1]), dtype=bool)
    order[eq.units] = np.arange(len(eq.units))
    present[eq.units] = random.unit_label[eq.units] >= 0
    unit = random.unit[group]
    return order[unit], np.where(present[unit][:, None], random.offset[group], 0.0)


def _eliminated_products(
    f: FactoredEquations, group: int, own: Array, unit: Index, offset: Array
) -> tuple[Array, Array]:
    """Return what the eliminated blocks take from a group's rows (m, m) and border (m, X)."""
    if f.equations.by_group:
        first = f.inverse[group] @ own.T
        return first.T @ first, first.T @ f.block_border[group]
    if not len(f.equations.units):
        return np.zeros((len(own), len(own))), np.zeros((len(own), f.border.shape[1]))
    step = (f.inverse[unit] @ offset[..., None])[..., 0]
    same = unit[:, None] == unit
    return (
        np.where(same, step @ step.T, 0.0),
        np.einsum('mi,mix->mx', step, f.block_border[unit]),
    )
