"""Standard errors of what is shared: of the model, between frames, a broad field, selection.

And what is known of the parameters of the lens that is written, in every model that is likely.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import inf
from typing import NamedTuple

import numpy as np
from scipy import special

from fisheye_svp_ros.arrays import Array, Index, symmetric_root
from fisheye_svp_ros.diagnosis.effect_tests import EffectTests
from fisheye_svp_ros.diagnosis.model_errors import parameter_names, shared_names
from fisheye_svp_ros.diagnosis.null_model import NullModel, cluster_frames
from fisheye_svp_ros.diagnosis.written_lens import AveragedModel, CameraField
from fisheye_svp_ros.effects.base import Effect
from fisheye_svp_ros.mixed_model import Score, pseudo_inverse
from fisheye_svp_ros.solve.ray_errors import SAMPLES
from fisheye_svp_ros.solve.rig_state import Linearization, RigState, with_effect

_MAX_MODELS = 40
_PRIOR_FREEDOM = 16.0  # frames that say that errors are as the model has them
_SEED = 0
_MIN_WEIGHT = 0.01  # probability of an effect below which it moves no ray worth counting
_ODDS_WINDOW = 6.0  # of the criterion: odds of 20, beyond which a model counts for nothing


class OtherModel(NamedTuple):
    """A model: its criterion beside the chosen one, its columns, kinds of what differs."""

    criterion: float
    included: Index
    kinds: frozenset[str]


def total_errors(null: NullModel, models: Sequence[OtherModel] | None = None) -> Array:
    """Return the standard errors (K,) of all that is shared, other likely models allowed for.

    models: the likely ones, where they are known already.
    """
    models = likely_models(null) if models is None else models
    parts = standard_errors(null), field_uncertainty(null), model_uncertainty(null, models)
    return np.asarray(np.sqrt(np.square(parts).sum(axis=0)))


def standard_errors(null: NullModel, jackknife: bool = True) -> Array:
    """Return the standard errors (K,) of all that is shared: rig, intrinsics, effects.

    From the information of the null model; where estimates without each of the frames change by
    more than that allows, as much larger (a jackknife, beside what it should be: a frame on which
    much depends may change much).  Frames of similar poses, which may err alike, are left out
    together.
    NaN where the data leave a parameter open.
    """
    own, reported = null.included_columns, _reporting_matrix(null)
    estimate, covariance, open_ = _estimate(null.information, own, reported)
    variance = np.diag(covariance).copy()
    if jackknife and null.linear.data.frames > 2:
        changed, allowed = np.zeros(null.column_count), np.zeros(null.column_count)
        for part in null.information_without_poses(np.append(own, len(null.scale))):
            other, wider, lost = _estimate(part, own, reported)
            changed += np.where(lost, 0.0, (other - estimate) ** 2)
            allowed += np.where(lost, 0.0, np.diag(wider - covariance))
        least = np.maximum(1e-9 * variance, 1e-300)  # nothing is known of what the data leave open
        variance = variance * np.maximum(changed / np.maximum(allowed, least), 1.0)
    errors = np.sqrt(variance) / null.scale[: null.column_count]
    return np.where(open_, np.nan, errors)


def _reporting_matrix(null: NullModel) -> Array:
    """Return what makes coefficients (X,), normalized, those that are reported: (X, X)."""
    found = np.eye(len(null.scale))
    for term in null.terms:
        columns, scale = term.columns, null.scale[term.columns]
        own = term.effect.report_values(np.eye(len(columns)))
        found[np.ix_(columns, columns)] = scale[:, None] * own / scale
    return found


def _estimate(information: Array, included: Index, reported: Array) -> tuple[Array, Array, Array]:
    """Return estimates (K,), covariance (K, K) of what is included, normalized, what is open."""
    if not len(included):
        return np.zeros(0), np.zeros((0, 0)), np.zeros(0, dtype=bool)
    values, vectors = np.linalg.eigh(information[np.ix_(included, included)])
    kept = values > 1e-12 * max(float(values[-1]), 1e-300)
    seen = reported[np.ix_(included, included)] @ vectors
    estimate = seen[:, kept] @ (vectors[:, kept].T @ information[included, -1] / values[kept])
    covariance = (seen[:, kept] / values[kept]) @ seen[:, kept].T
    return estimate, covariance, np.asarray((seen[:, ~kept] ** 2).sum(axis=1) > 1e-6)


def field_uncertainty(null: NullModel) -> Array:
    """Return what the unknown size of a broad image field adds to standard errors (K,).

    What intrinsics and effects take up of such a field is lost for its variance, which is found
    too small then, or nothing.  Each size, none among them, is as probable as its restricted
    likelihood says, and adds what it brings and the square of the change.
    """
    own, reported = null.included_columns, _reporting_matrix(null)
    freedom = null.freedom
    estimate, covariance, _ = _estimate(null.information, own, reported)
    likelihoods, more = [], []
    for logs, information in null.field_alternatives:
        noise = null.remaining_information(information, own)[-1, -1] / freedom
        values = np.linalg.eigvalsh(information[np.ix_(own, own)])
        determinant = np.log(np.maximum(values, 1e-12)).sum()
        likelihoods.append(-(logs + determinant + freedom * np.log(noise)) / 2)
        other, wider, _ = _estimate(information / noise, own, reported)
        more.append(np.diag(wider - covariance) + (other - estimate) ** 2)
    added = np.maximum(special.softmax(likelihoods) @ np.array(more), 0.0)
    return np.asarray(np.sqrt(added) / null.scale[: null.column_count])


def model_uncertainty(null: NullModel, models: Sequence[OtherModel]) -> Array:
    """Return what other models, likely too, add to standard errors (K,) of what is shared.

    Each model with more effects, or with another effect in the place of one, is as probable as its
    evidence says (`EffectTests.log_odds`, Occam's window), and adds so much of the variance that
    it brings and of the square of the change.  Beside a further form of an effect or one that does
    nearly the same, or without it, its parameters mean something else: for them that model does
    not count.  What is added is hardly larger than large, however little the data say of it.
    """
    own, reported = null.column_count, _reporting_matrix(null)
    estimate, covariance, _ = _estimate(null.information, np.arange(own), reported)
    added, prior = np.zeros(own), _prior_information(null)
    for weight, one in zip(model_weights(models), models, strict=True):
        there = one.included < own
        at, more = one.included[there], np.zeros(own)
        other, wider = _fit_other_model(null, one, reported, prior)
        change = other[there] - estimate[at]
        more[at] = np.maximum(np.diag(wider)[there] - np.diag(covariance)[at], 0.0) + change**2
        for term in null.terms:
            if one.kinds & _effect_family(term.effect):
                more[term.columns] = 0.0
        added += weight * more
    return np.asarray(np.sqrt(added) / null.scale[:own])


def draw_models(
    null: NullModel, models: Sequence[OtherModel], into: Array, rng: np.random.Generator
) -> Array:
    """Return by what likely models differ from the chosen one: (N, SAMPLES), each by its weight.

    into (N, X): makes a richer model's parameters of the coefficients of all columns, normalized.
    Most samples are none where the chosen model is much the likeliest: a covariance would have all
    of them a little off.  Unlike in `model_uncertainty` every parameter counts, with what others
    do in its place: together they say how far a prediction is off.
    """
    reported, own = np.eye(len(null.scale)), null.included_columns
    prior = _prior_information(null)
    for form, effect in enumerate(null.fixed.forms.effects):
        at = null.form_columns(form)
        prior[at, at] += null.physical_precision(at, effect)
    size = np.maximum(np.abs(into).max(axis=1, initial=0.0), 1e-300)
    into = into / size[:, None]
    estimate, covariance, _ = _estimate(null.information, own, reported)
    base, known = into[:, own] @ estimate, into[:, own] @ covariance @ into[:, own].T
    drawn = []
    for count, one in zip(rng.multinomial(SAMPLES, model_weights(models)), models, strict=True):
        if not count:
            continue
        values, wider = _fit_other_model(null, one, reported, prior)
        step = into[:, one.included]
        root = symmetric_root(step @ wider @ step.T - known)
        change = step @ values - base
        drawn.append(change[:, None] + root @ rng.standard_normal((len(root), count)))
    return np.asarray(np.concatenate(drawn, axis=1) * size[:, None])


def model_weights(models: Sequence[OtherModel]) -> Array:
    """Return how probable each of the models is."""
    return np.asarray(special.softmax([model.criterion / 2 for model in models]))


def _prior_information(null: NullModel) -> Array:
    """Return the prior information (X, X), normalized, of effects that are not in the model."""
    prior = np.zeros(len(null.information))
    for form, effect in enumerate(null.fixed.forms.effects):
        prior[null.form_columns(form)] = null.prior_precision(null.form_columns(form), effect)
    return np.diag(prior)


def _fit_other_model(
    null: NullModel, model: OtherModel, reported: Array, prior: Array
) -> tuple[Array, Array]:
    """Return estimates (m,) and their covariance (m, m), normalized, by another model."""
    at = model.included[model.included < null.column_count]
    estimate, covariance, _ = _estimate(
        null.restrict_information(null.information, at) + prior, model.included, reported
    )
    return estimate, covariance


def _is_likely(tests: EffectTests, least: float, score: Score) -> bool:
    return tests.log_odds(score) > least


def likely_models(null: NullModel, averaged_kinds: Collection[str] = ()) -> list[OtherModel]:
    """Return the chosen model, those with an effect exchanged, and larger, likelier ones of each.

    The likeliest of those at hand is extended first, and so many are enough.
    averaged_kinds: kinds of effects that are added to none.
    """
    tests, found = EffectTests(null), dict[frozenset[int], OtherModel]()
    chosen = OtherModel(0.0, null.included_columns, frozenset())
    waiting = {frozenset[int](): chosen, **dict(_exchange_effects(null))}
    while waiting and len(found) < _MAX_MODELS:
        forms, model = max(waiting.items(), key=lambda item: item[1].criterion)
        found[forms] = waiting.pop(forms)
        for candidate in tests.candidates(
            model.included, per_frame=False, worth=partial(_is_likely, tests, 0.0)
        ):
            kinds, gain = _effect_family(candidate.effect), tests.log_odds(candidate.score)
            if model.kinds & kinds or {*candidate.effect.kinds} & {*averaged_kinds}:
                continue
            if (larger := forms | {candidate.form}) not in found:
                columns = np.concatenate([model.included, null.form_columns(candidate.form)])
                waiting[larger] = OtherModel(model.criterion + gain, columns, model.kinds | kinds)
    # The chosen one is among them, however many are likelier.
    return [*{frozenset[int](): chosen, **found}.values()]


def _exchange_effects(null: NullModel) -> Iterator[tuple[frozenset[int], OtherModel]]:
    """Yield models with another effect in the place of one, by what is gone (~i) and the form.

    Beside other effects of the recording intrinsics mean something else: those stay as they are.
    """
    tests = EffectTests(null)
    for i, term in enumerate(null.terms):
        effect, columns = term.effect, term.columns
        if not _is_lasting(effect):
            continue
        rest = np.setdiff1d(null.included_columns, columns)
        score = tests.score_beside(rest, columns)
        lost = tests.log_odds(score)
        least = lost - _ODDS_WINDOW
        for candidate in tests.candidates(
            rest, per_frame=False, worth=partial(_is_likely, tests, least)
        ):
            kinds = frozenset(candidate.effect.kinds)
            gain = tests.log_odds(candidate.score) - lost
            if _is_lasting(candidate.effect) and not null.effect_kinds & kinds:
                included = np.concatenate([rest, null.form_columns(candidate.form)])
                yield (
                    frozenset({~i, candidate.form}),
                    OtherModel(gain, included, kinds | set(effect.kinds)),
                )


def _effect_family(effect: Effect) -> set[str]:
    """Return the kinds of an effect, and of a more common one that does nearly the same."""
    alike = effect.rarer_than or effect.name
    return {*effect.kinds, *(kind.replace(effect.name, alike) for kind in effect.kinds)}


def _is_lasting(effect: Effect) -> bool:
    return not (effect.per_frame or effect.of_recording)


@dataclass(frozen=True)
class LensCovariance:
    """Parameters of the written lens, and of effects of a lens that other likely models have.

    linear: the written model, with these effects at zero after its own; covariance (N, N) of all
    that it shares, by the chosen model; others (N, SAMPLES): by what they are off where another
    model is true, drawn; ratios (K,): by how much standard errors are larger than by the chosen
    model, as frames left out say; place (K,): where what that model shares stands among the N;
    freedom: degrees of freedom of the size of these errors.
    """

    linear: Linearization
    covariance: Array
    others: Array
    ratios: Array
    place: Index
    freedom: float = inf

    @classmethod
    def from_model(
        cls, null: NullModel, averaged: AveragedModel, models: list[OtherModel] | None
    ) -> LensCovariance:
        """Gather what is known of a written model; models: None where time matters most.

        What few frames left out say is a sample, too: it counts beside a prior that the errors are
        as the model has them, worth `_PRIOR_FREEDOM` frames.
        Source: Smyth, Linear models and empirical Bayes methods for assessing differential
        expression, Statistical Applications in Genetics and Molecular Biology 3 (2004).
        """
        own, quick = null.included_columns, models is None
        inverse = pseudo_inverse(null.information[np.ix_(own, own)], 1e-13)
        least = inverse / np.outer(null.scale[own], null.scale[own])
        known = np.maximum(np.sqrt(np.diag(least)), 1e-300)
        errors = np.nan_to_num(standard_errors(null, jackknife=not quick))
        clusters = float(cluster_frames(null.linear).max())  # less one
        freedom = clusters + _PRIOR_FREEDOM
        squares = np.maximum(errors / known, 1.0) ** 2
        ratios = np.sqrt((clusters * squares + _PRIOR_FREEDOM) / freedom)
        if not quick:
            ratios = np.hypot(ratios, np.nan_to_num(field_uncertainty(null)) / known)
        ratios = np.where(np.diag(least) > 0, ratios, 0.0)
        rng = np.random.default_rng(_SEED)
        others = averaged.draw_shifts(rng, SAMPLES)
        covariance = np.zeros((len(others), len(others)))
        covariance[np.ix_(averaged.place, averaged.place)] = least * np.outer(ratios, ratios)
        alone = cls(averaged.linear, covariance, others, ratios, averaged.place, freedom)
        return alone if models is None else alone.with_other_models(null, models, rng)

    def with_other_models(
        self, null: NullModel, models: list[OtherModel], rng: np.random.Generator
    ) -> LensCovariance:
        """Add what other likely models say, those whose effects of the lens can be added."""
        state = self.linear.state
        for form in _likely_forms(null, models):
            richer = with_effect(state, null.fixed.forms.effects[form])
            # A form with fewer parameters takes the place of a richer one of the same effect.
            if _effect_names(state) <= _effect_names(richer):
                state = richer
        linear = Linearization(self.linear.data, state, self.linear.free)
        names = shared_names(linear)
        first = np.array([names.index(name) for name in shared_names(self.linear)], dtype=int)
        place = first[self.place]
        into, own = np.zeros((len(names), len(null.scale))), null.included_columns
        into[place, own] = 1 / null.scale[own]
        missing: set[int] = set()
        for form, effect in enumerate(null.fixed.forms.effects):
            columns, theirs = null.form_columns(form), parameter_names(effect)
            if set(theirs) <= set(names):
                into[[names.index(name) for name in theirs], columns] = 1 / null.scale[columns]
            elif _is_of_lens(effect):
                missing.update(columns.tolist())
        models = [model for model in models if missing.isdisjoint(model.included.tolist())]
        covariance = np.zeros((len(names), len(names)))
        covariance[np.ix_(first, first)] = self.covariance
        others = rng.permutation(draw_models(null, models, into, rng), axis=1)
        others[first] += self.others
        return replace(self, linear=linear, covariance=covariance, others=others, place=place)

    def with_field(self, known: CameraField) -> tuple[Array, Array]:
        """Return the covariance (2 Q, 2 Q), px^2, of a field; with what is shared (N, 2 Q)."""
        cross = np.zeros((len(self.covariance), len(known.root)))
        cross[self.place] = self.ratios[:, None] * known.shared @ known.root.T
        return known.root @ known.root.T, cross


def _effect_names(state: RigState) -> set[str]:
    return {name for term in state.terms for name in parameter_names(term.effect)}


def _is_of_lens(effect: Effect) -> bool:
    """Whether a lens holds an effect, so that it moves its rays."""
    return effect.stage not in ('target', 'noise') and not (
        effect.of_recording or effect.per_frame or effect.of_target
    )


def _likely_forms(null: NullModel, models: list[OtherModel]) -> list[int]:
    """Return forms of effects of a lens that other likely models have, the likeliest of a kind.

    None that is only ever positive (the thickness of a port): it has no derivative at zero, and
    look-alikes that have one.
    """
    weights = model_weights(models)
    found: dict[frozenset[str], tuple[float, int]] = {}
    for form, effect in enumerate(null.fixed.forms.effects):
        if not _is_of_lens(effect) or any(parameter.positive for parameter in effect.parameters):
            continue
        has = [np.isin(null.form_columns(form), model.included).all() for model in models]
        weight, kinds = float(weights @ has), frozenset(effect.kinds)
        if weight > max(_MIN_WEIGHT, found.get(kinds, (0.0, 0))[0]):
            found[kinds] = weight, form
    return [form for _, form in found.values()]
