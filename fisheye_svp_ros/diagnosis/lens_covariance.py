"""What is known of the parameters of the lens that is written, in every model that is likely."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.evaluation import Evaluation
from fisheye_svp_ros.diagnosis.image_fields import CameraField
from fisheye_svp_ros.diagnosis.model_errors import parameter_names, shared_names
from fisheye_svp_ros.diagnosis.null_model import NullModel
from fisheye_svp_ros.diagnosis.uncertainty import (
    OtherModel,
    field_uncertainty,
    model_covariance,
    model_weights,
    standard_errors,
)
from fisheye_svp_ros.effects.base import Effect
from fisheye_svp_ros.mixed_model import pseudo_inverse
from fisheye_svp_ros.solve.rig_state import Linearization, RigState, with_effect

_MIN_WEIGHT = 0.01  # probability of an effect below which it moves no ray worth counting


@dataclass(frozen=True)
class LensCovariance:
    """Parameters of the written lens, and of effects of a lens that other likely models have.

    linear: the written model, with these effects at zero after its own; covariance (N, N) of all
    that it shares; ratios (K,): by how much standard errors are larger than by the chosen model,
    as frames left out say; place (K,): where what that model shares stands among the N.
    """

    linear: Linearization
    covariance: Array
    ratios: Array
    place: Index

    @classmethod
    def from_evaluation(cls, evaluation: Evaluation) -> LensCovariance:
        """Gather what an evaluation knows."""
        null, averaged = evaluation.null, evaluation.averaged_model
        quick = evaluation.selection.problem.options.quick
        own = null.included_columns
        inverse, _ = pseudo_inverse(null.information[np.ix_(own, own)], 1e-13)
        least = inverse / np.outer(null.scale[own], null.scale[own])
        known, errors = np.sqrt(np.diag(least)), standard_errors(null, jackknife=not quick)
        if not quick:
            errors = np.hypot(errors, field_uncertainty(null))
        larger = np.nan_to_num(errors) / np.maximum(known, 1e-300)
        ratios = np.where(known > 0, np.maximum(larger, 1.0), 0.0)
        alone = cls(averaged.linear, averaged.widen(least * np.outer(ratios, ratios)), ratios,
                    averaged.place)
        return alone if quick else alone.with_other_models(null, evaluation.other_models)

    def with_other_models(self, null: NullModel, models: list[OtherModel]) -> LensCovariance:
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
            columns, theirs = null.form_columns(form), parameter_names((effect, np.zeros(0)))
            if set(theirs) <= set(names):
                into[[names.index(name) for name in theirs], columns] = 1 / null.scale[columns]
            elif _is_of_lens(effect):
                missing.update(columns.tolist())
        models = [one for one in models if missing.isdisjoint(one.included.tolist())]
        covariance = model_covariance(null, models, into)
        covariance[np.ix_(first, first)] += self.covariance
        return replace(self, linear=linear, covariance=covariance, place=place)

    def with_field(self, known: CameraField) -> tuple[Array, Array]:
        """Return the covariance (2 Q, 2 Q), px^2, of a field; with what is shared (N, 2 Q)."""
        cross = np.zeros((len(self.covariance), len(known.root)))
        cross[self.place] = self.ratios[:, None] * known.shared @ known.root.T
        return known.root @ known.root.T, cross


def _effect_names(state: RigState) -> set[str]:
    return {name for term in state.terms for name in parameter_names(term)}


def _is_of_lens(effect: Effect) -> bool:
    """Whether a lens holds an effect, so that it moves its rays."""
    return (effect.stage not in ('target', 'noise')
            and not (effect.of_recording or effect.per_frame or effect.of_target))


def _likely_forms(null: NullModel, models: list[OtherModel]) -> list[int]:
    """Return forms of effects of a lens that other likely models have, the likeliest of a kind.

    None that is only ever positive (the thickness of a port): it has no derivative at zero, and
    look-alikes that have one.
    """
    weights = model_weights(models)
    found: dict[frozenset[str], tuple[float, int]] = {}
    for form, effect in enumerate(null.fixed.forms.effects):
        if not _is_of_lens(effect) or any(one.positive for one in effect.parameters):
            continue
        has = [np.isin(null.form_columns(form), one.included).all() for one in models]
        weight, kinds = float(weights @ has), frozenset(effect.kinds)
        if weight > max(_MIN_WEIGHT, found.get(kinds, (0.0, 0))[0]):
            found[kinds] = weight, form
    return [form for _, form in found.values()]
