"""Which random components the data call for: score tests of variances at zero, and REML."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import special

from fisheye_svp_ros.diagnosis.mixed import Equations, Factored, factored
from fisheye_svp_ros.diagnosis.random_effects import NAMES
from fisheye_svp_ros.diagnosis.reml import (
    GONE,
    OF_LANDMARKS,
    Variances,
    estimate,
    nothing_random,
    start_variances,
    stepped,
    without,
)
from fisheye_svp_ros.diagnosis.score_tests import score_components
from fisheye_svp_ros.diagnosis.solution import Posterior, Solution, posterior, ratio_without, solve
from fisheye_svp_ros.diagnosis.solution import without as solution_without

_LANDMARKS, _OTHERS = (
    tuple(np.array(NAMES)[kinds].tolist()) for kinds in (OF_LANDMARKS, ~OF_LANDMARKS))
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


def significance(eq: Equations, now: Variances) -> dict[str, float]:
    """Return p-values of the components that are there, each by leaving it out.

    Restricted likelihood ratio on the boundary: half the tail of chi-square(1) (Self and Liang,
    JASA 82 (1987)); the other variances follow.  Offsets of landmarks are drawn as alike there:
    a scale for each would fit chance with as many numbers as there are landmarks.
    """
    ratios: dict[str, float] = {}
    for names, variances in ((_OTHERS, now), (_LANDMARKS, now.drawn_alike)):
        if any(now.alive[NAMES.index(name)] for name in names):
            whole = _whole(eq, variances)
            ratios |= _followed(eq, variances, whole, _ratios(variances, whole, names))
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
    found = dict(ratios)
    for name, ratio in ratios.items():
        if _DOUBTFUL[0] < ratio < _DOUBTFUL[1]:
            found[name] = _deviance(eq, _step_without(eq, now, whole, name)) - whole[1].deviance
    return found


def _step_without(eq: Equations, now: Variances, whole: _Whole, name: str) -> Variances:
    f, kind, others = whole[0], NAMES.index(name), without(now, name)
    if (f.equations.blocks.r_label == kind).any():
        return stepped(f, solution_without(*whole, kind), others)
    f = factored(eq.trimmed(others.alive), others.lam, others.weight)
    return stepped(f, solve(f, posterior(f)), others)


def _deviance(eq: Equations, now: Variances) -> float:
    return solve(factored(eq.trimmed(now.alive), now.lam, now.weight)).deviance
