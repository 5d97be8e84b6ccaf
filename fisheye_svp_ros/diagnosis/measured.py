"""What a search found, measured: budget, errors, prediction of held-out frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.diagnosis.adjustment import fit, start_poses
from fisheye_svp_ros.diagnosis.budget import (
    Component,
    budget,
    cause_squares,
    noise_px,
    stage_of,
)
from fisheye_svp_ros.diagnosis.causes import Cause, mean_causes
from fisheye_svp_ros.diagnosis.components import significance
from fisheye_svp_ros.diagnosis.evidence import Evidence
from fisheye_svp_ros.diagnosis.inputs import another_target
from fisheye_svp_ros.diagnosis.medium import Medium
from fisheye_svp_ros.diagnosis.model import Data, Linearised, State, prepare
from fisheye_svp_ros.diagnosis.moments import each_alone, stands_elsewhere, without_rig
from fisheye_svp_ros.diagnosis.noise import NO_GROSS, find_gross_errors
from fisheye_svp_ros.diagnosis.prediction import (
    Gain,
    HeldOut,
    frames_in_turn,
    gain_between,
    on_other_data,
    without_causes,
)
from fisheye_svp_ros.diagnosis.refit import Local, local_offsets
from fisheye_svp_ros.diagnosis.residuals import conditional_residuals, rms_px
from fisheye_svp_ros.diagnosis.search import Found, drop_test
from fisheye_svp_ros.diagnosis.similar_views import similar_views
from fisheye_svp_ros.diagnosis.standard_errors import honest_errors, standard_errors
from fisheye_svp_ros.scene.observations import Observations


@dataclass(frozen=True)
class FitQuality:
    """How well a model describes the data it was fitted to and the data held out."""

    rms_px: float
    heldout_rms_px: float
    chi2_per_dof: float | None = None


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


class Measured:
    """Figures of what was found; held_out: other frames, None for frames left out in turn.

    given: parameters of the lenses as they were given, with stated errors; medium: the cause that
    was found before the search, if there is one.
    """

    def __init__(
        self, found: Found, free: Sequence[str], held_out: Observations | None, quick: bool,
        given: Mapping[str, tuple[float, float]], medium: Medium | None = None,
    ) -> None:
        self.found, self.free, self.quick, self.medium = found, tuple(free), quick, medium
        self.evidence, self.given = found.evidence, given
        self.names = [effect.name for effect, _, _ in found.causes]
        self.remaining = conditional_residuals(found.fitted)
        views = similar_views(found.fitted.linear, self.remaining)
        self.local: Local = local_offsets(found.fitted)._replace(views=views)
        self.noise = noise_px(found.evidence)
        if views is not None:
            self.noise *= float(np.sqrt(1 - views.share))
        self.test: Data | None = None
        self.test_gross = NO_GROSS
        self.test_moved = self.another_target = False
        if held_out is not None:
            observations = found.evidence.linear.data.observations
            self.another_target = another_target(observations, held_out)
            # Held-out outliers are no measure of a model; the same points are left out for all.
            test = prepare(held_out)
            if without_rig(found.evidence.linear.data):
                test = each_alone(test)
            state = self._there(test, found.state)
            self.test, self.test_gross = find_gross_errors(test, start_poses(test, state))
            if stands_elsewhere(self.test, state):
                self.test_moved, test = True, each_alone(test)
                self.test, self.test_gross = find_gross_errors(test, start_poses(test, state))
            self.test_pose = start_poses(self.test, state).pose

    @cached_property
    def errors(self) -> Array:
        """Standard errors of all that is shared."""
        return self._errors_of(self.evidence)

    def _errors_of(self, evidence: Evidence) -> Array:
        return (standard_errors(evidence, jackknife=False) if self.quick
                else honest_errors(evidence))

    def _there(self, test: Data, state: State) -> State:
        """Return the state without what other frames or their target had and the test has not."""
        t, known = (data.observations.t for data in (test, self.evidence.linear.data))
        return replace(state, terms=tuple(
            term for term in state.terms if term[0].holds_for(t, known)
            and not (self.another_target and term[0].place == 'target')))

    def held_out(self, without: Sequence[str] = (), local: Local | None = None) -> HeldOut:
        """Predict held-out frames without some causes, with or without local offsets."""
        if self.test is None:
            return frames_in_turn(self.evidence, without, local).take(self.predicted)
        if set(without) >= set(self.names):
            state = self.found.simulated.state
        elif without:
            state = without_causes(self.evidence, without, self.free)
        else:
            state = self.found.state
        state = replace(self._there(self.test, state), pose=self.test_pose)
        near = replace(state, rig=self.found.state.rig)
        if local is not None and self.another_target:
            local = local.of_image
        return on_other_data(self.test, near, local)

    @cached_property
    def predicted(self) -> Mask:
        """Which frames (F,) count where each is left out in turn: what any model predicts."""
        with_causes, without = (
            frames_in_turn(self.evidence, gone) for gone in ((), self.names))
        return with_causes.predicted | without.predicted

    @cached_property
    def _base(self) -> HeldOut:
        return self.held_out(self.names)

    @cached_property
    def _simulation(self) -> HeldOut:
        if self.medium is None:
            return self._base
        if self.test is None:
            return self.medium.held_out().take(self.predicted)
        return on_other_data(self.test, replace(self.medium.air.state, pose=self.test_pose))

    @property
    def before(self) -> Linearised:
        """The simulation as it was fitted."""
        return self.found.simulated if self.medium is None else self.medium.air

    @cached_property
    def _prefixes(self) -> list[HeldOut]:
        """Predictions with the first 0, 1, ... causes."""
        return [self._base, *(
            self.held_out(self.names[i + 1 :]) for i in range(len(self.names))
        )]

    @cached_property
    def _best(self) -> HeldOut:
        return self.held_out(local=self.local)

    @cached_property
    def _lens(self) -> HeldOut:
        return self.held_out(self._elsewhere)

    @property
    def _elsewhere(self) -> list[str]:
        return [name for name in self.names if stage_of(name) != 'lens']

    @property
    def _noise_square(self) -> float:
        """Variance of whitened noise: 1 where the table states sigma, else as it was estimated."""
        stated = np.isfinite(self.evidence.linear.data.observations.sigma).all()
        return 1.0 if stated else self.evidence.variances.sigma**2

    @property
    def base(self) -> FitQuality:
        """The simulation as it was fitted."""
        linear = self.before
        freedom = self.evidence.full.rows - self.evidence.full.poses - len(self.free)
        chi2 = float((linear.residual**2).sum()) / self._noise_square / max(freedom, 1)
        return FitQuality(rms_px(linear), self._simulation.rms, chi2)

    @property
    def named(self) -> FitQuality:
        """All causes, without local offsets."""
        linear = self.evidence.linear
        return FitQuality(rms_px(linear), self._prefixes[-1].rms)

    @property
    def lens_only(self) -> FitQuality:
        """Only what moves with the lens, fitted without the rest."""
        linear = self.found.simulated
        if set(self._elsewhere) < set(self.names):
            state = without_causes(self.evidence, self._elsewhere, self.free)
            data = self.evidence.linear.data
            linear = Linearised(data, fit(data, state, self.free), self.free)
        return FitQuality(rms_px(linear), self._lens.rms)

    @property
    def extended(self) -> FitQuality:
        """Causes and predicted local offsets."""
        chi2 = float((self.remaining**2).sum()) / self._noise_square / self.evidence.full.rows
        return FitQuality(rms_px(self.evidence.linear, self.remaining), self._best.rms, chi2)

    @property
    def gain(self) -> Gain:
        """Of the best prediction over the simulation."""
        return gain_between(self._simulation, self._best, self.noise)

    def gains(self) -> dict[str, Gain]:
        """Return what the lens alone, all causes, and then offsets of landmarks and image gain."""
        offsets = self._best
        if self.local.views is not None:
            offsets = self.held_out(local=self.local._replace(views=None))
        return {
            'lens': gain_between(self._simulation, self._lens, self.noise),
            'named': gain_between(self._simulation, self._prefixes[-1], self.noise),
            'local': gain_between(self._prefixes[-1], offsets, self.noise),
        }

    def causes(self, components: Sequence[Component]) -> list[Cause]:
        """Return the causes that move predictions, with what each adds."""
        squares = self._squares
        named = sum(c.share for c in components if c.named_share)
        total = sum(squares.values())
        shares = {name: named * s / total if total else 0.0 for name, s in squares.items()}
        held_out = [
            (after.rms, gain_between(before, after, self.noise).value)
            for before, after in zip(self._prefixes, self._prefixes[1:], strict=False)
        ]
        causes = mean_causes(self.evidence, self.found.causes, self.errors, shares, held_out)
        if self.medium is None:
            return causes
        gain = gain_between(self._simulation, self._base, self.noise)
        remaining = 1 - self.medium.share
        fitted = replace(self.medium, state=self.found.state)
        return [fitted.cause(self._free_errors(), self._base.rms, gain),
                *(replace(cause, share=remaining * cause.share) for cause in causes)]

    def components(self, noise_causes: Mapping[str, float]) -> list[Component]:
        """Return the variance budget; noise_causes: p-values of causes in the noise."""
        evidence = self.evidence
        own = np.arange(evidence.own)
        p_values = significance(evidence.beside(own), evidence.variances)
        found = {effect.name: drop_test(evidence, own, columns, effect).p_value
                 for effect, columns, _ in self.found.causes}
        parts = budget(
            evidence, self._squares, p_values, found | dict(noise_causes), self.local.views)
        return parts if self.medium is None else self.medium.budget(parts)

    @cached_property
    def _squares(self) -> dict[str, float]:
        return cause_squares(self.evidence, self.found.causes)

    def _free_errors(self) -> dict[str, float]:
        """Return the standard errors of what was free from the start."""
        rig = _rig_columns(self.found.base, self.free)
        return {name: float(self.errors[rig + i]) for i, name in enumerate(self.free)}

    @property
    def intrinsics(self) -> dict[str, Intrinsic]:
        """Free intrinsics before and after, with errors under the null model."""
        if self.medium is not None:
            return {}
        base, after = self.found.base, self._free_errors()
        before = self._errors_of(base)
        rig = _rig_columns(base, self.free)
        was, now = self.found.simulated.state.parameters, self.found.state.parameters
        return {
            name: Intrinsic(
                *self.given[name], was[name], float(before[rig + i]), now[name], after[name]
            )
            for i, name in enumerate(self.free)
        }


def _rig_columns(evidence: Evidence, free: Sequence[str]) -> int:
    """Return how many of what is shared come before what was free from the start."""
    return evidence.own - len(free) - sum(
        len(values) for effect, values in evidence.linear.state.terms if effect.stage != 'noise'
    )
