"""Single landmarks that are further off than the bulk of them."""

from __future__ import annotations

import numpy as np
from scipy import optimize, special, stats

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.diagnosis.choice import SIGNIFICANCE, TraceStep
from fisheye_svp_ros.diagnosis.evidence import Evidence, identifiable
from fisheye_svp_ros.diagnosis.gathered import MILLIMETRE
from fisheye_svp_ros.diagnosis.mixed import Factored, factored, solve_lower
from fisheye_svp_ros.diagnosis.reml import GONE, OF_LANDMARKS, landmark_labels, start_variances
from fisheye_svp_ros.diagnosis.solution import solve
from fisheye_svp_ros.effects.landmark_survey import MIN_VIEWS, LandmarkSurveyEffect

# So many landmarks are no single ones any more: of those that are exact, and of those that err
# from landmark to landmark anyway.
_MANY, _MANY_OF_BULK = 0.12, 3
_OUTWEIGHED = 10.0  # times smaller a statistic may be the doing of the largest
_TAILS = (3.0, 5.0, 8.0, 12.0, 20.0, 40.0, 1e6)  # degrees of freedom, the last: normal
_LONGER = 2.0  # what longer tails add to the log likelihood if they are no chance


def single_landmarks(evidence: Evidence) -> tuple[LandmarkSurveyEffect, Array, TraceStep] | None:
    """Return landmarks that stand out against the variance of all, their offsets and the test.

    None where there is none, or where so many do that they are no single ones.
    """
    statistic, rank, offset = landmark_tests(evidence)
    count, bulk = len(statistic), evidence.variances.alive[OF_LANDMARKS].any()
    p = np.asarray(special.chdtrc(np.maximum(rank, 1), statistic))
    tests = 2 * count * evidence.forms.names()
    standing_out = found = np.flatnonzero((rank > 0) & (p * tests < SIGNIFICANCE))
    most = _MANY_OF_BULK if bulk else max(3, int(_MANY * count))
    if found.size > most:
        # A landmark that is far off makes others seem so.
        found = found[statistic[found] > statistic[found].max() / _OUTWEIGHED]
    if found.size > most:
        return None
    if bulk and found.size:
        p = beside_bulk(statistic, rank, standing_out)
        found = found[p[found] * tests < SIGNIFICANCE]
    if not found.size:
        return None
    found = found[np.argsort(p[found], kind='stable')]
    ids = evidence.design.landmark[found]
    effect = LandmarkSurveyEffect(tuple(int(i) for i in ids))
    step = TraceStep(
        effect.key, float(statistic[found].sum()), int(rank[found].sum()), float(p[found[0]]),
        float(p[found[0]] * tests), np.nan, np.nan, True, 'further off than the bulk of landmarks',
    )
    return effect, offset[found].ravel(), step


def beside_bulk(statistic: Array, rank: Array, found: Index) -> Array:
    """Return p-values (L,) beside landmarks whose offsets have tails as long as the others' have.

    An F distribution of the statistics, its median theirs, its denominator's degrees of freedom
    the likeliest for those that do not stand out: one that is far off is no bulk, and of those
    that scatter by very different amounts the largest is no single one.  One far beyond them all
    is in no tail of theirs, and makes others seem off.
    """
    one, others = np.maximum(rank, 1), np.setdiff1d(np.flatnonzero(rank > 0), found)
    if not others.size:
        return np.asarray(stats.chi2.sf(statistic, one))
    size, of = rank[others], statistic[others] / np.maximum(rank[others], 1)
    fits = []
    for freedom in _TAILS:
        scale = max(float(np.median(of / stats.f.median(size, freedom))), 1.0)
        density = np.asarray(stats.f.logpdf(of / scale, size, freedom))
        fits.append((float(density.sum() - len(of) * np.log(scale)), scale, freedom))
    normal, best = fits[-1], max(fits)
    _, scale, freedom = best if best[0] > normal[0] + _LONGER else normal
    beyond = statistic > _OUTWEIGHED * statistic[others].max()
    freedom_of_each = np.where(beyond, normal[2], freedom)
    return np.asarray(stats.f.sf(statistic / one / scale, one, freedom_of_each))


def landmark_tests(evidence: Evidence) -> tuple[Array, Array, Array]:
    """Test the offset of every landmark: statistics, ranks (L,) and offsets (L, 3), m.

    Against the variance of the bulk, so scaled that the median landmark is an ordinary one.
    """
    lam = evidence.variances.lam.copy()
    tiny = start_variances(evidence.full, 1e-7).lam
    lam[OF_LANDMARKS] = np.where(lam < GONE, lam, tiny)[OF_LANDMARKS]
    own = np.arange(evidence.own)
    basis = identifiable(evidence.linear.frame_columns, evidence.border[..., :-1], own)
    eq = evidence.full.trimmed(lam < GONE).bordered(basis)
    f = factored(eq, lam, evidence.variances.weight)
    solution = solve(f)
    _, landmark, _ = eq.sorted(solution.e, solution.r)
    label = landmark_labels(eq)
    table = np.where(label >= 0, lam[label], GONE)
    prior = table * evidence.variances.weight[eq.landmarks, None]
    precise = np.linalg.inv(_posterior(f))
    pull = (precise @ landmark[..., None])[..., 0]
    information = precise - prior[:, :, None] * np.eye(3)
    often = _often_seen(evidence)[eq.landmarks]
    bulk = np.where(evidence.variances.alive[label], 1 / table, 0.0)
    statistic, rank, offset = _against(
        information, pull, bulk, often, evidence.variances.sigma**2
    )
    axes = evidence.design.axes[eq.landmarks]
    return statistic, rank, np.einsum('la,lab->lb', offset, axes) * MILLIMETRE


def _often_seen(evidence: Evidence) -> Mask:
    views = np.zeros(len(evidence.design.landmark), dtype=np.int64)
    for slot in evidence.design.slot:
        views[np.unique(slot[slot >= 0])] += 1
    return np.asarray(views >= MIN_VIEWS)


def _against(
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

    def off(log_scale: float) -> float:
        return float(np.median(statistic(np.exp(log_scale))[mine] / typical) - 1)

    low, high = off(0.0), off(7.0)
    scale = 0.0 if low <= 0 else 7.0 if high >= 0 else optimize.brentq(off, 0.0, 7.0, xtol=0.05)
    return statistic(np.exp(scale)), rank, offset


def _posterior(f: Factored) -> Array:
    """Return the posterior covariances (L, 3, 3) of landmarks' offsets over the noise variance."""
    eq = f.equations
    count = len(eq.landmarks)
    by_border = solve_lower(f.factor, f.border[:, :-1], trans=1)
    if eq.by_frame:
        unit = np.zeros((len(f.factor), 3 * count))
        unit[-3 * count :] = np.eye(3 * count)
        through = solve_lower(f.factor, unit)
        own, fixed = np.zeros((count, 3, 3)), by_border[-3 * count :]
    else:
        back = np.swapaxes(f.inverse, -1, -2)
        flat = (back @ f.coupled).reshape(3 * count, -1)
        through = solve_lower(f.factor, flat.T)
        own = back @ f.inverse
        fixed = (back @ (f.block_border[..., :-1] - f.coupled @ by_border)).reshape(3 * count, -1)
    found = own + _outer(through, count)
    if len(f.root):
        half = solve_lower(f.root, fixed.T)
        found = found + _outer(half, count)
    return np.asarray(found)


def _outer(columns: Array, count: int) -> Array:
    """Return the products (L, 3, 3) of each landmark's columns (R, 3 L) with each other."""
    parts = columns.reshape(-1, count, 3)
    return np.asarray(np.einsum('rla,rlb->lab', parts, parts))
