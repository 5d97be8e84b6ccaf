"""Henderson's mixed-model equations, solved block by block.

All matrices are in units of the noise variance, so the prior precision of a random coefficient is
lambda = sigma^2 / tau^2.  A group's fixed and random coefficients make one block, the offsets of a
unit another; the larger of the two sets is eliminated in a batch, the rest is one dense matrix.
Both orders are needed: without the second, units by the thousand (a dense target) would be a dense
matrix of three times as many rows; without the first, so would groups by the hundred.
Source: Henderson, Best linear unbiased estimation and prediction under a selection model,
Biometrics 31 (1975); Searle, Casella, McCulloch, Variance Components (1992), chapter 7.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy import linalg

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.mixed_model.model_columns import (
    Blocks,
    Components,
    RandomColumns,
    arrange_blocks,
    multiply_columns,
)
from fisheye_svp_ros.mixed_model.threads import map_in_threads

FIXED, ABSENT = -1, -2  # labels: without a prior; not there
_RIDGE = 1e-10  # of normalized fixed columns of a group: some may be zero
_ABSENT_PRECISION = 1e12
_ROUNDING_RIDGE = 1e-5  # of a column's own information, where rounding makes the whole indefinite
LAMBDA_ABSENT = 1e12  # lambda of a component without variance


def solve_lower(root: Array, right: Array, trans: Literal[0, 1] = 0) -> Array:
    """Solve triangular equations; an empty system, which LAPACK of an older SciPy refuses, too."""
    if not len(root):
        return right
    return np.asarray(
        linalg.solve_triangular(root, right, lower=True, trans=trans, check_finite=False)
    )


def solve_upper(factor: Array, right: Array) -> Array:
    """Solve the equations of the transpose of a lower triangle."""
    return solve_lower(factor, right, trans=1)


def log_determinant(root: Array) -> float:
    """Return the log determinant of A = L L' from triangular matrices L (..., n, n)."""
    diagonal = np.abs(np.diagonal(root, axis1=-2, axis2=-1))
    return 2 * float(np.log(np.maximum(diagonal, 1e-300)).sum())


@dataclass(frozen=True)
class Variances:
    """The variances of a mixed model.

    sigma: standard deviation of the noise; lam (K,): sigma^2 / tau^2, LAMBDA_ABSENT for a
    component without variance; weight (U,): factors on the precision of each unit's offset;
    covariance: of log tau^2 of all components and, last, log sigma^2.
    """

    sigma: float
    lam: Array
    weight: Array
    covariance: Array | None = None

    @property
    def alive(self) -> Mask:
        """Which components have a variance."""
        return np.asarray(self.lam < LAMBDA_ABSENT)

    @property
    def tau(self) -> Array:
        """Standard deviation of each component's coefficients, 0 where it has no variance."""
        return np.where(self.alive, self.sigma / np.sqrt(self.lam), 0.0)

    def with_equal_weights(self, of_units: Mask) -> Variances:
        """Return the same without a scale for each unit: offsets are as large in the mean."""
        mean = np.mean(1 / self.weight) if len(self.weight) else 1.0
        more = np.where(of_units & self.alive, mean, 1.0)
        return replace(self, lam=self.lam / more, weight=np.ones_like(self.weight))

    def without_component(self, kind: int) -> Variances:
        """Return the variances with one component switched off."""
        lam = self.lam.copy()
        lam[kind] = LAMBDA_ABSENT
        return replace(self, lam=lam)


def no_variances(components: int, units: int) -> Variances:
    """Return the variances of a model without random effects."""
    return Variances(1.0, np.full(components, LAMBDA_ABSENT), np.ones(units))


class _Core(NamedTuple):
    """What a factorization has whatever its border: see `FactoredEquations`."""

    precision: tuple[Array, Array]
    inverse: Array
    coupled: Array
    factor: Array


@dataclass
class _Memory:
    """What was made last of the products of random columns, whatever the border.

    core: the factorization with the last precisions; selection: the components selected last,
    their products ee, er, rr, and what was made of these.
    """

    core: _Core | None = None
    selection: tuple[Mask, tuple[Array, Array, Array], _Memory] | None = None


@dataclass(frozen=True)
class Equations:
    """The mixed-model equations before any variance is known.

    by_group: whether groups are the eliminated blocks, or units; rows: numbers in y; group_rank:
    fixed coefficients of the groups; group_scale (G, P): norms that their fixed columns were
    divided by; width: coefficients of one group; units: those that have offsets,
    of unit_width coefficients each.
    """

    blocks: Blocks
    components: Components
    by_group: bool
    rows: int
    group_rank: int
    group_scale: Array
    width: int
    units: Index
    unit_width: int
    memory: _Memory = field(default_factory=_Memory, compare=False, repr=False)

    @property
    def label(self) -> Index:
        """Components (E k + R,) of all coefficients, blocks first."""
        return self.blocks.label

    def combine_columns(self, basis: Array) -> Equations:
        """Return the equations with combinations (X - 1, m) of the shared fixed columns."""
        full = linalg.block_diag(basis, np.eye(1))
        b = self.blocks
        blocks = b._replace(ex=b.ex @ full, rx=b.rx @ full, xx=full.T @ b.xx @ full)
        return replace(self, blocks=blocks)

    def find_present(self, alive: Mask) -> tuple[Mask, Mask, Mask]:
        """Return which blocks (E,), columns of them (k,) and of the rest (R,) there are.

        alive (K,): the components that are; a unit keeps all its places if it has any.
        """
        b, present = self.blocks, np.concatenate([alive, [False, True]])
        rest = present[b.r_label]
        if not self.by_group:
            width = np.ones(b.ee.shape[1], dtype=bool)
            return np.asarray(present[b.e_label].any(axis=1)), width, rest
        own = self.unit_rows(rest, rest)
        own[:] = own.any(axis=1, keepdims=True)
        return np.ones(len(b.ee), dtype=bool), present[b.e_label[0]], rest

    def select(self, alive: Mask) -> Equations:
        """Return the equations without the coefficients of some components."""
        b, present = self.blocks, np.concatenate([alive, [False, True]])
        blocks, e, r = self.find_present(alive)
        if all(part.all() for part in (present[b.e_label], present[b.r_label])):
            return self
        groups = len(self.group_scale)
        if self.by_group:
            width, units = int(e.sum()), self.unit_rows(r, r).any(axis=1)
        else:
            width, units = int(r[: groups * self.width].sum()) // groups, blocks
        products, memory = self._select_products(alive, blocks, e, r)
        chosen = Blocks(
            *products,
            b.ex[np.ix_(blocks, e)],
            b.rx[r],
            b.xx,
            np.where(present[b.e_label], b.e_label, ABSENT)[np.ix_(blocks, e)],
            np.where(present[b.r_label], b.r_label, ABSENT)[r],
        )
        return replace(self, blocks=chosen, width=width, units=self.units[units], memory=memory)

    def _select_products(
        self, alive: Mask, blocks: Mask, e: Mask, r: Mask
    ) -> tuple[tuple[Array, Array, Array], _Memory]:
        """Return ee, er, rr of some components, those of the last time if they are the same."""
        b, last = self.blocks, self.memory.selection
        if last is None or not np.array_equal(last[0], alive):
            chosen = (
                b.ee[np.ix_(blocks, e, e)],
                b.er[np.ix_(blocks, e, r)],
                b.rr[np.ix_(r, r)],
            )
            last = self.memory.selection = alive.copy(), chosen, _Memory()
        return last[1:]

    def free_component(self, kind: int) -> Equations:
        """Return the equations with a shared component before the fixed columns, no prior."""
        b, mine = self.blocks, self.blocks.r_label == kind
        blocks = Blocks(
            b.ee,
            b.er[..., ~mine],
            b.rr[np.ix_(~mine, ~mine)],
            np.concatenate([b.er[..., mine], b.ex], axis=-1),
            np.concatenate([b.rr[np.ix_(~mine, mine)], b.rx[~mine]], axis=-1),
            np.block([[b.rr[np.ix_(mine, mine)], b.rx[mine]], [b.rx[mine].T, b.xx]]),
            b.e_label,
            b.r_label[~mine],
        )
        return replace(self, blocks=blocks, memory=_Memory())

    def with_ridge(self, ridge: float) -> Equations:
        """Return the equations with a small prior precision of the shared fixed columns."""
        return self.add_products(np.diag(np.append(np.full(len(self.blocks.xx) - 1, ridge), 0.0)))

    def add_products(self, products: Array) -> Equations:
        """Return the equations with more products (X, X) of the border: of pseudo-observations."""
        return replace(self, blocks=self.blocks._replace(xx=self.blocks.xx + products))

    def multiply(self, e: Array, r: Array) -> tuple[Array, Array, Array]:
        """Multiply coefficients (E, k, C), (R, C): products with blocks, rest and border."""
        b = self.blocks
        flat = e.reshape(-1, e.shape[-1])
        return (
            b.ee @ e + b.er @ r,
            b.er.reshape(len(flat), len(r)).T @ flat + b.rr @ r,
            b.ex.reshape(len(flat), len(b.xx)).T @ flat + b.rx.T @ r,
        )

    def join(self, group: Array, unit: Array, shared: Array) -> tuple[Array, Array]:
        """Put what belongs to coefficients where they stand: e (E, k, C), r (R, C); see `split`.

        group (G, B, C), unit (U, w, C) of all units, shared (Q, C).
        """
        unit, count = unit[self.units], shared.shape[-1]
        if self.by_group:
            return group, np.concatenate([shared, unit.reshape(-1, count)])
        return unit, np.concatenate([group.reshape(-1, count), shared])

    def split(self, e: Array, r: Array) -> tuple[Array, Array, Array]:
        """Split coefficients (E, k, ...), (R, ...): by group (G, B, ...), by unit, shared."""
        if self.by_group:
            unit = self.unit_rows(e, r)
            return e, unit, r[: len(r) - unit.shape[0] * unit.shape[1]]
        count = len(self.group_scale) * self.width
        group = r[:count].reshape(len(self.group_scale), self.width, *r.shape[1:])
        return group, e, r[count:]

    def unit_rows(self, e: Any, r: Any) -> Any:
        """Return what of e (E, k, ...), r (R, ...) belongs to units (m, w, ...)."""
        if not self.by_group:
            return e
        count = len(self.units)
        return r[len(r) - self.unit_width * count :].reshape(count, self.unit_width, *r.shape[1:])


def make_equations(random: RandomColumns, group_fixed: Array, border: Array) -> Equations:
    """Multiply out the columns of a model.

    random: Z; group_fixed (G, M, P): fixed columns that each group has for itself; border
    (G, M, X): fixed columns that all share and, last, y.
    """
    scale = np.sqrt((group_fixed**2).sum(axis=1))
    scale = np.where(scale < 1e-9, np.inf, scale)
    products = multiply_columns(random, group_fixed / scale[:, None], border)
    (groups, fixed), width = scale.shape, products.gg.shape[-1]
    diagonal = np.arange(fixed)
    products.gg[:, diagonal, diagonal] += np.where(np.isfinite(scale), _RIDGE, 1.0)
    unit_label = np.where(random.unit_label < 0, ABSENT, random.unit_label)
    numerous = int(random.components.numerous[random.group_label].sum())
    by_group = groups * (width - numerous) >= unit_label.size
    group_label = np.concatenate([np.full(fixed, FIXED), random.group_label])
    blocks = arrange_blocks(
        products,
        np.broadcast_to(group_label, (groups, width)),
        unit_label,
        random.shared_label,
        by_group,
    )
    rows = int((group_fixed.any(axis=-1) | border.any(axis=-1)).sum())
    return Equations(
        blocks,
        random.components,
        by_group,
        rows,
        int(np.isfinite(scale).sum()),
        scale,
        width,
        np.arange(len(unit_label)),
        unit_label.shape[1],
    )


@dataclass(frozen=True)
class FactoredEquations:
    """The equations with given variances, factored.

    precision: priors e (E, k), r (R,); inverse (E, k, k): of the blocks' Cholesky factors; coupled
    (E, k, R), block_border (E, k, X), border (R, X): right-hand sides after their forward
    substitution; factor (R, R), lower; information (X, X): of the border, with everything else
    eliminated: its last row holds the score of the shared fixed columns.
    """

    equations: Equations
    precision: tuple[Array, Array]
    inverse: Array
    coupled: Array
    block_border: Array
    factor: Array
    border: Array
    information: Array

    @property
    def freedom(self) -> int:
        """Numbers in y less all fixed coefficients, shared ones and those of groups."""
        return self.equations.rows - self.equations.group_rank - len(self.information) + 1

    @property
    def products(self) -> float:
        """How many products of numbers another factorization takes."""
        return float(self.coupled.size * len(self.factor))

    @cached_property
    def root(self) -> Array:
        """Lower root of the information of the shared fixed columns.

        A direction that random columns have all but taken up has a small ridge.
        """
        info = self.information[:-1, :-1]
        try:
            return np.asarray(np.linalg.cholesky(info))
        except np.linalg.LinAlgError:
            return np.asarray(np.linalg.cholesky(info + _ROUNDING_RIDGE * np.diag(np.diag(info))))

    @cached_property
    def log_determinant(self) -> float:
        """Of the covariance of y over the noise variance, groups' fixed columns projected out."""
        e, r = self.precision
        priors = np.concatenate([e.ravel(), r])
        logs = log_determinant(self.factor) - log_determinant(self.inverse)
        return float(logs - np.log(priors[priors > 0]).sum())

    def select_border(self, at: Index) -> FactoredEquations:
        """Return the same with some of the border (m,)."""
        return replace(
            self,
            block_border=self.block_border[..., at],
            border=self.border[:, at],
            information=self.information[at[:, None], at],
        )

    def coefficients(self, combination: Array) -> tuple[Array, Array]:
        """Return the coefficients (E, k), (R,) predicted from a combination (X,) of the border."""
        r = solve_upper(self.factor, self.border @ combination)
        right = self.block_border @ combination - self.coupled @ r
        return (np.swapaxes(self.inverse, -1, -2) @ right[..., None])[..., 0], r

    def solve(self, e: Array, r: Array, x: Array) -> tuple[Array, Array, Array]:
        """Return the coefficients (E, k, C), (R, C), (X, C) of vectors with such products."""
        first, second, third = self._substitute(e, r, x)
        values = linalg.solve(self.information[:-1, :-1], third, assume_a='pos')
        rest = solve_upper(self.factor, second - self.border[:, :-1] @ values)
        right = first - self.block_border[..., :-1] @ values - self.coupled @ rest
        return np.swapaxes(self.inverse, -1, -2) @ right, rest, values

    def project(self, e: Array, r: Array, x: Array) -> Array:
        """Return v' A (A' A + D)^-1 A' v (C, C) of vectors v.

        e (E, k, C), r (R, C), x (X, C): their products with all columns A.
        """
        first, second, third = self._substitute(e, r, x)
        flat = first.reshape(-1, first.shape[-1])
        last = linalg.solve(self.information[:-1, :-1], third, assume_a='pos')
        return np.asarray(flat.T @ flat + second.T @ second + third.T @ last)

    def prior_squares(self, e: Array, r: Array) -> Array:
        """Return the squares of coefficients over their prior variances, by component (K,)."""
        label = self.equations.label
        squares = np.concatenate([(self.precision[0] * e**2).ravel(), self.precision[1] * r**2])
        random = label >= 0
        return np.asarray(
            np.bincount(
                label[random], weights=squares[random], minlength=self.equations.components.count
            ),
            dtype=float,
        )

    def _substitute(self, e: Array, r: Array, x: Array) -> tuple[Array, Array, Array]:
        """Return the right-hand sides (E, k, C), (R, C), (X, C) after forward substitution."""
        first = self.inverse @ e
        flat = first.reshape(-1, first.shape[-1])
        second = solve_lower(self.factor, r - self.coupled.reshape(len(flat), len(r)).T @ flat)
        border = self.block_border.reshape(len(flat), len(x) + 1)[:, :-1]
        return first, second, x - border.T @ flat - self.border[:, :-1].T @ second


def prior_precisions(eq: Equations, lam: Array, weight: Array) -> tuple[Array, Array]:
    """Return prior precisions (E, k), (R,); weight (U,): factors of each unit's."""
    table = np.concatenate([lam, [_ABSENT_PRECISION, 0.0]])  # by label: ABSENT (-2), FIXED (-1)
    e, r = table[eq.blocks.e_label], table[eq.blocks.r_label]
    if len(eq.units):
        unit = eq.unit_rows(e, r)
        unit *= weight[eq.units, None]
    return e, r


def factor_equations(eq: Equations, lam: Array, weight: Array) -> FactoredEquations:
    """Factor the equations; lam (K,): sigma^2 / tau^2 of each component; weight (U,): of units."""
    b = eq.blocks
    core = _factor_core(eq, *prior_precisions(eq, lam, weight))
    _, inverse, coupled, factor = core
    block_border = np.matmul(inverse, b.ex)
    flat = coupled.reshape(block_border.shape[0] * block_border.shape[1], len(b.rr))
    flat_border = block_border.reshape(len(flat), len(b.xx))
    cut = len(inverse) // 2 * inverse.shape[1]
    first, second = map_in_threads(
        lambda part: flat[part].T @ flat_border[part],
        (slice(cut), slice(cut, None)),
        flat.size * len(b.xx),
    )
    border = b.rx - (first + second)
    if len(factor):
        border = solve_lower(factor, border)
    information = b.xx - flat_border.T @ flat_border - border.T @ border
    return FactoredEquations(
        eq, core.precision, inverse, coupled, block_border, factor, border, information
    )


def _factor_core(eq: Equations, e: Array, r: Array) -> _Core:
    """Factor the equations of the random columns, precisions e (E, k), r (R,); or remember it."""
    known = eq.memory.core
    if known is not None and all(map(np.array_equal, known.precision, (e, r))):
        return known
    b, diagonal = eq.blocks, np.arange(eq.blocks.ee.shape[1])
    ee = b.ee.copy()
    ee[:, diagonal, diagonal] += e
    inverse, coupled = np.empty_like(ee), np.empty_like(b.er)

    def eliminate_blocks(part: slice) -> Array:
        inverse[part] = np.linalg.inv(np.linalg.cholesky(ee[part]))
        np.matmul(inverse[part], b.er[part], out=coupled[part])
        flat = coupled[part].reshape(e[part].size, len(b.rr))
        return np.asarray(flat.T @ flat)

    cut = len(e) // 2  # most of the time goes here
    rr, more = map_in_threads(
        eliminate_blocks, (slice(cut), slice(cut, None)), e.size * len(b.rr) ** 2
    )
    # In place: these may be as large as all else together.
    rr += more
    np.subtract(b.rr, rr, out=rr)
    rr[np.diag_indices_from(rr)] += r
    if len(rr):
        rr = linalg.cholesky(rr, lower=True, overwrite_a=True, check_finite=False)
    core = _Core((e, r), inverse, coupled, rr)
    eq.memory.core = core
    return core
