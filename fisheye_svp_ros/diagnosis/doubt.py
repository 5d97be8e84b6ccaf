"""Doubt about a score test: what is not known of the null model, taken into its p-value."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy import special

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.evidence import (
    IDENTIFIABLE,
    Evidence,
    Score,
    integrated,
    pseudo_inverse,
)
from fisheye_svp_ros.diagnosis.products import moves_of
from fisheye_svp_ros.effects.base import Effect

_DOUBTFUL, _BEYOND_DOUBT = 0.01, 200.0  # p-value, statistic: between them more is asked
_TURNS = (0.5, 2.0, 8.0, 32.0, 128.0, 512.0)  # variance over noise of an effect's coefficient


def confident(
    evidence: Evidence, score: Score, included: Index, columns: Index,
    effect: Effect | None = None,
) -> Score:
    """Return the score with what the uncertainty of the null model does to its p-value.

    F test with Satterthwaite's degrees of freedom, of the direction that was estimated; where it
    is not beyond doubt, the likelihood ratio beside a smooth image field, too: the variance of
    one that was too small to be called for says nothing of its uncertainty.
    effect: what the columns are of; None for a field without a name.
    """
    covariance = evidence.variances.covariance
    if covariance is None or not score.rank:
        return score
    way = _direction(evidence, score.estimate * evidence.scale[columns], included, columns)
    freedom = _freedom(evidence, way, covariance)
    p = float(special.fdtrc(score.rank, freedom, max(score.statistic, 0.0) / score.rank))
    if p < _DOUBTFUL and (score.statistic < _BEYOND_DOUBT or (effect and effect.abrupt)):
        gain = _beside_fields(evidence, included, columns, effect)
        p = max(p, float(special.chdtrc(score.rank, gain)))
        if effect is not None:
            p = max(p, _by_landmark(evidence, score, way, included, columns))
    return score._replace(p_value=p, freedom=freedom)


def random_gain(evidence: Evidence, included: Index, columns: Index) -> float:
    """Return twice the gain in log likelihood if the coefficients of columns are random.

    Of whatever size, beside what frames have of their own or in place of it, against what frames
    may have of their own without the columns.
    """
    count = evidence.full.rows - evidence.full.poses

    def cost(logs: float, information: Array) -> float:
        rest = evidence.remaining(information, included)
        return logs + count * float(np.log(rest[-1, -1]))

    parts = [evidence.factored, evidence.without_frames, evidence.frames_anew]
    return min(cost(f.log_determinant, f.information) for f in parts) - min(
        cost(*integrated(f, columns, 1 / size)) for f in parts for size in _TURNS)


def _beside_fields(
    evidence: Evidence, included: Index, columns: Index, effect: Effect | None
) -> float:
    """Return the likelihood ratio of columns, whatever the size of what resembles them.

    Its variance is found with the columns and without them.
    """
    count = evidence.full.rows - evidence.full.poses
    without, beside = np.inf, np.inf
    for logs, information in _fields(evidence, effect):
        rest = evidence.remaining(information, included)
        remaining = rest[-1, -1]
        without = min(without, logs + count * np.log(remaining))
        inverse, _ = pseudo_inverse(rest[np.ix_(columns, columns)], least=IDENTIFIABLE)
        remaining -= rest[columns, -1] @ inverse @ rest[columns, -1]
        beside = min(beside, logs + count * np.log(remaining))
    return max(float(without - beside), 0.0)


def _fields(evidence: Evidence, effect: Effect | None) -> Iterator[tuple[float, Array]]:
    """Yield log determinant and information beside fields that an effect may be mistaken for.

    A smooth field of the image; for what varies in a rig what frames have of their own: no pose
    of a single view takes up most of that there; for what is abrupt smooth paths of intrinsics.
    """
    yield from evidence.with_field
    if effect is not None and effect.of_recording and evidence.linear.data.cameras > 1:
        for f in (evidence.without_frames, evidence.frames_anew):
            yield f.log_determinant, f.information
    if effect is not None and effect.abrupt:
        yield from evidence.with_paths


def _direction(evidence: Evidence, estimate: Array, included: Index, columns: Index) -> Array:
    """Return the combination (X + 1,) of the border along an estimate, what is included out."""
    info = evidence.factored.information
    inside, _ = pseudo_inverse(info[np.ix_(included, included)])
    way = np.zeros(len(info))
    way[columns] = estimate
    way[included] -= inside @ (info[np.ix_(included, columns)] @ estimate)
    return way


def _freedom(evidence: Evidence, way: Array, covariance: Array) -> float:
    f = evidence.factored
    size = float(way @ f.information @ way)
    shares = f.shares(*f.coefficients(way)) / max(size, 1e-300)
    slope = -np.append(shares, 1 - shares.sum())
    spread = float(slope @ covariance @ slope)
    return float(np.clip(2 / max(spread, 1e-9), 2.0, 1e6))


def _by_landmark(
    evidence: Evidence, score: Score, way: Array, included: Index, columns: Index
) -> float:
    """Return the p-value with the scatter of the score from landmark to landmark.

    What a landmark has of its own need not be an offset of it: light of another colour, a print
    that detectors find elsewhere from aslant.  Never less than the null model says.
    Source: Liang and Zeger, Longitudinal data analysis using generalized linear models,
    Biometrika 73 (1986).
    """
    info, both = evidence.factored.information, np.concatenate([included, columns])
    left = evidence.residual_with(included)
    inverse, _ = pseudo_inverse(info[np.ix_(both, both)])
    left[both] -= inverse @ (info[both] @ left)
    weight, remaining = _rows(evidence, way, left)
    used = evidence.linear.used
    slot = np.repeat(evidence.design.slot, 2, axis=-1)[used]
    parts = np.bincount(slot, weights=(weight * remaining)[used])
    expected = float(way @ info @ way) * evidence.variances.sigma**2
    statistic = score.statistic / max(float(parts @ parts) / max(expected, 1e-300), 1.0)
    freedom = max(len(np.unique(slot)) - score.rank, 1)
    return float(special.fdtrc(score.rank, freedom, statistic / score.rank))


def _rows(evidence: Evidence, way: Array, left: Array) -> Array:
    """Return two combinations of the border (2, F, M), what is random out.

    Of the second all but what landmarks have of their own.
    """
    f, eq = evidence.factored, evidence.equations
    parts = [eq.sorted(*f.coefficients(one)) for one in (way, left)]
    frame, landmark, shared = (np.stack(both, axis=-1) for both in zip(*parts, strict=True))
    landmark[..., 1] = 0.0
    pose = evidence.linear.frame_columns / eq.pose_scale[:, None]
    random = moves_of(evidence.random, pose, frame, landmark, shared, eq.landmarks)
    return np.moveaxis(evidence.border @ np.stack([way, left], axis=-1) - random, -1, 0)
