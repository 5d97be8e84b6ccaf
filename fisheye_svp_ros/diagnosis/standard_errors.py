"""Standard errors: of the null model, between frames, of a broad field and of the choice."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy import special

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.choice import candidates
from fisheye_svp_ros.diagnosis.evidence import Evidence, Score
from fisheye_svp_ros.effects.base import Effect

_MOST = 40  # models
_FEWEST = 3  # frames
_WINDOW = 6.0  # of merit: odds of 20, beyond which a model counts for nothing (Occam's window)


def honest_errors(evidence: Evidence) -> Array:
    """Return the standard errors (K,) of all that is shared, other likely models allowed for."""
    parts = standard_errors(evidence), field_uncertainty(evidence), model_uncertainty(evidence)
    return np.asarray(np.sqrt(np.square(parts).sum(axis=0)))


def standard_errors(evidence: Evidence, jackknife: bool = True) -> Array:
    """Return the standard errors (K,) of all that is shared: rig, intrinsics, effects.

    From the information of the null model; where estimates without each of the frames change by
    more than that allows, as much larger (a jackknife, beside what it should be: a frame on which
    much depends may change much).
    NaN where the data leave a parameter open.
    """
    own, reported = np.arange(evidence.own), _reported(evidence)
    estimate, variance, open_ = _estimates(evidence.information, own, reported)
    if jackknife and evidence.linear.data.frames > 2:
        changed, allowed = np.zeros(evidence.own), np.zeros(evidence.own)
        for part in evidence.in_turn(np.append(own, len(evidence.scale))):
            without, wider, lost = _estimates(part, own, reported)
            changed += np.where(lost, 0.0, (without - estimate) ** 2)
            allowed += np.where(lost, 0.0, wider - variance)
        least = np.maximum(1e-9 * variance, 1e-300)  # nothing is known of what the data leave open
        variance = variance * np.maximum(changed / np.maximum(allowed, least), 1.0)
    errors = np.sqrt(variance) / evidence.scale[: evidence.own]
    return np.where(open_, np.nan, errors)


def _reported(evidence: Evidence) -> Array:
    """Return what makes coefficients (X,), normalised, those that are reported: (X, X)."""
    found = np.eye(len(evidence.scale))
    for effect, columns, _ in evidence.terms:
        scale = evidence.scale[columns]
        own = effect.reported(np.eye(len(columns)))
        found[np.ix_(columns, columns)] = scale[:, None] * own / scale
    return found


def _estimates(
    information: Array, included: Index, reported: Array
) -> tuple[Array, Array, Array]:
    """Return estimates (K,) and variances of what is included, normalised, and what is open."""
    if not len(included):
        return np.zeros(0), np.zeros(0), np.zeros(0, dtype=bool)
    values, vectors = np.linalg.eigh(information[np.ix_(included, included)])
    kept = values > 1e-12 * max(float(values[-1]), 1e-300)
    seen = reported[np.ix_(included, included)] @ vectors
    estimate = seen[:, kept] @ (vectors[:, kept].T @ information[included, -1] / values[kept])
    variance = (seen[:, kept]**2 / values[kept]).sum(axis=1)
    return estimate, variance, np.asarray((seen[:, ~kept] ** 2).sum(axis=1) > 1e-6)


def field_uncertainty(evidence: Evidence) -> Array:
    """Return what the unknown size of a broad image field adds to standard errors (K,).

    What intrinsics and effects take up of such a field is lost for its variance, which is found
    too small then, or nothing.  Each size, none among them, is as probable as its restricted
    likelihood says, and adds what it brings and the square of the change.
    """
    own, reported = np.arange(evidence.own), _reported(evidence)
    freedom = evidence.full.rows - evidence.full.poses - evidence.own
    estimate, variance, _ = _estimates(evidence.information, own, reported)
    likelihoods, more = [], []
    for logs, information in evidence.with_field:
        noise = evidence.remaining(information, own)[-1, -1] / freedom
        values = np.linalg.eigvalsh(information[np.ix_(own, own)])
        determinant = np.log(np.maximum(values, 1e-12)).sum()
        likelihoods.append(-(logs + determinant + freedom * np.log(noise)) / 2)
        other, wider, _ = _estimates(information / noise, own, reported)
        more.append(wider - variance + (other - estimate) ** 2)
    added = np.maximum(special.softmax(likelihoods) @ np.array(more), 0.0)
    return np.asarray(np.sqrt(added) / evidence.scale[: evidence.own])


def model_uncertainty(evidence: Evidence) -> Array:
    """Return what other models, likely too, add to standard errors (K,) of what is shared.

    Each model with more effects, or with another effect in the place of one, is as probable as its
    evidence says (`_evidence_for`), and adds so much of the variance that it brings and of the
    square of the change.  Beside a further form of an effect or one that does nearly the same, or
    without it, its parameters mean something else: for them that model does not count.  What is
    added is hardly larger than large, however little the data say of it.
    """
    own, information, reported = evidence.own, evidence.information, _reported(evidence)
    prior = np.zeros(len(information))
    for form, effect in enumerate(evidence.forms.effects):
        prior[evidence.columns_of(form)] = evidence.wide_prior(evidence.columns_of(form), effect)
    estimate, variance, _ = _estimates(information, np.arange(own), reported)
    models = _likely_models(evidence)
    weights = special.softmax([one.merit / 2 for one in models])
    added = np.zeros(own)
    for weight, one in zip(weights, models, strict=True):
        there = one.included < own
        at, more = one.included[there], np.zeros(own)
        other, wider, _ = _estimates(
            evidence.restored(information, at) + np.diag(prior), one.included, reported)
        change = other[there] - estimate[at]
        more[at] = np.maximum(wider[there] - variance[at], 0.0) + change**2
        for effect, columns, _ in evidence.terms:
            if one.kinds & _meaning(effect):
                more[columns] = 0.0
        added += weight * more
    return np.asarray(np.sqrt(added) / evidence.scale[:own])


def _evidence_for(evidence: Evidence, score: Score) -> float:
    """Return twice the logarithm of the odds that an effect of such a score is there (BIC).

    What counts as so many observations are the frames: points of one have errors in common.
    Source: Raftery 1995, eq. 35; Pauler, The Schwarz criterion and related methods for normal
    linear models (1998), for the number.
    """
    frames = max(evidence.linear.data.frames, _FEWEST)
    return float(score.statistic - score.rank * np.log(frames))


class _Model(NamedTuple):
    """A model: its merit beside the one that was chosen, its columns, kinds of what differs."""

    merit: float
    included: Index
    kinds: frozenset[str]


def _likely_models(evidence: Evidence) -> list[_Model]:
    """Return the chosen model, those with an effect exchanged, and larger, likelier ones of each.

    The likeliest of those at hand is extended first, and so many are enough.
    """
    found: dict[frozenset[int], _Model] = {}
    waiting = {frozenset[int](): _Model(0.0, np.arange(evidence.own), frozenset())}
    waiting |= dict(_exchanged(evidence))
    while waiting and len(found) < _MOST:
        forms, model = max(waiting.items(), key=lambda item: item[1].merit)
        found[forms] = waiting.pop(forms)
        for one in candidates(evidence, model.included, per_frame=False):
            kinds, gain = _meaning(one.effect), _evidence_for(evidence, one.score)
            if gain <= 0 or model.kinds & kinds:
                continue
            if (larger := forms | {one.form}) not in found:
                columns = np.concatenate([model.included, evidence.columns_of(one.form)])
                waiting[larger] = _Model(model.merit + gain, columns, model.kinds | kinds)
    return [*found.values()]


def _exchanged(evidence: Evidence) -> Iterator[tuple[frozenset[int], _Model]]:
    """Yield models with another effect in the place of one, by what is gone (~i) and the form.

    Beside other effects of the recording intrinsics mean something else: those stay as they are.
    """
    for i, (effect, columns, _) in enumerate(evidence.terms):
        if not _lasts(effect):
            continue
        rest = np.setdiff1d(np.arange(evidence.own), columns)
        score = evidence.score(evidence.remaining(evidence.information, rest), columns)
        lost = _evidence_for(evidence, score)
        for one in candidates(evidence, rest, per_frame=False):
            kinds = frozenset(one.effect.kinds)
            gain = _evidence_for(evidence, one.score) - lost
            if gain > -_WINDOW and _lasts(one.effect) and not evidence.kinds & kinds:
                included = np.concatenate([rest, evidence.columns_of(one.form)])
                yield frozenset({~i, one.form}), _Model(
                    gain, included, kinds | set(effect.kinds))


def _meaning(effect: Effect) -> set[str]:
    """Return the kinds of an effect, and of a more common one that does nearly the same."""
    alike = effect.rarer_than or effect.name
    return {*effect.kinds, *(kind.replace(effect.name, alike) for kind in effect.kinds)}


def _lasts(effect: Effect) -> bool:
    return not (effect.per_frame or effect.of_recording)
