"""Causes: estimates with honest errors, what they may be mistaken for, whether they survive."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.choice import (
    CLASS_SIGNIFICANCE,
    CLASS_STRENGTH,
    SIGNIFICANCE,
    candidates,
)
from fisheye_svp_ros.diagnosis.evidence import Evidence, Placed
from fisheye_svp_ros.diagnosis.search import drop_test
from fisheye_svp_ros.effects.base import Effect
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.effects.landmark_survey import LandmarkSurveyEffect


@dataclass(frozen=True)
class Cause:
    """One named cause with its parameters, evidence and what it may be mistaken for.

    share: of the misfit of the simulation; survives: whether it is still needed with any one other
    cause left out; heldout_rms_px, gain: of held-out frames once it is in the model.
    """

    effect: str
    form: str
    parameters: dict[str, dict[str, Any]]
    p_value: float
    share: float
    survives: bool
    heldout_rms_px: float
    gain: float
    indistinguishable_from: list[str]
    to_separate: str


def standard_errors(evidence: Evidence, jackknife: bool = True) -> Array:
    """Return the standard errors (K,) of all that is shared: rig, intrinsics, effects.

    From the information of the null model; where estimates without each of the frames change by
    more than that allows, as much larger (a jackknife, beside what it should be: a frame on which
    much depends may change much).
    NaN where the data leave a parameter open.
    """
    own = np.arange(evidence.own)
    estimate, variance, open_ = _estimates(evidence.information, own)
    if jackknife and evidence.linear.data.frames > 2:
        changed, allowed = np.zeros(evidence.own), np.zeros(evidence.own)
        for part in evidence.in_turn:
            without, wider, lost = _estimates(part, own)
            changed += np.where(lost, 0.0, (without - estimate) ** 2)
            allowed += np.where(lost, 0.0, wider - variance)
        variance = variance * np.maximum(changed / np.maximum(allowed, 1e-9 * variance), 1.0)
    errors = np.sqrt(variance) / evidence.scale[: evidence.own]
    return np.where(open_, np.nan, errors)


def _estimates(information: Array, included: Index) -> tuple[Array, Array, Array]:
    """Return estimates (K,) and variances of what is included, normalised, and what is open."""
    if not len(included):
        return np.zeros(0), np.zeros(0), np.zeros(0, dtype=bool)
    values, vectors = np.linalg.eigh(information[np.ix_(included, included)])
    kept = values > 1e-12 * max(float(values[-1]), 1e-300)
    among = vectors[:, kept]
    estimate = among @ (among.T @ information[included, -1] / values[kept])
    variance = (among**2 / values[kept]).sum(axis=1)
    return estimate, variance, np.asarray((vectors[:, ~kept] ** 2).sum(axis=1) > 1e-6)


def model_uncertainty(evidence: Evidence) -> Array:
    """Return what effects that may be there, too, add to standard errors (K,) of what is shared.

    Models with one more effect, and with more beside the likeliest of them: each is as probable as
    its evidence says (BIC; Raftery 1995, eq. 35), and adds so much of the variance that it brings
    and of the square of the change.
    """
    own, information = evidence.own, evidence.information
    estimate, variance, _ = _estimates(information, np.arange(own))
    models = [*_larger_models(evidence)]
    weights = special.softmax([0.0, *(merit / 2 for merit, _ in models)])[1:]
    added = np.zeros(own)
    for weight, (_, included) in zip(weights, models, strict=True):
        other, wider, _ = _estimates(information, included)
        added += weight * (np.maximum(wider[:own] - variance, 0.0) + (other[:own] - estimate) ** 2)
    return np.asarray(np.sqrt(added) / evidence.scale[:own])


def _larger_models(evidence: Evidence) -> Iterator[tuple[float, Index]]:
    """Yield merit and columns of models with more effects, as long as one is likelier than not."""
    included, known, merit = np.arange(evidence.own), evidence.kinds, 0.0
    while True:
        others = [one for one in candidates(evidence, included)
                  if one.merit > 0 and _leaves_meanings(one.effect, known)]
        for one in others:
            columns = np.concatenate([included, evidence.columns_of(one.form)])
            yield merit + one.merit, columns
        if not others:
            return
        best = others[0]
        included = np.concatenate([included, evidence.columns_of(best.form)])
        known, merit = known | set(best.effect.kinds), merit + best.merit


def _leaves_meanings(effect: Effect, known: set[str]) -> bool:
    """Whether what is known in a model means the same beside another effect.

    Beside a further form of itself it does not; one of the target leaves those of the lens alone.
    """
    return not effect.per_frame and (effect.stage == 'target' or not known & set(effect.kinds))


def mean_causes(
    evidence: Evidence, found: Sequence[Placed], errors: Array, shares: dict[str, float],
    held_out: Sequence[tuple[float, float]],
) -> list[Cause]:
    """Return the causes that move predictions; held_out: rms and gain once each is in."""
    causes = []
    for (effect, columns, values), (rms, gain) in zip(found, held_out, strict=True):
        name = effect.name
        parameters = {
            p.name: {'value': float(v), 'stderr': float(e), 'unit': p.unit}
            for p, v, e in zip(effect.parameters, values, errors[columns], strict=True)
        }
        included = np.arange(evidence.own)
        causes.append(Cause(
            name, effect.key, parameters, drop_test(evidence, included, columns).p_value,
            shares[name], _survives(evidence, columns), rms, gain,
            _look_alikes(evidence, name, columns), effect.to_separate,
        ))
    return causes


def _survives(evidence: Evidence, columns: Index) -> bool:
    """Whether an effect is needed whichever one other cause is left out."""
    factor = evidence.forms.names()
    for _, other, _ in evidence.terms:
        included = np.setdiff1d(np.arange(evidence.own), other)
        if not np.array_equal(other, columns) and (
            drop_test(evidence, included, columns).p_value * factor > SIGNIFICANCE
        ):
            return False
    return True


def _look_alikes(evidence: Evidence, name: str, columns: Index) -> list[str]:
    """Return the effects with which in the model this one would no longer be needed."""
    if name == LandmarkSurveyEffect.name:
        return []
    rest = np.setdiff1d(np.arange(evidence.own), columns)
    remaining = evidence.remaining(evidence.information, rest)
    strength = evidence.score(remaining, columns).statistic
    known = evidence.kinds
    same: list[str] = []
    for other in candidates(evidence, rest):
        if known & set(other.effect.kinds) or other.effect.name in (name, *same):
            continue
        if other.score.statistic < CLASS_STRENGTH * strength:
            continue
        both = np.concatenate([rest, evidence.columns_of(other.form)])
        own = evidence.score(evidence.remaining(evidence.information, both), columns)
        if own.p_value > CLASS_SIGNIFICANCE:
            same.append(other.effect.name)
    return same


def plain_cause(
    name: str, parameters: dict[str, dict[str, Any]], p_value: float, share: float
) -> Cause:
    """Return a cause that moves no prediction: it lies in the table or in the noise."""
    return Cause(
        name, name, parameters, p_value, share, True, float('nan'), 0.0, [],
        CATALOGUE[name].to_separate,
    )
