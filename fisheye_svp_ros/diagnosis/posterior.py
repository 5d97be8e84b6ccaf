"""One posterior over models: which effects are there, beside what the search has found.

A model is a set of effects, each in one form and of one prior size.  What is always there (rig,
intrinsics, what the user knows of) and all random effects are eliminated; what is left of the
information of all forms gives the likely models in closed form (`mixed_model.find_models`).  A
smooth image field and walks of the intrinsics stand beside them as what has no name.
Source: Mitchell and Beauchamp (1988); Scott and Berger, Bayes and empirical-Bayes multiplicity
adjustment in the variable-selection problem, Annals of Statistics 38 (2010), for the odds before
the data; Liang et al., Mixtures of g priors for Bayesian variable selection, Journal of the
American Statistical Association 103 (2008), for the sizes.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.diagnosis.effect_tests import RARITY_ODDS, EffectTests
from fisheye_svp_ros.diagnosis.null_model import Alternative, NullModel
from fisheye_svp_ros.effects.base import Effect, ModelTerm
from fisheye_svp_ros.effects.ray_effects import ViewpointShiftEffect
from fisheye_svp_ros.effects.target_effects import TargetShapeEffect
from fisheye_svp_ros.mixed_model import (
    IDENTIFIABLE,
    Estimates,
    Models,
    Options,
    Products,
    estimate_models,
    find_models,
)

_SIZES = (1.0, 0.2, 0.04)  # of the coefficients, over what would be large: prior sd
_CONFOUNDED = 0.01  # probability above which an effect may stand in the place of another
_LIFT = 5.0  # times the odds beside another: so many without it, and it stands in for it
# Odds before the data of what lenses and boards have more often than not, or nearly so.
_COMMON_ODDS = {ViewpointShiftEffect.name: 0.3, TargetShapeEffect.name: 1.0}


class Form(NamedTuple):
    """One form of an effect, and its columns of the border."""

    effect: Effect
    columns: Index


@dataclass(frozen=True)
class EffectPosterior:
    """The likely models of a null model.

    fixed: columns of the border that are always there; forms: what models are made of, and for
    each option the place of its form (O,); columns (P,): of the border, that they have.
    """

    null: NullModel
    fixed: Index
    forms: tuple[Form, ...]
    form_of: Index
    columns: Index
    options: Options
    products: tuple[Products, ...]
    models: Models

    @classmethod
    def of_null_model(
        cls,
        null: NullModel,
        known: Collection[str] = (),
        refuted: Collection[str] = (),
        quick: bool = False,
    ) -> EffectPosterior:
        """Find the likely models.

        known: effects that are there whatever the data say; refuted: those that are not; quick:
        nothing without a name stands beside them.  Behind a port no viewpoint shifts: what it does
        is the port's.
        """
        if any(lens.port is not None for lens in null.linear.state.lenses):
            refuted = (*refuted, ViewpointShiftEffect.name)
        fixed, kept = _always_there(null, known)
        forms = tuple(_open_forms(null, fixed, kept, refuted))
        columns = np.unique(np.concatenate([np.zeros(0, int), *(one.columns for one in forms)]))
        options, form_of = _make_options(null, forms, columns)
        bases = tuple(
            _reduce(null, information, fixed, columns, odds - logs / 2)
            for (logs, information), odds in _alternatives(null, forms, quick)
        )
        models = find_models(bases, options, _models_of_state(null, forms))
        return cls(null, fixed, forms, form_of, columns, options, bases, models)

    @property
    def open_terms(self) -> list[ModelTerm]:
        """The effects in the null model that need not be there."""
        return [one for one in self.null.terms if not np.isin(one.columns, self.fixed).all()]

    def estimate(self, there: Mask, base: int, into: Array) -> Estimates:
        """Return what models (N, O) beside one of the products make of all that is shared.

        into (C, K + P): combinations of it that covariances are asked of.
        """
        return estimate_models(self.products[base], self.options, there, into)

    @property
    def fitted_models(self) -> Models:
        """The models with the effects of the null model, for want of likelier ones."""
        there = _models_of_state(self.null, self.forms)
        count = len(there)
        return Models(there, np.zeros(count, dtype=np.int64), np.full(count, 1 / count))

    @cached_property
    def names(self) -> list[str]:
        """The effect of each option."""
        return [self.forms[form].effect.name for form in self.form_of]

    def has(self, name: str) -> Mask:
        """Return which options (O,) are of an effect."""
        return np.array([one == name for one in self.names], dtype=bool)

    @cached_property
    def probabilities(self) -> dict[str, float]:
        """How probable each effect is that may be there."""
        return {
            name: self.models.probability(self.has(name)) for name in dict.fromkeys(self.names)
        }

    def probability_beside(self, name: str, others: Collection[str]) -> float | None:
        """Return how probable an effect is, or one of others; None where it is not asked for."""
        if name not in self.probabilities:
            return None
        chosen = [one == name or one in others for one in self.names]
        return self.models.probability(np.array(chosen, dtype=bool))

    def in_place_of(self, name: str) -> dict[str, float]:
        """Return how probable others are that stand in for an effect: there without it, mostly.

        Those that most models have once it is gone, and hardly any beside it.
        """
        gone = ~self.models.there[:, self.has(name)].any(axis=1)
        weight, found = self.models.weight, {}
        named = {term.name for term in self.null.terms}
        for other in sorted({*self.probabilities} - named):
            there = self.models.there[:, self.has(other)].any(axis=1)
            instead, beside = float(weight @ (there & gone)), float(weight @ (there & ~gone))
            absent = float(weight @ (~there & gone)), float(weight @ (~there & ~gone))
            if instead > _CONFOUNDED and (instead * absent[1] > _LIFT * beside * absent[0]):
                found[other] = instead
        return found


def _always_there(null: NullModel, known: Collection[str]) -> tuple[Index, set[str]]:
    """Return the columns that are always there and the kinds of effects among them."""
    kept = list[ModelTerm]()
    open_columns = [np.zeros(0, dtype=np.int64)]
    for term in null.terms:
        if term.effect.per_frame or term.effect.asked_last or term.name in known:
            kept.append(term)
        else:
            open_columns.append(term.columns)
    fixed = np.setdiff1d(null.included_columns, np.concatenate(open_columns))
    return fixed, {kind for term in kept for kind in _family(term.effect)}


def _open_forms(
    null: NullModel, fixed: Index, kept: Collection[str], refuted: Collection[str]
) -> Iterator[Form]:
    """Yield the forms of effects that may be there, and that what is always there leaves open.

    What is in the model in a form that is not tested, joined or stated, may be there as it is.
    """
    every = np.arange(len(null.scale))
    left = _reduce(null, null.factorization.information, fixed, every, 0.0).matrix
    tested = [
        Form(effect, null.form_columns(form))
        for form, effect in enumerate(null.fixed.forms.effects)
    ]
    known = {form.effect for form in tested}
    own = [Form(term.effect, term.columns) for term in null.terms if term.effect not in known]
    for form in (*tested, *own):
        is_open = np.linalg.eigvalsh(left[np.ix_(form.columns, form.columns)])[-1] > IDENTIFIABLE
        effect = form.effect
        if is_open and not (
            effect.per_frame or {*kept} & _family(effect) or effect.name in refuted
        ):
            yield form


def _reduce(
    null: NullModel, information: Array, fixed: Index, columns: Index, logs: float
) -> Products:
    """Return products of columns of the border beside what is always there; logs: likelihood."""
    rows = null.full.rows - null.full.group_rank
    information = null.restrict_information(information, fixed)
    return Products.eliminating(information, fixed, columns, rows, logs)


def _make_options(null: NullModel, forms: Sequence[Form], columns: Index) -> tuple[Options, Index]:
    """Return all forms in all sizes, columns by their place among some, and the form of each."""
    width = max((len(form.columns) for form in forms), default=1)
    place, sd = np.zeros((len(forms), width), dtype=np.int64), np.zeros((len(forms), width))
    for i, form in enumerate(forms):
        count = len(form.columns)
        place[i, :count] = np.searchsorted(columns, form.columns)
        sd[i, :count] = _large(null, form) / null.variances.sigma
    form_of = np.repeat(np.arange(len(forms)), len(_SIZES))
    kinds = [_family(form.effect) for form in forms]
    conflict = np.array([[bool(a & b) for b in kinds] for a in kinds]).reshape(2 * (len(forms),))
    positive = np.array(
        [len(form.columns) == 1 and form.effect.parameters[0].positive for form in forms],
        dtype=bool,
    )
    sizes = np.tile(_SIZES, len(forms))
    return Options(
        place[form_of],
        sd[form_of] * sizes[:, None],
        (_log_odds(null, forms) - np.log(len(_SIZES)))[form_of],
        positive[form_of],
        conflict[np.ix_(form_of, form_of)],
    ), form_of


def _family(effect: Effect) -> set[str]:
    """Return the kinds of an effect, and of a more common one that does nearly the same."""
    alike = effect.rarer_than or effect.name
    return {*effect.kinds, *(kind.replace(effect.name, alike) for kind in effect.kinds)}


def _models_of_state(null: NullModel, forms: Sequence[Form]) -> Mask:
    """Return the models (sizes, O) with the effects that the null model has, one of each size."""
    terms = [term.effect for term in null.terms]
    own = np.array([form.effect in terms for form in forms], dtype=bool)
    sizes = np.eye(len(_SIZES), dtype=bool)
    return (own[:, None] & sizes[:, None]).reshape(len(_SIZES), -1)


def _large(null: NullModel, form: Form) -> Array:
    """Return what would be large (P,) of the normalized coefficients of a form."""
    large = np.array([parameter.large for parameter in form.effect.parameters])
    scene = null.linear.scene
    size = np.minimum(large, form.effect.prior_sigma(scene))
    return np.asarray(size * null.scale[form.columns], dtype=float)


def _log_odds(null: NullModel, forms: Sequence[Form]) -> Array:
    """Return the log odds (forms,) before the data: one of all effects, in any of its forms."""
    count = max(EffectTests(null).effect_count, 1)
    names = [form.effect.name for form in forms]
    rare = [bool(one.effect.rarer_than) for one in forms]
    odds = [_COMMON_ODDS.get(name, 1 / count) / names.count(name) for name in names]
    return np.log(odds) - RARITY_ODDS / 2 * np.array(rare, dtype=bool)


def _alternatives(
    null: NullModel, forms: Sequence[Form], quick: bool
) -> Iterator[tuple[Alternative, float]]:
    """Yield what else there may be, with its log odds before the data: fields, walks."""
    yield (null.factorization.log_determinant, null.factorization.information), 0.0
    if quick:
        return
    fields = null.field_alternatives[1:]
    for one in fields:
        yield one, -float(np.log(len(fields)))
    if any(form.effect.of_recording for form in forms):
        walks = null.walk_alternatives
        for one in walks:
            yield one, -float(np.log(len(walks) * max(EffectTests(null).effect_count, 1)))
