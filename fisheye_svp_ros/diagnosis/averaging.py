"""The lens that is written: averaged over the models with and without a viewpoint shift.

A shift that is too weak to be named may still be likely, and a lens without it has intrinsics that
stand in for it.  What is named stays a decision; what is written is the mean of both models, each
weighted by its posterior probability (spike and slab), where the data leave it open.
Source: Mitchell and Beauchamp, Bayesian variable selection in linear regression, Journal of the
American Statistical Association 83 (1988).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy import special

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.model_errors import ModelErrors, shared_names
from fisheye_svp_ros.diagnosis.null_model import NullModel
from fisheye_svp_ros.diagnosis.selection import Selection
from fisheye_svp_ros.effects.base import Effect
from fisheye_svp_ros.effects.of_cameras import OfCameras
from fisheye_svp_ros.effects.ray_effects import FlatPortEffect, ViewpointShiftEffect
from fisheye_svp_ros.mixed_model import pseudo_inverse
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.solve.rig_state import Linearization, with_effect

SHIFT_SIGMA = 4e-3  # m: of e0 before the data; small lenses that were measured have 1 to 6 mm
PRIOR_ODDS = 0.3  # of a shift, before the data
MIN_WEIGHT = PRIOR_ODDS / (1 + PRIOR_ODDS)  # below it the data are evidence against a shift


class AveragedShift(NamedTuple):
    """A viewpoint shift e0, m, of a camera ('' without rig): mean over the models that are likely.

    weight: posterior probability of a shift; stderr: within and between the models.
    """

    camera: str
    weight: float
    e0: float
    stderr: float


class ShiftPosterior(NamedTuple):
    """The models with one more shift each, for S open shifts.

    weight (S,): posterior probabilities, 0 where the data are evidence against a shift; estimate,
    variance (S,): of e0, m, under its prior; follow (K, S): what one meter of it moves all that is
    in the model by, the shared columns normalized.
    """

    weight: Array
    estimate: Array
    variance: Array
    follow: Array

    @property
    def mean(self) -> Array:
        """Means (S,) of e0 over both models, m."""
        return np.asarray(self.weight * self.estimate)

    @property
    def stderr(self) -> Array:
        """Standard deviations (S,) of e0 over both models, m."""
        between = self.weight * (1 - self.weight) * self.estimate**2
        return np.asarray(np.sqrt(self.weight * self.variance + between))


class OpenShifts(NamedTuple):
    """Viewpoint shifts that a model leaves open, S forms; columns (S,): theirs of the border."""

    effects: tuple[Effect, ...]
    columns: Index

    @classmethod
    def from_selection(cls, selection: Selection) -> OpenShifts:
        """Return the simplest shift of each camera that has neither a shift nor a port.

        None where one is refuted, by held-out frames or by its size.
        """
        null = selection.null
        if (ViewpointShiftEffect.name in selection.refuted
                or any(lens.port is not None for lens in null.linear.state.lenses)):
            return cls((), np.zeros(0, dtype=np.int64))
        named = {kind.replace(FlatPortEffect.name, ViewpointShiftEffect.name)
                 for kind in null.effect_kinds}
        found = [(effect, null.form_columns(form)[0])
                 for form, effect in enumerate(null.fixed.forms.effects)
                 if effect.name == ViewpointShiftEffect.name and len(effect.parameters) == 1
                 and not named & {*effect.kinds, effect.name}]
        return cls(tuple(effect for effect, _ in found),
                   np.array([column for _, column in found], dtype=np.int64))

    def posterior(self, null: NullModel, information: Array) -> ShiftPosterior:
        """Return what an information matrix says of each.

        information (K + S + 1, K + S + 1): of what is in the model, the open shifts, the residual.
        """
        own = np.arange(null.column_count)
        columns, scale = len(own) + np.arange(len(self.columns)), null.scale[self.columns]
        inverse, _ = pseudo_inverse(information[np.ix_(own, own)], 1e-13)
        follow = -inverse @ information[np.ix_(own, columns)]
        block = np.diag(information)[columns] + (information[columns][:, own] * follow.T).sum(1)
        score = information[columns, -1] + follow.T @ information[own, -1]
        prior = 1 / (SHIFT_SIGMA * scale) ** 2
        evidence = score**2 / (block + prior) / 2 - np.log1p(block / prior) / 2
        weight = special.expit(evidence + np.log(PRIOR_ODDS))
        return ShiftPosterior(
            np.where(weight >= MIN_WEIGHT, weight, 0.0), score / (block + prior) / scale,
            1 / (block + prior) / scale**2, follow * scale)


@dataclass(frozen=True)
class AveragedModel:
    """A fitted model with the shifts that may be there.

    kinds: of their effects; root (N, S): what one standard deviation of each shift moves all that
    is shared by; place (K,): where what the model shared before stands among the N.
    """

    linear: Linearization
    shifts: tuple[AveragedShift, ...]
    kinds: tuple[str, ...]
    root: Array
    place: Index

    @classmethod
    def from_selection(cls, selection: Selection) -> AveragedModel:
        """Average over the shifts that a selection leaves open."""
        shifts, null = OpenShifts.from_selection(selection), selection.null
        linear = null.linear
        at = null.columns_and_residual(shifts.columns)
        found = shifts.posterior(null, null.information[np.ix_(at, at)])
        follow = found.follow / null.scale[: null.column_count, None]
        state = linear.state.retract(
            linear.free, np.zeros((linear.data.frames, 6)), follow @ found.mean)
        likely = np.flatnonzero(found.weight)
        for i in likely:
            state = with_effect(state, shifts.effects[i], found.mean[i:i + 1])
        averaged = Linearization(linear.data, state, linear.free) if len(likely) else linear
        names, before = shared_names(averaged), shared_names(linear)
        place = np.array([names.index(name) for name in before], dtype=np.int64)
        root = np.zeros((len(names), len(likely)))
        root[place] = follow[:, likely]
        root[np.setdiff1d(np.arange(len(names)), place)] = np.eye(len(likely))
        return cls(averaged, tuple(
            AveragedShift(_camera_name(shifts.effects[i]), float(found.weight[i]),
                          float(found.mean[i]), float(found.stderr[i])) for i in likely),
            tuple(kind for i in likely for kind in shifts.effects[i].kinds),
            root * found.stderr[likely], place)

    def widen(self, covariance: Array) -> Array:
        """Return a covariance (K, K) of the model with what the shifts add: (N, N)."""
        wider = self.root @ self.root.T
        wider[np.ix_(self.place, self.place)] += covariance
        return np.asarray(wider)

    def widen_errors(self, errors: Array) -> Array:
        """Return standard errors (K,) of the model with what the shifts add: (N,)."""
        squares = (self.root**2).sum(axis=1)
        squares[self.place] += errors**2
        return np.asarray(np.sqrt(squares))

    def errors(self, errors: ModelErrors) -> ModelErrors:
        """Return what is known of the errors with the shifts, from that without."""
        return replace(errors, names=shared_names(self.linear),
                       covariance=self.widen(errors.covariance))

    def to_dict(self) -> dict[str, Any]:
        """Return what diagnosis.json holds: nothing where no shift is left open."""
        shifts = [shift._asdict() for shift in self.shifts]
        return {'averaged_shift': shifts} if shifts else {}

    def with_shift_entry(self, lens: Lens, camera: str) -> Lens:
        """Return the lens of a camera with its shift in its `uncertainty`."""
        entries = [shift._asdict() for shift in self.shifts if shift.camera in ('', camera)]
        if not entries:
            return lens
        del entries[0]['camera']
        known = {**(lens.uncertainty or {}), 'averaged_shift': entries[0]}
        return replace(lens, uncertainty=known)


def _camera_name(effect: Effect) -> str:
    return effect.parts[0][1] if isinstance(effect, OfCameras) else ''
