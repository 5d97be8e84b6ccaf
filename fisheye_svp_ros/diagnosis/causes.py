"""Causes: estimates, what they may be mistaken for, whether they survive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

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
            for p, v, e in zip(
                effect.parameters, effect.reported(values), errors[columns], strict=True)
        }
        included = np.arange(evidence.own)
        causes.append(Cause(
            name, effect.key, parameters, drop_test(evidence, included, columns, effect).p_value,
            shares[name], _survives(evidence, effect, columns), rms, gain,
            _look_alikes(evidence, name, columns), effect.to_separate,
        ))
    return causes


def _survives(evidence: Evidence, effect: Effect, columns: Index) -> bool:
    """Whether an effect is needed whichever one other cause is left out."""
    factor = evidence.forms.names()
    for _, other, _ in evidence.terms:
        included = np.setdiff1d(np.arange(evidence.own), other)
        if not np.array_equal(other, columns) and (
            drop_test(evidence, included, columns, effect).p_value * factor > SIGNIFICANCE
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
