"""Variance components by restricted maximum likelihood.

Newton's method on the logarithms with the average information (Gilmour, Thompson, Cullis, Average
information REML, Biometrics 51 (1995)); where that does not help, the fixed point
tau_k^2 = b_k' b_k / gamma_k, with gamma_k the number of coefficients that the data determine
(MacKay, Bayesian interpolation, Neural Computation 4 (1992)).
Offsets of landmarks follow a t distribution, a normal one whose scale each landmark draws anew:
a few that are far off do not widen the bulk.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.diagnosis.mixed import Equations, Factored, factored
from fisheye_svp_ros.diagnosis.random_effects import NAMES
from fisheye_svp_ros.diagnosis.solution import Solution, posterior, solve

OF_LANDMARKS = np.array([name.startswith('landmark') for name in NAMES])  # components
FREEDOM = 3.0  # of the t distribution of landmarks' offsets
GONE = 1e12  # lambda of a component that is not there
_STEPS = 25
_TOLERANCE = 0.1  # of log lambda
_PACE = 1.4
_NOTHING = 3e-4  # of the noise variance: a component that adds less has vanished
_EVERYTHING = 1e8  # times the noise variance: no component adds more, whatever a fit says


@dataclass(frozen=True)
class Variances:
    """The variances of the null model.

    sigma: of the whitened noise; lam (components,): sigma^2 / tau^2, GONE for what has vanished;
    weight (L,): factors on the precision of each landmark's offset; covariance: of log tau^2 of
    all components and, last, log sigma^2.
    """

    sigma: float
    lam: Array
    weight: Array
    covariance: Array | None = None

    @property
    def alive(self) -> Mask:
        """Which components there are."""
        return np.asarray(self.lam < GONE)

    @property
    def tau(self) -> Array:
        """Standard deviation of each component's coefficients, 0 for what has vanished."""
        return np.where(self.alive, self.sigma / np.sqrt(self.lam), 0.0)

    @property
    def drawn_alike(self) -> Variances:
        """The same without a scale for each landmark: offsets are as large in the mean."""
        more = np.where(OF_LANDMARKS & self.alive, np.mean(1 / self.weight), 1.0)
        return replace(self, lam=self.lam / more, weight=np.ones_like(self.weight))


def nothing_random(landmarks: int) -> Variances:
    """Return variances without any random component."""
    return Variances(1.0, np.full(len(NAMES), GONE), np.ones(landmarks))


def start_variances(eq: Equations, share: float = 0.03) -> Variances:
    """Return variances with which every component adds a share of the noise."""
    squares = _sums(eq, np.diagonal(eq.blocks.ee, axis1=-2, axis2=-1), np.diag(eq.blocks.rr))
    lam = np.where(_counts(eq) > 0, squares / share / eq.rows, GONE)
    return Variances(1.0, np.maximum(lam, 1e-9), np.ones(len(eq.landmarks)))


def estimate(eq: Equations, start: Variances, steps: int = _STEPS) -> tuple[Variances, Equations]:
    """Find the variances; the border must be of full rank.

    A component whose variance runs to zero is switched off and stays so.  Returns the variances
    with their covariance, and the equations without what has vanished.
    """
    now, eq, f, solution = _stepped(eq, start, steps)
    information = average_information(f, solution)
    free = np.append(now.alive, True)
    covariance = np.zeros(information.shape)
    # A component on its way to nothing must not lend its uncertainty to all others.
    part = information[np.ix_(free, free)] + 0.01 * np.eye(int(free.sum()))
    covariance[np.ix_(free, free)] = np.linalg.inv(part)
    return replace(now, covariance=covariance), eq


def _stepped(
    eq: Equations, start: Variances, steps: int
) -> tuple[Variances, Equations, Factored, Solution]:
    """Return the variances after some steps, the equations, and what the last step solved."""
    now, eq, last = start, eq.trimmed(start.alive), np.inf
    floor = start_variances(eq, _EVERYTHING).lam
    for step in range(steps):
        now = replace(now, lam=np.maximum(now.lam, floor))
        f = factored(eq, now.lam, now.weight)
        solution = solve(f, posterior(f))
        near = step > 0 and solution.deviance < last + 1e-3 * eq.rows
        before, now, last = now, stepped(f, solution, now, near), solution.deviance
        if (now.alive != before.alive).any():
            eq, last = eq.trimmed(now.alive), np.inf
            continue
        moved = np.abs(np.log(now.lam / before.lam)[now.alive]).max(initial=0.0)
        shifted = np.abs(np.log(now.weight / before.weight)).mean() if len(now.weight) else 0.0
        if moved < _TOLERANCE and shifted < _TOLERANCE / 2:
            break
    return now, eq, f, solution


def stepped(f: Factored, solution: Solution, now: Variances, near: bool = False) -> Variances:
    """Return the variances after one step; near: by Newton's method, not the fixed point."""
    eq, alive = f.equations, now.alive
    size = f.shares(solution.e, solution.r) / solution.variance
    gamma = _determined(eq, f, solution)
    slope = np.where(alive, (size - gamma) / 2, 0.0)
    if near:
        change = _newton(f, solution, now, slope)
    else:
        fixed_point = np.log(np.maximum(size, 1e-9) / np.maximum(gamma, 1e-9)) * _PACE
        change = np.where(alive, np.clip(fixed_point, -2, 2), 0.0)
    lam = np.where(alive, now.lam * np.exp(-change), GONE)
    ceiling = start_variances(eq, _NOTHING).lam
    gone = (slope < 0) & ((lam > ceiling) | (gamma < 0.3))
    return Variances(float(np.sqrt(solution.variance)), np.where(gone, GONE, lam),
                     _landmark_weights(eq, now, solution))


def _newton(
    f: Factored, solution: Solution, now: Variances, slope: Array
) -> Array:
    """Return the change of log tau^2 (components,) by average information, noise profiled out."""
    information = average_information(f, solution)
    free = np.append(now.alive, True)
    change = np.zeros(len(free))
    part = information[np.ix_(free, free)]
    part = part + np.diag(1e-3 * np.diag(part) + 1e-9)
    change[free] = np.linalg.solve(part, np.append(slope, 0.0)[free])
    change = np.clip(change - change[-1], -3.0, 2.0)
    return np.asarray(change[:-1])


def average_information(f: Factored, solution: Solution) -> Array:
    """Return the average information (components + 1,)^2 on log tau^2 and, last, log sigma^2."""
    eq = f.equations
    b, count = eq.blocks, len(NAMES)
    kinds = np.arange(count)
    e = np.where((b.e_label[..., None] == kinds), solution.e[..., None], 0.0)
    r = np.where((b.r_label[:, None] == kinds), solution.r[:, None], 0.0)
    ge, gr, gx = eq.times(e, r)
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
    taken = f.taken(ge, gr, gx)
    return np.asarray((own - taken) / 2 / solution.variance)


def _counts(eq: Equations) -> Array:
    return _sums(eq, np.ones(eq.blocks.e_label.shape), np.ones(len(eq.blocks.r_label)))


def _sums(eq: Equations, e: Array, r: Array) -> Array:
    """Sum values (E, k), (R,) of coefficients by component."""
    label, values = eq.blocks.label, np.append(e, r)
    mine = label >= 0
    sums = np.bincount(label[mine], weights=values[mine], minlength=len(NAMES))
    return np.asarray(sums, dtype=float)


def _determined(eq: Equations, f: Factored, solution: Solution) -> Array:
    """Return how many coefficients of each component the data determine."""
    e, r = f.precision
    return _sums(eq, 1 - e * solution.spread_e, 1 - r * solution.spread_r)


def _landmark_weights(eq: Equations, now: Variances, solution: Solution) -> Array:
    """Return the expected precisions of landmarks' offsets (EM of the scale mixture)."""
    if not len(eq.landmarks):
        return now.weight
    label = _landmark_rows(eq, eq.blocks.e_label, eq.blocks.r_label)
    there = (label >= 0) & (now.lam[label] < GONE)
    offset = _landmark_rows(eq, solution.e, solution.r)
    spread = _landmark_rows(eq, solution.spread_e, solution.spread_r)
    lam = np.where(there, now.lam[label], 0.0)
    squares = (lam * (offset**2 / solution.variance + spread)).sum(axis=1)
    weight = np.ones_like(now.weight)
    weight[eq.landmarks] = (FREEDOM + there.sum(axis=1)) / (FREEDOM + squares)
    return weight


def _landmark_rows(eq: Equations, e: Any, r: Any) -> Any:
    return e if not eq.by_frame else r[len(r) - 3 * len(eq.landmarks) :].reshape(-1, 3)


def landmark_labels(eq: Equations) -> Index:
    """Return the components (L, 3) of landmarks' offsets."""
    return np.asarray(_landmark_rows(eq, eq.blocks.e_label, eq.blocks.r_label))


def without(now: Variances, name: str) -> Variances:
    """Return the variances with one component switched off."""
    lam = now.lam.copy()
    lam[NAMES.index(name)] = GONE
    return replace(now, lam=lam)
