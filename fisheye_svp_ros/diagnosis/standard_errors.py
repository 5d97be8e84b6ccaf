"""Standard errors: of the null model, between frames, and of the choice of causes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import special

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.choice import candidates
from fisheye_svp_ros.diagnosis.evidence import Evidence

_MOST = 40  # models


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
        least = np.maximum(1e-9 * variance, 1e-300)  # nothing is known of what the data leave open
        variance = variance * np.maximum(changed / np.maximum(allowed, least), 1.0)
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

    Each model with more effects is as probable as its evidence says (BIC; Raftery 1995, eq. 35),
    and adds so much of the variance that it brings and of the square of the change.  Beside a
    further form of an effect its parameters mean something else: for them that model does not
    count.
    """
    own, information = evidence.own, evidence.information
    estimate, variance, _ = _estimates(information, np.arange(own))
    models = _larger_models(evidence)
    weights = special.softmax([one.merit / 2 for one in models])
    added = np.zeros(own)
    for weight, one in zip(weights, models, strict=True):
        other, wider, _ = _estimates(information, one.included)
        more = np.maximum(wider[:own] - variance, 0.0) + (other[:own] - estimate) ** 2
        for effect, columns, _ in evidence.terms:
            if one.kinds & set(effect.kinds):
                more[columns] = 0.0
        added += weight * more
    return np.asarray(np.sqrt(added) / evidence.scale[:own])


class _Model(NamedTuple):
    """A model: its merit beside the one that was chosen, its columns, and what more is in it."""

    merit: float
    included: Index
    kinds: frozenset[str]


def _larger_models(evidence: Evidence) -> list[_Model]:
    """Return the chosen model and larger ones, each likelier than one that it extends.

    The likeliest of those at hand is extended first, and so many are enough.
    """
    found: dict[frozenset[int], _Model] = {}
    waiting = {frozenset[int](): _Model(0.0, np.arange(evidence.own), frozenset())}
    while waiting and len(found) < _MOST:
        forms, model = max(waiting.items(), key=lambda item: item[1].merit)
        found[forms] = waiting.pop(forms)
        for one in candidates(evidence, model.included):
            kinds = set(one.effect.kinds)
            if one.merit <= 0 or one.effect.per_frame or model.kinds & kinds:
                continue
            if (larger := forms | {one.form}) not in found:
                columns = np.concatenate([model.included, evidence.columns_of(one.form)])
                waiting[larger] = _Model(model.merit + one.merit, columns, model.kinds | kinds)
    return [*found.values()]
