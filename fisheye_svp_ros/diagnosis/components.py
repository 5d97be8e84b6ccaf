"""Which random components the data call for: score tests of variances at zero, and REML."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import special

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.diagnosis.mixed import Equations, Factored, factored
from fisheye_svp_ros.diagnosis.random_effects import NAMES
from fisheye_svp_ros.diagnosis.reml import (
    GONE,
    Variances,
    estimate,
    nothing_random,
    start_variances,
    stepped,
    without,
)
from fisheye_svp_ros.diagnosis.solution import Posterior, Solution, posterior, ratio_without, solve
from fisheye_svp_ros.diagnosis.solution import without as solution_without

_Whole = tuple[Factored, Solution, Posterior]

_CALLED, _CALLED_LATE = 0.3, 0.01
_LATE = ('frame_bumps', 'image_finest')  # many coefficients: asked once the others are there
_SHARE = 0.02
_CHANCE = 0.05
_HARDLY = 0.3  # standard error of log tau^2
_WARM = 6  # steps from the variances of a similar state
_DOUBTFUL = (2.7, 25.0)  # likelihood ratios between which the other variances are found anew


def find_variances(eq: Equations, before: Variances | None = None) -> Variances:
    """Return the variances of the components that the data call for.

    eq: with the whole catalogue free in its border, of full rank, or a real effect would widen
    the component that resembles it; before: variances of a similar state to start from.
    """
    first = start_variances(eq, _SHARE)
    if before is None:
        nothing = nothing_random(len(first.weight))
        p = score_components(eq, nothing, [n for n in NAMES if n not in _LATE])
        lam = np.array([first.lam[i] if p.get(n, 1.0) < _CALLED else GONE
                        for i, n in enumerate(NAMES)])
        now = Variances(1.0, lam, first.weight)
        now, _ = estimate(eq, now)
    else:
        now, _ = estimate(eq, before, _WARM)
    # What the data do not call for beside large misfits they may call for beside smaller ones.
    missing = [n for n in NAMES if not now.alive[NAMES.index(n)]]
    p = score_components(eq, now, missing) if missing else {}
    lam = now.lam.copy()
    for name in missing:
        if p.get(name, 1.0) < _CALLED_LATE:
            lam[NAMES.index(name)] = first.lam[NAMES.index(name)]
    if (lam < GONE).sum() > now.alive.sum():
        now, _ = estimate(eq, Variances(now.sigma, lam, now.weight))
    return _without_chance(eq.trimmed(now.alive), now)


def called(eq: Equations, now: Variances, name: str) -> bool:
    """Return whether the data call for one more component beside those that are there."""
    return score_components(eq, now, [name]).get(name, 1.0) < _CALLED_LATE


def _without_chance(eq: Equations, now: Variances) -> Variances:
    """Switch off what may as well be chance: a variance hardly known makes every test unsure.

    One at a time: two that do the same are each dispensable, but not both.
    """
    while doubtful := _hardly_known(now):
        whole = _whole(eq, now)
        ratios = _ratios(now, whole, doubtful)
        if _chance(min(ratios.values())) <= _CHANCE:
            ratios = _followed(eq, now, whole, ratios)
        name = min(ratios, key=ratios.__getitem__)
        if _chance(ratios[name]) <= _CHANCE:
            break
        now, eq = estimate(eq, without(now, name), _WARM)
    return now


def _hardly_known(now: Variances) -> list[str]:
    """Return the components whose variance is not known well enough to be beyond doubt."""
    assert now.covariance is not None
    spread = np.sqrt(np.diag(now.covariance)[:-1])
    return [name for name, there, sd in zip(NAMES, now.alive, spread, strict=True)
            if there and sd > _HARDLY]


def score_components(eq: Equations, now: Variances, names: list[str]) -> dict[str, float]:
    """Return p-values of variances at zero, for components that the data could hold.

    The sum of squares of the columns' products with the residual against a gamma distribution of
    the same mean and variance.  Source: Lin, Variance component testing in generalised linear
    models with random effects, Biometrika 84 (1997).
    """
    f = factored(eq.trimmed(now.alive), now.lam, now.weight)
    solution = solve(f)
    change = np.append(-solution.values, 1.0)
    found = {}
    for name in names:
        products = _products(eq, now, NAMES.index(name))
        if products is None:
            continue
        own, ge, gr, gx = products
        pull = gx.T @ change - np.einsum('ekc,ek->c', ge, solution.e) - gr.T @ solution.r
        remaining = own - f.taken(ge, gr, gx[:-1])
        mean, spread = float(np.trace(remaining)), 2 * float((remaining**2).sum())
        size = float(pull @ pull) / solution.variance
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
        products = _products(eq, Variances(1.0, nothing, now.weight), NAMES.index(name))
        if there and products is not None:
            own, ge, gr, _ = products
            found[name] = float(np.trace(own) - np.trace(f.taken(ge, gr, None)))
    return found


def _products(
    eq: Equations, now: Variances, kind: int
) -> tuple[Array, Array, Array, Array] | None:
    """Return the products of a component's columns with themselves and all that is there."""
    b = eq.blocks
    keep, columns, rest = eq.kept(now.alive)
    in_r = np.flatnonzero(b.r_label == kind)
    if len(in_r):
        ge = b.er[keep][:, columns][..., in_r]
        return b.rr[np.ix_(in_r, in_r)], ge, b.rr[np.ix_(rest, in_r)], b.rx[in_r].T
    block, column = np.nonzero(b.e_label == kind)
    if not len(block):
        return None
    same = block[:, None] == block
    own = np.where(same, b.ee[block[:, None], column[:, None], column], 0.0)
    ge = np.zeros((int(keep.sum()), int(columns.sum()), len(block)))
    place = np.cumsum(keep) - 1
    at = np.flatnonzero(keep[block])
    chosen = np.flatnonzero(columns)
    ge[place[block[at]], :, at] = b.ee[block[at][:, None], chosen, column[at][:, None]]
    return own, ge, b.er[block, column][:, rest].T, b.ex[block, column].T


def significance(eq: Equations, now: Variances) -> dict[str, float]:
    """Return p-values of the components that are there, each by leaving it out.

    Restricted likelihood ratio on the boundary: half the tail of chi-square(1) (Self and Liang,
    JASA 82 (1987)); the other variances follow.
    """
    whole = _whole(eq, now)
    ratios = _followed(eq, now, whole, _ratios(now, whole, NAMES))
    return {name: _chance(ratio) for name, ratio in ratios.items()}


def _chance(ratio: float) -> float:
    return float(special.chdtrc(1, max(ratio, 0.0))) / 2


def _whole(eq: Equations, now: Variances) -> _Whole:
    f = factored(eq.trimmed(now.alive), now.lam, now.weight)
    known = posterior(f)
    return f, solve(f, known), known


def _ratios(now: Variances, whole: _Whole, names: Sequence[str]) -> dict[str, float]:
    """Return by how much the deviance rises without each component that is there."""
    kinds = {name: NAMES.index(name) for name in names}
    return {name: ratio_without(*whole, kind) for name, kind in kinds.items() if now.alive[kind]}


def _followed(
    eq: Equations, now: Variances, whole: _Whole, ratios: dict[str, float]
) -> dict[str, float]:
    """Return likelihood ratios once the other variances have taken up what they can.

    They only ever take up a part of it, so that only doubtful ones are asked for.
    """
    found, (f, solution, _) = dict(ratios), whole
    for name, ratio in ratios.items():
        if _DOUBTFUL[0] < ratio < _DOUBTFUL[1]:
            left = solution_without(*whole, NAMES.index(name))
            others = stepped(f, left, without(now, name))
            found[name] = _deviance(eq, others) - solution.deviance
    return found


def _deviance(eq: Equations, now: Variances) -> float:
    return solve(factored(eq.trimmed(now.alive), now.lam, now.weight)).deviance
