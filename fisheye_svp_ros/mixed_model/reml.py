"""Variance components by restricted maximum likelihood (REML).

Newton's method on the logarithms with the average information (Gilmour, Thompson, Cullis, Average
information REML, Biometrics 51 (1995)); where that does not help, the fixed point
tau_k^2 = b_k' b_k / gamma_k, with gamma_k the number of coefficients that the data determine
(Searle, Casella, McCulloch, Variance Components (1992), section 7.6; MacKay, Bayesian
interpolation, Neural Computation 4 (1992)).  Rao's MINQUE (1971) is its first step.
Offsets of units follow a t distribution, a normal one whose scale each unit draws anew: a few that
are far off do not widen the bulk.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.mixed_model.equations import Equations, FactoredEquations, factor_equations
from fisheye_svp_ros.mixed_model.solution import Solution, posterior_variances, solve_equations

T_FREEDOM = 3.0  # of the t distribution of units' offsets
LAMBDA_ABSENT = 1e12  # lambda of a component without variance
_MAX_STEPS = 25
_TOLERANCE = 0.1  # of log lambda
_OVERRELAXATION = 1.4
_VANISHING_SHARE = 3e-4  # of the noise variance: a component that adds less has vanished
_MAX_SHARE = 1e8  # times the noise variance: no component adds more, whatever a fit says


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
        more = np.where(of_units & self.alive, np.mean(1 / self.weight), 1.0)
        return replace(self, lam=self.lam / more, weight=np.ones_like(self.weight))

    def without_component(self, kind: int) -> Variances:
        """Return the variances with one component switched off."""
        lam = self.lam.copy()
        lam[kind] = LAMBDA_ABSENT
        return replace(self, lam=lam)


def no_variances(components: int, units: int) -> Variances:
    """Return the variances of a model without random effects."""
    return Variances(1.0, np.full(components, LAMBDA_ABSENT), np.ones(units))


def initial_variances(eq: Equations, share: float = 0.03) -> Variances:
    """Return variances with which every component adds a share of the noise."""
    squares = _sum_by_component(
        eq, np.diagonal(eq.blocks.ee, axis1=-2, axis2=-1), np.diag(eq.blocks.rr))
    counts = _sum_by_component(
        eq, np.ones(eq.blocks.e_label.shape), np.ones(len(eq.blocks.r_label)))
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
    return Variances(float(np.sqrt(solution.variance)), np.where(vanished, LAMBDA_ABSENT, lam),
                     _unit_weights(eq, now, solution))


def _newton_step(
    f: FactoredEquations, solution: Solution, now: Variances, slope: Array
) -> Array:
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
