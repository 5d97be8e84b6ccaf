"""Sixth stage, the evaluation: what was found, measured on data that took no part in finding it.

Held-out residuals, shares of variance, errors of parameters, gains with their intervals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.diagnosis.averaging import AveragedModel
from fisheye_svp_ros.diagnosis.causes import Cause, medium_cause, selected_causes
from fisheye_svp_ros.diagnosis.checks.medium import Medium, stated_parameters
from fisheye_svp_ros.diagnosis.cross_validation import (
    Comparison,
    Ends,
    HeldOut,
    HeldOutData,
    cross_validate,
    fit_without_causes,
    gain_and_confidence,
    predict_other_data,
    refuting_blocks,
    valid_state,
)
from fisheye_svp_ros.diagnosis.effect_tests import EffectTests
from fisheye_svp_ros.diagnosis.fitted_model import FittedModel, PredictedOffsets
from fisheye_svp_ros.diagnosis.model_errors import ModelErrors, shared_names
from fisheye_svp_ros.diagnosis.null_model import NullModel
from fisheye_svp_ros.diagnosis.posterior import EffectPosterior
from fisheye_svp_ros.diagnosis.problem import Problem, extended_lenses
from fisheye_svp_ros.diagnosis.selection import Selection, known_effects
from fisheye_svp_ros.diagnosis.similar_views import similar_views
from fisheye_svp_ros.diagnosis.uncertainty import LensCovariance, standard_errors, total_errors
from fisheye_svp_ros.diagnosis.variance_budget import (
    Component,
    cause_squares,
    component_significance,
    noise_px,
    scatter_px,
    variance_budget,
)
from fisheye_svp_ros.diagnosis.written_lens import WrittenField
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.mixed_model import run_in_threads
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.solve.bundle_adjustment import adjust, adjust_poses
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.rig_state import Linearization, RigState, is_shared

MAX_RMS_RATIO = 1.01  # a rise by less is none: noise that grows with the angle has weights


@dataclass(frozen=True)
class FitQuality:
    """How well a model describes the data it was fitted to and the data held out."""

    rms_px: float
    heldout_rms_px: float
    chi2_per_dof: float | None = None


class Figures(NamedTuple):
    """How well each model describes the data: rms of the fit and held out.

    base: the simulation as it was fitted; named: all causes, without random effects; lens_only:
    what moves with the lens; extended: causes and predicted random effects; gain: of the last
    over the first, on held-out data.
    """

    base: FitQuality
    named: FitQuality
    lens_only: FitQuality
    extended: FitQuality
    gain: Comparison


@dataclass(frozen=True)
class Intrinsic:
    """One intrinsic before and after, each with its standard error under the null model.

    given: as the lens had it, with the error that its file states or 0; before: fitted to these
    data; after: with the causes.
    """

    given: float
    given_stderr: float
    before: float
    before_stderr: float
    after: float
    after_stderr: float


@dataclass(frozen=True)
class Evaluation:
    """Figures of a selection.

    offsets: predicted, with what repeats in similar views; noise_px: of a coordinate; held_out:
    other frames, None for frames left out one by one; medium: the cause that was found before the
    selection, if there is one.
    """

    selection: Selection
    fitted: FittedModel
    offsets: PredictedOffsets
    noise_px: float
    held_out: HeldOutData | None
    medium: Medium | None

    @classmethod
    def of_selection(cls, selection: Selection, medium: Medium | None) -> Evaluation:
        """Evaluate a selection."""
        null, held_out = selection.null, selection.problem.inputs.held_out

        def prepare_held_out() -> HeldOutData | None:
            return None if held_out is None else HeldOutData.prepare(held_out, null.linear)

        # Frames left out one by one are asked for next, and remembered.
        test, _ = run_in_threads(prepare_held_out, lambda: cross_validate(null))
        fitted = FittedModel.solve_null_model(null)
        views = similar_views(fitted.linear, fitted.residuals())
        offsets = fitted.predicted_offsets()._replace(views=views)
        noise = noise_px(null)
        if views is not None:
            noise *= float(np.sqrt(1 - views.share))
        return cls(selection, fitted, offsets, noise, test, medium)

    @property
    def null(self) -> NullModel:
        """The null model around the state with the causes."""
        return self.selection.null

    @property
    def problem(self) -> Problem:
        """The data, and the simulation as it was fitted to them."""
        return self.selection.problem

    @property
    def free(self) -> tuple[str, ...]:
        """The intrinsics that were fitted."""
        return self.problem.free

    @property
    def names(self) -> list[str]:
        """The names of the causes that move predictions."""
        return [cause.name for cause in self.selection.causes]

    @cached_property
    def averaged_model(self) -> AveragedModel:
        """The model whose lens is written: with the effects that may be there."""
        return AveragedModel.of_posterior(self.posterior)

    @cached_property
    def posterior(self) -> EffectPosterior:
        """The likely models, with all that the user knows of."""
        selection = self.selection
        return EffectPosterior.of_null_model(
            selection.null,
            known_effects(selection.problem),
            selection.refuted,
            self.problem.options.quick,
        )

    @cached_property
    def written_field(self) -> WrittenField | None:
        """The image field that is written, or why it is not; None where none is predicted."""
        return WrittenField.from_model(self.averaged_model, self.fitted)

    @cached_property
    def model_errors(self) -> ModelErrors:
        """What is known of the errors of the model whose lens is written."""
        return self.averaged_model.errors(ModelErrors.from_null_model(self.null, self.fitted))

    @cached_property
    def written_model(self) -> Linearization:
        """The model whose lens is written, without random effects: poses are fitted anew."""
        return _with_poses_anew(self.averaged_model.linear)

    def extended_lenses(self, state: RigState) -> dict[str, Lens]:
        """Return the lenses of a state, with its effects, for every command and node."""
        problem = self.problem
        return extended_lenses(problem.inputs.lenses, state, problem.observations)

    @cached_property
    def uncertainty(self) -> dict[str, dict[str, float]]:
        """How far off poses and image points are by the lens that is written: a summary."""
        return self.model_errors.summary(self.written_model)

    @cached_property
    def lens_covariance(self) -> LensCovariance:
        """What is known of the parameters of the lens that is written."""
        quick = self.problem.options.quick
        return LensCovariance.from_model(self.null, self.averaged_model, quick)

    @cached_property
    def errors(self) -> Array:
        """Standard errors of all that is shared."""
        return self._errors_of(self.null, self.averaged_model)

    def _errors_of(self, null: NullModel, averaged: AveragedModel | None = None) -> Array:
        return (
            standard_errors(null, jackknife=False)
            if self.problem.options.quick
            else total_errors(null, averaged)
        )

    @cached_property
    def _own_errors(self) -> Array:
        """Standard errors of all that is shared, by the fitted model alone."""
        return standard_errors(self.null, jackknife=not self.problem.options.quick)

    def predict(
        self, without: Sequence[str] = (), offsets: PredictedOffsets | None = None
    ) -> HeldOut:
        """Predict held-out frames without some causes, with or without random effects."""
        if offsets is not None:
            return self._predict(without, offsets)
        # Confirmation, the causes' gains and the figures ask for the same ones.
        named = frozenset(without)
        if named not in self._predictions:
            self._predictions[named] = self._predict(without)
        return self._predictions[named]

    @cached_property
    def _predictions(self) -> dict[frozenset[str], HeldOut]:
        """What was predicted without random effects, by the causes that were left out."""
        return {}

    def _predict(self, without: Sequence[str], offsets: PredictedOffsets | None = None) -> HeldOut:
        test, selection = self.held_out, self.selection
        if test is None:
            return cross_validate(self.null, without, offsets).take(self.counted_frames)
        if set(without) >= set(self.names):
            state = selection.problem.base
        elif without:
            state = fit_without_causes(self.null, without, self.free)
        else:
            state = selection.null.linear.state
        state = valid_state(state, test.data, self.null.linear.data, test.another_target)
        if offsets is not None and test.another_target:
            offsets = offsets.of_image
        # Each model with its own rig: that of another one counts as an error of its lenses.
        return predict_other_data(test.data, replace(state, pose=test.pose), offsets)

    @cached_property
    def counted_frames(self) -> Mask:
        """Which frames (F,) count where each is left out one by one: what any model predicts."""
        with_causes, without = cross_validate(self.null), cross_validate(self.null, self.names)
        return with_causes.is_predictable | without.is_predictable

    @property
    def _base_prediction(self) -> HeldOut:
        return self.predict(self.names)

    @cached_property
    def _given_prediction(self) -> HeldOut:
        if self.medium is None:
            return self._base_prediction
        if self.held_out is None:
            return self.medium.cross_validate().take(self.counted_frames)
        return predict_other_data(
            self.held_out.data, replace(self.medium.air.state, pose=self.held_out.pose)
        )

    @cached_property
    def as_given_px(self) -> float | None:
        """Rms of held-out frames by the lenses as written, px; only their rig is fitted.

        None without such frames, or where the figure before is that of the lenses as written.
        """
        test, problem = self.held_out, self.problem
        if test is None or self.medium is not None or not self.free:
            return None
        data, lenses = problem.data, tuple(problem.inputs.lenses.values())
        state = adjust(data, initial_state(data, lenses[0], lenses[1:]), ())
        state = valid_state(state, test.data, data, test.another_target)
        return predict_other_data(test.data, replace(state, pose=test.pose)).rms

    @property
    def _cause_predictions(self) -> list[HeldOut]:
        """Predictions with the first 0, 1, ... causes."""
        return [
            self._base_prediction,
            *(self.predict(self.names[i + 1 :]) for i in range(len(self.names))),
        ]

    @cached_property
    def _extended_prediction(self) -> HeldOut:
        return self.predict(offsets=self.offsets)

    @property
    def _lens_prediction(self) -> HeldOut:
        return self.predict(self._not_of_lens)

    @property
    def _not_of_lens(self) -> list[str]:
        return [name for name in self.names if CATALOGUE[name].budget_stage() != 'lens']

    @property
    def _noise_square(self) -> float:
        """Variance of whitened noise: 1 where the table states sigma, else as it was estimated."""
        stated = np.isfinite(self.null.linear.data.observations.sigma).all()
        return 1.0 if stated else self.null.variances.sigma**2

    @property
    def scatter_px(self) -> float:
        """Standard deviation of noise and what repeats in similar views, of one coordinate, px."""
        return scatter_px(self.null)

    @property
    def simulation(self) -> Linearization:
        """The simulation as it was fitted."""
        return self.problem.linear if self.medium is None else self.medium.air

    @cached_property
    def fixed_model(self) -> Linearization:
        """The causes without random effects: poses, which these had moved, are fitted anew."""
        return _with_poses_anew(self.null.linear)

    @cached_property
    def cause_fit(self) -> Linearization:
        """The named causes fitted as the simulation was, by least squares without random effects.

        All points count alike in both: the rms on the fitted frames says what the causes bring.
        """
        if self.medium is not None:
            return self.fixed_model  # the lens as it is in air was no free fit either
        start = self.null.linear.state
        return self._adjust(
            replace(start, terms=tuple(t for t in start.terms if is_shared(t.effect)))
        )

    def _adjust(self, state: RigState) -> Linearization:
        """Return a state fitted by least squares."""
        data = self.null.linear.data
        return Linearization(data, adjust(data, state, self.free), self.free)

    @property
    def falling(self) -> bool:
        """Whether the rms of the fitted frames falls from base to named to extended."""
        sizes = [
            quality.rms_px
            for quality in (self.figures.base, self.figures.named, self.figures.extended)
        ]
        return all(after <= MAX_RMS_RATIO * before for before, after in pairwise(sizes))

    @cached_property
    def figures(self) -> Figures:
        """How well each model describes the data it was fitted to and the data held out."""
        named = FitQuality(self.cause_fit.rms_px, self._cause_predictions[-1].rms)
        return Figures(
            self._base_quality(),
            named,
            self._lens_quality(),
            self._extended_quality(),
            self._gain(self._given_prediction, self._extended_prediction),
        )

    def _base_quality(self) -> FitQuality:
        linear, full = self.simulation, self.null.full
        freedom = full.rows - full.group_rank - len(self.free)
        chi2 = float((linear.residual**2).sum()) / self._noise_square / max(freedom, 1)
        # Of the points that the causes were fitted to: figures before and after are comparable.
        views = self.cause_fit.data.views
        squares = ((views.uv - linear.linear.uv) ** 2).sum(axis=-1)[views.used]
        return FitQuality(float(np.sqrt(np.nanmean(squares))), self._given_prediction.rms, chi2)

    def _lens_quality(self) -> FitQuality:
        linear = self.problem.linear
        if set(self._not_of_lens) < set(self.names):
            linear = self._adjust(fit_without_causes(self.null, self._not_of_lens, self.free))
        return FitQuality(linear.rms_px, self._lens_prediction.rms)

    def _extended_quality(self) -> FitQuality:
        residuals = self.fitted.residuals()
        chi2 = float((residuals**2).sum()) / self._noise_square / self.null.full.rows
        return FitQuality(
            self.null.linear.rms_px_of(residuals), self._extended_prediction.rms, chi2
        )

    @property
    def frames(self) -> int:
        """How many frames there are."""
        return self.null.linear.data.frames

    def _gain(self, before: HeldOut, after: HeldOut) -> Comparison:
        return gain_and_confidence(before, after, self.noise_px)[0]

    @cached_property
    def gains(self) -> dict[str, Comparison]:
        """What the lens alone, all causes, and then offsets of landmarks and image gain."""
        offsets, named = self._extended_prediction, self._cause_predictions[-1]
        if self.offsets.views is not None:
            offsets = self.predict(offsets=self.offsets._replace(views=None))
        return {
            'lens': self._gain(self._given_prediction, self._lens_prediction),
            'named': self._gain(self._given_prediction, named),
            'local': self._gain(named, offsets),
        }

    def prepare_conclusion(self) -> None:
        """Compute side by side what takes long, and what a conclusion asks for in turn."""
        run_in_threads(
            lambda: self.written_field,
            lambda: self._component_p_values,
            lambda: self._refuting_frames,
            lambda: self.uncertainty,
            lambda: self.figures,
        )

    @cached_property
    def _component_p_values(self) -> dict[str, float]:
        return component_significance(self.null)

    @cached_property
    def _refuting_frames(self) -> dict[str, tuple[Ends, ...]]:
        """Contiguous frames that the others predict worse with a cause, by its name."""
        quick = self.problem.options.quick
        return {} if quick else refuting_blocks(self.null, self.fitted)

    def causes(self, components: Sequence[Component]) -> list[Cause]:
        """Return the causes that move predictions, with what each adds."""
        squares, predictions = self._squares, self._cause_predictions
        named = sum(c.share for c in components if c.named_share)
        total = sum(squares.values())
        shares = {name: named * s / total if total else 0.0 for name, s in squares.items()}
        held_out = [
            (after.rms, self._gain(self.predict([name]), predictions[-1]).value)
            for name, after in zip(self.names, predictions[1:], strict=True)
        ]
        causes = selected_causes(
            EffectTests(self.null),
            self.posterior,
            self.selection.causes,
            self.errors,
            shares,
            held_out,
        )
        causes = [
            replace(cause, refuted_by_frames=self._refuting_frames.get(cause.effect, ()))
            for cause in causes
        ]
        if self.medium is None:
            return causes
        gain = self._gain(self._given_prediction, self._base_prediction)
        remaining = 1 - self.medium.share
        fitted = replace(self.medium, state=self.null.linear.state)
        errors = dict(zip(shared_names(self.null.linear), self.errors.tolist(), strict=True))
        return [
            medium_cause(fitted, errors, self._base_prediction.rms, gain.value),
            *(replace(cause, share=remaining * cause.share) for cause in causes),
        ]

    def components(self, noise_causes: Mapping[str, float]) -> list[Component]:
        """Return the variance budget; noise_causes: p-values of causes in the noise."""
        null, tests = self.null, EffectTests(self.null)
        p_values = (
            self._component_p_values
            | {
                cause.name: tests.correct(
                    cause.effect,
                    tests.test_removal(null.included_columns, cause.columns, cause.effect).p_value,
                )
                for cause in self.selection.causes
            }
            | dict(noise_causes)
        )
        parts = variance_budget(null, self.fitted, self._squares, p_values, self.offsets.views)
        return parts if self.medium is None else self.medium.budget(parts)

    @cached_property
    def _squares(self) -> dict[str, float]:
        return cause_squares(self.null, self.selection.causes)

    @cached_property
    def intrinsics(self) -> dict[str, Intrinsic]:
        """Free intrinsics before and after, with errors under the null model."""
        if self.medium is not None:
            return {}
        selection, written = self.selection, self.averaged_model
        names, own = shared_names(written.linear), np.diag(np.nan_to_num(self._own_errors) ** 2)
        errors = written.added_covariance()
        errors[np.ix_(written.place, written.place)] += own
        after = dict(zip(names, np.sqrt(np.diag(errors)), strict=True))
        given = stated_parameters(selection.problem.inputs.lenses)
        before = dict(
            zip(
                shared_names(selection.first.linear), self._errors_of(selection.first), strict=True
            )
        )
        was, now = selection.problem.base.parameters, written.linear.state.parameters
        return {
            name: Intrinsic(
                *given[name], was[name], float(before[name]), now[name], float(after[name])
            )
            for name in self.free
        }


def _with_poses_anew(linear: Linearization) -> Linearization:
    if linear.data.poses is not None:
        return linear
    return Linearization(linear.data, adjust_poses(linear.data, linear.state), linear.free)
