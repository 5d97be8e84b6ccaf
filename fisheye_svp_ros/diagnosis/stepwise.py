"""Stepwise selection: effects added by score test and held-out gain, others eliminated.

This is where a cause is accepted (`add_effects`) and where it is given up (`eliminate_effects`).
"""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from itertools import chain, takewhile

import numpy as np
import scipy
from scipy import special

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.diagnosis.effect_tests import (
    RARITY_ODDS,
    SIGNIFICANCE,
    Candidate,
    EffectTests,
    HeldOutGain,
)
from fisheye_svp_ros.diagnosis.findings import Finding, Reason
from fisheye_svp_ros.diagnosis.random_effects import MILLIMETRE, OF_LANDMARKS
from fisheye_svp_ros.effects.base import Effect
from fisheye_svp_ros.effects.target_effects import MIN_VIEWS, LandmarkSurveyEffect
from fisheye_svp_ros.mixed_model import (
    LAMBDA_ABSENT,
    Score,
    factor_equations,
    initial_variances,
    solve_equations,
    unit_covariances,
    unit_labels,
)

# What is named is surer than significant: a local error now and then has the form of an effect.
NAMED_P = 0.002
# So many landmarks are no single ones any more: of those that are exact or far from all others,
# and of those that err from landmark to landmark anyway.
_MAX_SHARE, _MAX_BESIDE_BULK = 0.12, 3
_OUTWEIGHED_RATIO = 10.0  # times smaller a statistic may be the doing of the largest
_TAIL_FREEDOMS = (3.0, 5.0, 8.0, 12.0, 20.0, 40.0, 1e6)  # degrees of freedom, the last: normal
_TAIL_GAIN = 2.0  # what longer tails add to the log likelihood if they are no chance


def add_effects(
    tests: EffectTests, included: Index, most: int, refused: Container[str], quick: bool
) -> tuple[list[int], list[Finding]]:
    """Add forms for as long as one is significant and predicts held-out frames better.

    included: the border's columns in the model; refused: effects that are not asked again; quick:
    do without held-out frames.  Returns the forms, in order, and the trace.
    """
    forms, trace, failed = list[int](), list[Finding](), set()
    while len(forms) < most:
        remaining = (
            c
            for c in tests.significant_candidates(included)
            if c.form not in failed and c.effect.name not in refused
        )
        best = _next_candidate(remaining)
        if best is None:
            break
        columns = tests.null.form_columns(best.form)
        gain = HeldOutGain(np.inf, 0.0)
        if not (best.effect.per_frame or quick):
            gain = tests.held_out_gain(included, columns, best.effect)
        reason = Reason.PREDICTS_BETTER if gain.convincing else Reason.NO_CONVINCING_GAIN
        trace.append(_finding(best.effect, best.score, best.corrected, gain, reason))
        if gain.convincing:
            included = np.concatenate([included, columns])
            forms.append(best.form)
        else:
            failed.add(best.form)
    return forms, trace


def _next_candidate(remaining: Iterator[Candidate]) -> Candidate | None:
    """Return the first that is sure enough to be named, or what is likelier than it."""
    weaker: list[Candidate] = []
    for candidate in remaining:
        if candidate.corrected < NAMED_P:
            return _commoner_candidate(candidate, chain(weaker, remaining))
        weaker.append(candidate)
    return None


def _commoner_candidate(best: Candidate, others: Iterator[Candidate]) -> Candidate:
    """Return what stands for the best candidate: a part of it, or a more common confounded one."""
    if best.effect.asked_after:
        return next((c for c in others if c.effect.name in best.effect.asked_after), best)
    near = takewhile(lambda c: c.criterion > best.criterion - RARITY_ODDS, others)
    if not best.effect.rarer_than:
        return best
    size = len(best.effect.parameters)
    return next(
        (
            c
            for c in near
            if c.effect.name == best.effect.rarer_than and len(c.effect.parameters) == size
        ),
        best,
    )


def _finding(
    effect: Effect, score: Score, corrected: float, gain: HeldOutGain, reason: Reason
) -> Finding:
    return Finding(
        form=effect.key,
        reason=reason,
        p_value=score.p_value,
        p_corrected=corrected,
        statistic=score.statistic,
        rank=score.rank,
        held_out=gain.value,
        held_out_stderr=gain.stderr,
    )


def eliminate_effects(
    tests: EffectTests, known: Sequence[str], quick: bool
) -> tuple[Index, list[Finding]]:
    """Return the columns of what is still needed, given the others, and why the rest is not.

    The weakest goes first: what is no longer significant, then what held-out frames no longer
    support.  known: effects that stay whatever the tests say.
    """
    included = tests.null.included_columns
    gone: list[Finding] = []
    while True:
        weakest: tuple[float, Index, Finding] | None = None
        for term in tests.null.terms:
            effect, columns = term.effect, term.columns
            if effect.name in known or not np.isin(columns, included).all():
                continue
            step = _test_removal(tests, included, effect, columns, quick)
            if step is not None and (weakest is None or step.p_corrected > weakest[0]):
                weakest = step.p_corrected, columns, step
        if weakest is None:
            return included, gone
        gone.append(weakest[2])
        included = np.setdiff1d(included, weakest[1])


def _test_removal(
    tests: EffectTests, included: Index, effect: Effect, columns: Index, quick: bool
) -> Finding | None:
    """Return why an effect is not needed beside everything else that is included, if so."""
    score = tests.test_removal(included, columns, effect)
    corrected = tests.correct(effect, score.p_value)
    gain, reason = HeldOutGain(np.nan, np.nan), Reason.EXPLAINED_BY_OTHER_CAUSES
    if corrected < SIGNIFICANCE:
        if quick or effect.per_frame:
            return None
        gain = tests.held_out_gain(np.setdiff1d(included, columns), columns, effect)
        if gain.sufficient:
            return None
        reason = Reason.NO_LASTING_GAIN
    return _finding(effect, score, corrected, gain, reason)


def find_single_landmarks(
    tests: EffectTests,
) -> tuple[LandmarkSurveyEffect, Array, Finding] | None:
    """Return landmarks that stand out against the variance of all, their offsets and the test.

    None where there is none, or where so many do that they are no single ones.
    """
    statistic, rank, offset = test_landmarks(tests)
    null = tests.null
    count, bulk = len(statistic), null.variances.alive[OF_LANDMARKS].any()
    p = np.asarray(special.chdtrc(np.maximum(rank, 1), statistic))
    number = 2 * count * tests.effect_count
    standing_out = outliers = np.flatnonzero((rank > 0) & (p * number < SIGNIFICANCE))
    most = max(_MAX_BESIDE_BULK, int(_MAX_SHARE * count))
    few = _MAX_BESIDE_BULK if bulk else most
    if outliers.size > few:
        # A landmark that is far off makes others seem so.
        outliers = outliers[statistic[outliers] > statistic[outliers].max() / _OUTWEIGHED_RATIO]
    rest = np.delete(statistic, outliers)[np.delete(rank, outliers) > 0]
    if outliers.size > few and statistic[outliers].min() > _OUTWEIGHED_RATIO * rest.max():
        few = most  # no tail of the others reaches so far
    if outliers.size > few:
        return None
    if bulk and outliers.size:
        p = bulk_p_values(statistic, rank, standing_out)
        outliers = outliers[p[outliers] * number < SIGNIFICANCE]
    if not outliers.size:
        return None
    outliers = outliers[np.argsort(p[outliers], kind='stable')]
    ids = null.random.landmark[outliers]
    effect = LandmarkSurveyEffect(tuple(int(i) for i in ids))
    step = Finding(
        form=effect.key,
        reason=Reason.BEYOND_BULK,
        p_value=float(p[outliers[0]]),
        p_corrected=float(p[outliers[0]] * number),
        statistic=float(statistic[outliers].sum()),
        rank=int(rank[outliers].sum()),
    )
    return effect, offset[outliers].ravel(), step


def bulk_p_values(statistic: Array, rank: Array, outliers: Index) -> Array:
    """Return p-values (L,) beside landmarks whose offsets have tails as long as the others' have.

    An F distribution of the statistics, its median theirs, its denominator's degrees of freedom
    the likeliest for those that do not stand out: one that is far off is no bulk, and of those
    that scatter by very different amounts the largest is no single one.  One far beyond them all
    is in no tail of theirs, and makes others seem off.
    """
    dof, others = np.maximum(rank, 1), np.setdiff1d(np.flatnonzero(rank > 0), outliers)
    if not others.size:
        return np.asarray(special.chdtrc(dof, statistic))
    size, of = rank[others], statistic[others] / np.maximum(rank[others], 1)
    fits = []
    for freedom in _TAIL_FREEDOMS:
        scale = max(float(np.median(of / special.fdtri(size, freedom, 0.5))), 1.0)
        density = _log_density_of_f(of / scale, size, freedom)
        fits.append((float(density.sum() - len(of) * np.log(scale)), scale, freedom))
    normal, best = fits[-1], max(fits)
    _, scale, freedom = best if best[0] > normal[0] + _TAIL_GAIN else normal
    beyond = statistic > _OUTWEIGHED_RATIO * statistic[others].max()
    freedom_of_each = np.where(beyond, normal[2], freedom)
    return np.asarray(special.fdtrc(dof, freedom_of_each, statistic / dof / scale))


def _log_density_of_f(x: Array, rank: Array, freedom: float) -> Array:
    """Return the log density of F distributions; `scipy.stats` takes half a second to import."""
    rest = special.betaln(rank / 2, freedom / 2) - special.xlogy(rank / 2, rank / freedom)
    power = special.xlog1py((rank + freedom) / 2, rank * x / freedom)
    return np.asarray(special.xlogy(rank / 2 - 1, x) - power - rest)


def test_landmarks(tests: EffectTests) -> tuple[Array, Array, Array]:
    """Test the offset of every landmark: statistics, ranks (L,) and offsets (L, 3), m.

    Against the variance of the bulk, so scaled that the median landmark is an ordinary one.
    """
    null, landmarks = tests.null, tests.null.random.columns.components.of_units
    lam = null.variances.lam.copy()
    tiny = initial_variances(null.full, 1e-7).lam
    lam[landmarks] = np.where(lam < LAMBDA_ABSENT, lam, tiny)[landmarks]
    eq = null.equations_of(null.included_columns).select(lam < LAMBDA_ABSENT)
    f = factor_equations(eq, lam, null.variances.weight)
    solution = solve_equations(f)
    _, landmark, _ = eq.split(solution.e, solution.r)
    label = unit_labels(eq)
    table = np.where(label >= 0, lam[label], LAMBDA_ABSENT)
    prior = table * null.variances.weight[eq.units, None]
    precise = np.linalg.inv(unit_covariances(f))
    pull = (precise @ landmark[..., None])[..., 0]
    information = precise - prior[:, :, None] * np.eye(3)
    unit = null.random.columns.unit
    seen = np.zeros((len(unit), len(null.random.landmark)), dtype=bool)
    seen[np.nonzero(unit >= 0)[0], unit[unit >= 0]] = True
    often = seen.sum(axis=0)[eq.units] >= MIN_VIEWS
    bulk = np.where(null.variances.alive[label], 1 / table, 0.0)
    statistic, rank, offset = _test_against_bulk(
        information, pull, bulk, often, null.variances.sigma**2
    )
    axes = null.random.axes[eq.units]
    return statistic, rank, np.einsum('la,lab->lb', offset, axes) * MILLIMETRE


def _test_against_bulk(
    information: Array, pull: Array, bulk: Array, often: Mask, variance: float
) -> tuple[Array, Array, Array]:
    """Return statistics, ranks and least-squares offsets, in the boards' axes, of landmarks."""
    values, vectors = np.linalg.eigh(information)
    kept = (values > 1e-4 * values[:, -1:]) & (values > 0) & often[:, None]
    inverse = np.where(kept, 1 / np.where(kept, values, 1.0), 0.0)
    least = (vectors * inverse[:, None]) @ np.swapaxes(vectors, -1, -2)
    offset = (least @ pull[..., None])[..., 0]
    rank = kept.sum(axis=1)

    def statistic(scale: float) -> Array:
        spread = least + scale * bulk[:, :, None] * np.eye(3)
        inside = np.swapaxes(vectors, -1, -2) @ spread @ vectors
        mask = kept[:, :, None] & kept[:, None, :]
        inside = np.where(mask, inside, np.eye(3))
        way = np.where(kept, (np.swapaxes(vectors, -1, -2) @ offset[..., None])[..., 0], 0.0)
        solved = np.linalg.solve(inside, way[..., None])[..., 0]
        return np.asarray((way * solved).sum(axis=1) / variance)

    if not bulk.any() or not (rank > 0).any():
        return statistic(0.0), rank, offset
    mine = rank > 0
    typical = special.chdtri(rank[mine], 0.5)

    def excess(log_scale: float) -> float:
        return float(np.median(statistic(np.exp(log_scale))[mine] / typical) - 1)

    if excess(0.0) <= 0:
        scale = 0.0
    elif excess(7.0) >= 0:
        scale = 7.0
    else:
        scale = scipy.optimize.brentq(excess, 0.0, 7.0, xtol=0.05)
    return statistic(np.exp(scale)), rank, offset
