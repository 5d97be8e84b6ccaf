"""The lens that is written: the mean over all likely models, and by what it may be off.

What is too weak to be named may still be likely, and a lens without it has intrinsics that stand
in for it.  What is named stays a decision; what is written is the mean over all likely models
(`posterior`), of their effects of the lens and of its intrinsics.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy import special

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.diagnosis.model_errors import ModelErrors, parameter_names, shared_names
from fisheye_svp_ros.diagnosis.null_model import NullModel
from fisheye_svp_ros.diagnosis.posterior import EffectPosterior
from fisheye_svp_ros.effects.base import Effect
from fisheye_svp_ros.mixed_model import (
    Models,
    Products,
    estimate_models,
    log_evidence,
    pseudo_inverse,
)
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.solve.rig_state import Linearization, RigState, with_effect

_LEAST = 0.05  # probability of an effect below which it moves no ray worth counting


class AveragedEffect(NamedTuple):
    """An effect of the lens that is written and not named: its form, and its probability.

    values, stderr (P,): means over all models, those without it too, and standard errors within
    and between them.
    """

    effect: Effect
    weight: float
    values: Array
    stderr: Array

    @property
    def parameters(self) -> dict[str, dict[str, Any]]:
        """Value, standard error and unit of each parameter, by name."""
        parameters = zip(self.effect.parameters, self.values, self.stderr, strict=True)
        return {
            one.name: {'value': float(value), 'stderr': float(stderr), 'unit': one.unit}
            for one, value, stderr in parameters
        }

    def to_dict(self) -> dict[str, Any]:
        """Return what diagnosis.json and the lens file hold."""
        return {
            'effect': self.effect.name,
            'probability': self.weight,
            'parameters': self.parameters,
        }


class Refit(NamedTuple):
    """Means over the models by other frames, for the border's columns (m,) of `AveragedModel`.

    values (m - 1,): normalized; combination (m,): that is the residual then; products: of what is
    always there, and where that and the rest stand among the m.
    """

    values: Array
    combination: Array
    products: Products
    always: Index
    others: Index

    def with_effects_of(self, one: Refit) -> Array:
        """Return what is always there (K,) with the effects that another one has."""
        return np.asarray(self.products.fixed - self.products.follow @ one.values[self.others])


@dataclass(frozen=True)
class AveragedModel:
    """A fitted model with all that is likely beside it.

    models: M, those whose effects of the lens it can have; begin: its state with these at zero;
    place (K,): where what the model shares stands among the N that this one does; changes (M, N),
    covariances (M, N, N): of the models, from `begin`; mean: over them, of all coefficients, as
    `Estimates` has them.
    """

    posterior: EffectPosterior
    models: Models
    begin: RigState
    place: Index
    changes: Array
    covariances: Array
    mean: Array

    @classmethod
    def of_posterior(cls, posterior: EffectPosterior) -> AveragedModel:
        """Average over the likely models of a posterior."""
        null, begin = posterior.null, _with_likely_effects(posterior)
        names = shared_names(null.linear, begin)
        into, missing = _into_parameters(posterior, names)
        models = _comparable_models(posterior, missing)
        values = np.zeros((len(models.weight), len(names)))
        covariances = np.zeros((*values.shape, len(names)))
        mean = np.zeros(into.shape[1])
        for base in np.unique(models.base):
            mine = models.base == base
            found = posterior.estimate(models.there[mine], base, into)
            mean += models.weight[mine] @ found.values
            values[mine] = found.values @ into.T
            covariances[mine] = found.covariance
        place = np.array([names.index(name) for name in shared_names(null.linear)], dtype=np.int64)
        before = np.zeros(len(names))
        for term in posterior.open_terms:
            before[place[term.columns]] = term.values
        return cls(posterior, models, begin, place, values - before, covariances, mean)

    @cached_property
    def change(self) -> Array:
        """The mean change (N,) from the state that it begins with."""
        return np.asarray(self.models.weight @ self.changes)

    @cached_property
    def linear(self) -> Linearization:
        """The state that is written, linearized; poses are not fitted anew."""
        linear = self.posterior.null.linear
        state = self.begin.retract(linear.free, np.zeros((linear.data.frames, 6)), self.change)
        return Linearization(linear.data, state, linear.free)

    @property
    def combination(self) -> Array:
        """The combination (X + 1,) of the border that is the residual beside the mean."""
        posterior = self.posterior
        combination = posterior.null.residual_combination(posterior.fixed)
        combination[np.append(posterior.fixed, posterior.columns)] -= self.mean
        return combination

    @cached_property
    def _few(self) -> Models:
        """The models that other frames are asked about: each once, whatever it stands beside."""
        likely = self.models.weight > _LEAST * self.models.weight.max()
        there = np.unique(self.models.there[likely], axis=0)
        return Models(there, np.zeros(len(there), dtype=int), np.full(len(there), 1 / len(there)))

    @cached_property
    def _few_columns(self) -> Index:
        """The columns of the posterior that these models have."""
        options = self.posterior.options
        used = self._few.there.any(axis=0)
        return np.unique(options.columns[used][options.sd[used] > 0])

    @cached_property
    def border(self) -> Index:
        """The columns (m,) of the border that the models are made of, the residual last."""
        return self.posterior.null.columns_and_residual(self.posterior.columns[self._few_columns])

    @cached_property
    def columns_of_lens(self) -> Mask:
        """Which of them (m - 1,) are of effects that a lens may have beside its own."""
        forms = [one.columns for one in self.posterior.forms if _is_of_lens(one.effect)]
        return np.isin(self.border[:-1], np.concatenate([np.zeros(0, int), *forms]))

    def refit(self, information: Array) -> Refit:
        """Average by other information (m, m) of `border`, each model by its evidence there."""
        posterior, at, few = self.posterior, self.border, self._few_columns
        null, options = posterior.null, posterior.options
        always = np.searchsorted(at, posterior.fixed)
        others = np.searchsorted(at, posterior.columns[few])
        products = Products.eliminating(
            null.restrict_information(information, posterior.fixed, at),
            always,
            others,
            null.full.rows - null.full.group_rank,
        )
        place = np.searchsorted(few, options.columns).clip(max=max(len(few) - 1, 0))
        options = options._replace(columns=place)
        weight = special.softmax(log_evidence(products, options, self._few.there))
        mean = weight @ estimate_models(products, options, self._few.there).values
        values = np.zeros(len(at) - 1)
        values[np.append(always, others)] = mean
        combination = null.residual_combination(posterior.fixed)[at]
        combination[:-1] -= values
        return Refit(values, combination, products, always, others)

    @cached_property
    def effects(self) -> tuple[AveragedEffect, ...]:
        """Effects of the lens that are written and not named."""
        state, found = self.linear.state, []
        named = {name for term in self.posterior.null.terms for name in term.effect.kinds}
        error = np.sqrt(np.diag(self.added_covariance()))
        names = shared_names(self.linear)
        for term in state.terms:
            if _is_of_lens(term.effect) and not named & {*term.effect.kinds}:
                at = [names.index(name) for name in parameter_names(term.effect)]
                weight = self.models.probability(self.posterior.has(term.name))
                found.append(AveragedEffect(term.effect, weight, term.values, error[at]))
        return tuple(found)

    def added_covariance(self) -> Array:
        """Return what the models beside the fitted one add to its covariance: (N, N)."""
        off = self.changes - self.change
        within = np.tensordot(self.models.weight, self._wider, 1)
        return np.asarray(within + (off.T * self.models.weight) @ off)

    @cached_property
    def _wider(self) -> Array:
        """By how much the covariances (M, N, N) of the models are larger than the fitted one's."""
        known = np.zeros(self.covariances.shape[1:])
        known[np.ix_(self.place, self.place)] = fitted_covariance(self.posterior.null)
        size, values, vectors = _scaled_eigh(self.covariances - known)
        wider = (vectors * np.maximum(values, 0.0)[:, None]) @ np.swapaxes(vectors, -1, -2)
        return np.asarray(wider * np.outer(size, size))

    def added_errors(self) -> Array:
        """Return what other models add to standard errors (K,) of what the fitted one shares.

        Parameters of an effect mean something in its form alone: other models do not count there.
        """
        weight = np.tile(self.models.weight[:, None], (1, len(self.place)))
        for term in self.posterior.open_terms:
            form = [one.effect == term.effect for one in self.posterior.forms]
            there = self.models.there[:, np.array(form)[self.posterior.form_of]].any(axis=1)
            weight[np.ix_(~there, term.columns)] = 0.0
        spread = np.diagonal(self.covariances, 0, 1, 2)[:, self.place]
        square = (weight * (spread + self.changes[:, self.place] ** 2)).sum(axis=0)
        square = square / np.maximum(weight.sum(axis=0), 1e-300)
        known = np.diag(fitted_covariance(self.posterior.null))
        return np.asarray(np.sqrt(np.maximum(square - known, 0.0)))

    def draw(self, rng: np.random.Generator, samples: int) -> Array:
        """Return by what the models put off all that is shared: (N, samples), each by its weight.

        Beside the covariance of the fitted model: most are none where that is the likeliest.
        """
        chosen = np.sort(rng.choice(len(self.models.weight), samples, p=self.models.weight))
        used, which = np.unique(chosen, return_inverse=True)
        size, values, vectors = _scaled_eigh(self._wider[used])
        root = size[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))[:, None]
        normal = rng.standard_normal((samples, len(size), 1))
        off = (self.changes - self.change)[chosen] + (root[which] @ normal)[..., 0]
        return np.asarray(rng.permutation(off).T)

    def errors(self, errors: ModelErrors) -> ModelErrors:
        """Return what is known of the errors of this model, from that of the fitted one."""
        covariance = self.added_covariance()
        covariance[np.ix_(self.place, self.place)] += errors.covariance
        return replace(errors, names=shared_names(self.linear), covariance=covariance)

    def to_dict(self) -> dict[str, Any]:
        """Return what diagnosis.json holds: nothing where nothing is written beside the causes."""
        effects = [one.to_dict() for one in self.effects]
        return {'averaged_effects': effects} if effects else {}

    def with_entry(self, lens: Lens, camera: str) -> Lens:
        """Return the lens of a camera with what is averaged in its `uncertainty`."""
        mine = [
            one.to_dict()
            for one in self.effects
            if not one.effect.cameras or camera in one.effect.cameras
        ]
        if not mine:
            return lens
        return replace(lens, uncertainty={**(lens.uncertainty or {}), 'averaged_effects': mine})


def _scaled_eigh(matrices: Array) -> tuple[Array, Array, Array]:
    """Return sizes (N,) and the eigenvalues and vectors of matrices (M, N, N) over these.

    Of parameters of different units: rounding of what is large is none of what is small.
    """
    size = np.sqrt(np.abs(np.diagonal(matrices, 0, 1, 2)).max(axis=0))
    size = np.where(size > 0, size, 1.0)
    return size, *np.linalg.eigh(matrices / np.outer(size, size))


def _is_of_lens(effect: Effect) -> bool:
    """Whether a lens holds an effect that moves its rays, whatever it looks at and however."""
    of_others = effect.of_recording or effect.per_frame or effect.of_target
    return effect.stage in ('pupil', 'ray', 'image') and not of_others


def _with_likely_effects(posterior: EffectPosterior) -> RigState:
    """Return the state with all likely effects of the lens, at zero, the likeliest form first."""
    state, models = posterior.null.linear.state, posterior.models
    weight = np.zeros(len(posterior.forms))
    np.add.at(weight, posterior.form_of, models.weight @ models.there)
    for form in np.argsort(-weight, kind='stable'):
        effect = posterior.forms[form].effect
        if (
            weight[form] > _LEAST
            and _is_of_lens(effect)
            and not any(parameter.positive for parameter in effect.parameters)
        ):
            richer = with_effect(state, effect)
            # A form that has not all parameters of one that is there takes not its place.
            if _effect_names(state) <= _effect_names(richer):
                state = richer
    return state


def _effect_names(state: RigState) -> set[str]:
    return {name for term in state.terms for name in parameter_names(term.effect)}


def _into_parameters(posterior: EffectPosterior, names: Sequence[str]) -> tuple[Array, Mask]:
    """Return what makes parameters of coefficients, and which options (O,) have none."""
    null, always = posterior.null, len(posterior.fixed)
    into = np.zeros((len(names), always + len(posterior.columns)))
    own = [shared_names(null.linear)[i] for i in posterior.fixed]
    into[[names.index(name) for name in own], np.arange(always)] = 1 / null.scale[posterior.fixed]
    missing = np.zeros(len(posterior.forms), dtype=bool)
    for i, (effect, columns) in enumerate(posterior.forms):
        theirs = parameter_names(effect)
        if {*theirs} <= {*names}:
            at = always + np.searchsorted(posterior.columns, columns)
            into[[names.index(name) for name in theirs], at] = 1 / null.scale[columns]
        else:
            missing[i] = _is_of_lens(effect)
    return into, missing[posterior.form_of]


def _comparable_models(posterior: EffectPosterior, missing: Mask) -> Models:
    """Return the models whose intrinsics mean what those of the state do.

    With no effects of a lens but what the state can have, of the recording those of the state.
    """
    models, terms = posterior.models, posterior.open_terms
    named = {term.name for term in terms if term.effect.of_recording}
    effects = [posterior.forms[form].effect for form in posterior.form_of]
    foreign = [one.of_recording and one.name not in named for one in effects]
    wrong = models.there[:, missing | np.array(foreign, dtype=bool)].any(axis=1)
    for name in named:
        wrong |= ~models.there[:, posterior.has(name)].any(axis=1)
    return posterior.fitted_models if wrong.all() else models.take(np.flatnonzero(~wrong))


def fitted_covariance(null: NullModel) -> Array:
    """Return the covariance (K, K) of what a null model shares, as it stands."""
    own = null.included_columns
    inverse = pseudo_inverse(null.information[np.ix_(own, own)], 1e-13)
    return np.asarray(inverse / np.outer(null.scale[own], null.scale[own]))
