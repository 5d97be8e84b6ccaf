"""The lens that is written: averaged over viewpoint shifts that are open, with its image field.

A shift that is too weak to be named may still be likely, and a lens without it has intrinsics that
stand in for it.  What is named stays a decision; what is written is the mean of both models, each
weighted by its posterior probability (spike and slab), where the data leave it open.
The image field is what every frame shows alike in the image and no cause holds: predicted random
effects of the image, with those of frames and target beside them in the model.  It is written only
where it predicts frames that took no part: every fourth frame is left out in turn.  Contiguous
thirds that it predicts worse are a warning.  The variances stay as they are.
Source: Mitchell and Beauchamp, Bayesian variable selection in linear regression, Journal of the
American Statistical Association 83 (1988).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse, special

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.diagnosis.cross_validation import (
    Ends,
    contiguous_blocks,
    misfits,
    refit_shared,
    split_frames,
)
from fisheye_svp_ros.diagnosis.effect_forms import bump_values
from fisheye_svp_ros.diagnosis.fitted_model import FittedModel
from fisheye_svp_ros.diagnosis.model_errors import ModelErrors, shared_names
from fisheye_svp_ros.diagnosis.null_model import NullModel
from fisheye_svp_ros.diagnosis.random_effects import ImageGrid
from fisheye_svp_ros.diagnosis.selection import Selection
from fisheye_svp_ros.effects.base import Effect
from fisheye_svp_ros.effects.ray_effects import FlatPortEffect, ViewpointShiftEffect
from fisheye_svp_ros.mixed_model import (
    Variances,
    map_in_threads,
    posterior_covariance,
    predict_rows,
    pseudo_inverse,
    solve_equations,
)
from fisheye_svp_ros.optics.image_field import MAX_NODES, MIN_NODES, ImageField
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.solve.rig_state import Linearization, with_effect

Rng = np.random.Generator
SHIFT_SIGMA = 4e-3  # m: of e0 before the data; small lenses that were measured have 1 to 6 mm
PRIOR_ODDS = 0.3  # of a shift, before the data
MIN_WEIGHT = PRIOR_ODDS / (1 + PRIOR_ODDS)  # below it the data are evidence against a shift
FOLDS = 4  # every fourth frame
MIN_GAIN = 0.01  # of the rms of frames that are left out
_PITCH, _EDGE = 0.6, 2.0  # of the finest grid's: that of the spline, what lies around the bumps
_DIGITS = 6  # px


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
        if ViewpointShiftEffect.name in selection.refuted or any(
            lens.port is not None for lens in null.linear.state.lenses
        ):
            return cls((), np.zeros(0, dtype=np.int64))
        named = {
            kind.replace(FlatPortEffect.name, ViewpointShiftEffect.name)
            for kind in null.effect_kinds
        }
        forms = [
            (effect, null.form_columns(form)[0])
            for form, effect in enumerate(null.fixed.forms.effects)
            if effect.name == ViewpointShiftEffect.name
            and len(effect.parameters) == 1
            and not named & {*effect.kinds, effect.name}
        ]
        return cls(
            tuple(effect for effect, _ in forms),
            np.array([column for _, column in forms], dtype=np.int64),
        )

    def posterior(self, null: NullModel, information: Array) -> ShiftPosterior:
        """Return what an information matrix says of each.

        information (K + S + 1, K + S + 1): of what is in the model, the open shifts, the residual.
        """
        own = np.arange(null.column_count)
        columns, scale = len(own) + np.arange(len(self.columns)), null.scale[self.columns]
        inverse = pseudo_inverse(information[np.ix_(own, own)], 1e-13)
        follow = -inverse @ information[np.ix_(own, columns)]
        block = np.diag(information)[columns] + (information[columns][:, own] * follow.T).sum(1)
        score = information[columns, -1] + follow.T @ information[own, -1]
        prior = 1 / (SHIFT_SIGMA * scale) ** 2
        evidence = score**2 / (block + prior) / 2 - np.log1p(block / prior) / 2
        weight = special.expit(evidence + np.log(PRIOR_ODDS))
        return ShiftPosterior(
            np.where(weight >= MIN_WEIGHT, weight, 0.0),
            score / (block + prior) / scale,
            1 / (block + prior) / scale**2,
            follow * scale,
        )

    def refit(self, null: NullModel, information: Array) -> tuple[Array, Array, Array]:
        """Return what changes by the information, as `posterior` takes it, with the shifts' means.

        Changes (K,) of what is shared without them; what they add to the coefficients (K + S,),
        normalized; the combination (K + S + 1,) of the border that is the residual then.
        """
        _, change, combination = refit_shared(null, information)
        likely = self.posterior(null, information)
        added = np.append(likely.follow @ likely.mean, likely.mean * null.scale[self.columns])
        combination[:-1] -= added
        return change, added, combination


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
        posterior = shifts.posterior(null, null.information[np.ix_(at, at)])
        follow = posterior.follow / null.scale[: null.column_count, None]
        state = linear.state.retract(
            linear.free, np.zeros((linear.data.frames, 6)), follow @ posterior.mean
        )
        likely = np.flatnonzero(posterior.weight)
        for i in likely:
            state = with_effect(state, shifts.effects[i], posterior.mean[i : i + 1])
        averaged = Linearization(linear.data, state, linear.free) if len(likely) else linear
        names, before = shared_names(averaged), shared_names(linear)
        place = np.array([names.index(name) for name in before], dtype=np.int64)
        root = np.zeros((len(names), len(likely)))
        root[place] = follow[:, likely]
        root[np.setdiff1d(np.arange(len(names)), place)] = np.eye(len(likely))
        return cls(
            averaged,
            tuple(
                AveragedShift(
                    next(iter(effect.cameras), ''),
                    float(posterior.weight[i]),
                    float(posterior.mean[i]),
                    float(posterior.stderr[i]),
                )
                for i, effect in enumerate(shifts.effects)
                if posterior.weight[i]
            ),
            tuple(kind for i in likely for kind in shifts.effects[i].kinds),
            root * posterior.stderr[likely],
            place,
        )

    def widen(self, covariance: Array) -> Array:
        """Return a covariance (K, K) of the model with what the shifts add: (N, N)."""
        wider = self.root @ self.root.T
        wider[np.ix_(self.place, self.place)] += covariance
        return np.asarray(wider)

    def draw_shifts(self, rng: Rng, samples: int) -> Array:
        """Return by what the shifts, there or not, put off all that is shared: (N, samples).

        Each is there in its share of the samples: either none, or one beside its estimate.
        """
        off = np.zeros((len(self.shifts), samples))
        for i, shift in enumerate(self.shifts):
            estimate = shift.e0 / shift.weight
            within = shift.stderr**2 / shift.weight - (1 - shift.weight) * estimate**2
            there = rng.random(samples) < shift.weight
            drawn = estimate + np.sqrt(max(within, 0.0)) * rng.standard_normal(samples)
            off[i] = (np.where(there, drawn, 0.0) - shift.e0) / shift.stderr
        return np.asarray(self.root @ off)

    def errors(self, errors: ModelErrors) -> ModelErrors:
        """Return what is known of the errors with the shifts, from that without."""
        return replace(
            errors, names=shared_names(self.linear), covariance=self.widen(errors.covariance)
        )

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


class CameraField(NamedTuple):
    """The field of a camera and how well it is known.

    grids: of the bumps that it is made of; root (2 Q, C): of the covariance of their coefficients,
    px, u and v of each bump in turn; shared (K, C): of that of the model's shared parameters.
    """

    field: ImageField
    grids: tuple[ImageGrid, ...]
    root: Array
    shared: Array

    def bumps_at(self, uv: Array) -> Array:
        """Return the values (N, Q) of its bumps at image points (N, 2), px."""
        every = np.ones(len(uv), dtype=bool)
        return np.concatenate(
            [bump_values(uv, every, grid.centers, grid.pitch).toarray() for grid in self.grids],
            axis=1,
        )


@dataclass(frozen=True)
class WrittenField:
    """The image fields of the cameras, by their number, and rms px of frames left out.

    before, after: without and with it; refuted: frames, first and last of each contiguous third,
    that the others predict worse with it; fields: none where it is not written.
    """

    before: float
    after: float
    refuted: tuple[Ends, ...]
    fields: Mapping[int, CameraField]

    @classmethod
    def from_selection(cls, selection: Selection, fitted: FittedModel) -> WrittenField | None:
        """Return what frames left out say of the predicted field.

        None where there is nothing to predict, or several cameras have one lens.
        """
        data, lenses = fitted.linear.data, fitted.linear.state.lenses
        if not fitted.random.grids or data.frames < 2 * FOLDS or data.cameras > len(lenses):
            return None
        variances, order = selection.null.variances, np.arange(data.frames)
        squares = _hold_out(fitted, variances, order % FOLDS)
        before, after = np.sqrt(2 * squares.sum(axis=0) / fitted.linear.row_mask.sum()).tolist()
        if not after < (1 - MIN_GAIN) * before:
            return cls(before, after, (), {})
        block, ends = contiguous_blocks(data)
        squares = _hold_out(fitted, variances, block)
        refuted = tuple(
            edge
            for edge, (without, with_field) in zip(ends, squares, strict=True)
            if with_field > without
        )
        return cls(before, after, refuted, _fields(selection, fitted))

    def add_to(self, lens: Lens, camera: int) -> Lens:
        """Return the lens of a camera with its field."""
        known = self.fields.get(camera)
        return lens if known is None else replace(lens, image_field=known.field)

    def to_dict(self) -> dict[str, Any]:
        """Return what diagnosis.json holds."""
        return {
            'written': bool(self.fields),
            'without_px': self.before,
            'with_px': self.after,
            'refuted_by_frames': [list(ends) for ends in self.refuted],
            'rms_px': max((camera.field.rms for camera in self.fields.values()), default=0.0),
        }


def _hold_out(fitted: FittedModel, variances: Variances, fold: Index) -> Array:
    """Return squares (K, 2), px^2, of each fold of the frames, as the other folds predict them.

    Without the field and with it; poses are fitted to the frames, the target is as predicted.
    fold (F,): that of each frame.
    """
    linear = fitted.linear

    def hold_out(out: Mask) -> Array:
        whole, field = _predict(fitted, variances, out)
        left = linear.residual[out] - whole
        return misfits(linear, out, np.stack([left + field, left], axis=-1))

    folds = np.arange(int(fold.max()) + 1)
    products = len(folds) * fitted.factored.products
    return np.array(map_in_threads(lambda k: hold_out(fold == k), folds, products))


def _predict(fitted: FittedModel, variances: Variances, out: Mask) -> tuple[Array, Array]:
    """Return what the other frames predict of the rows (F, M) of some, and the field's part."""
    linear = fitted.linear
    kept, tested = split_frames(fitted, variances, out)
    solution = solve_equations(kept)
    _, unit, shared = kept.equations.split(solution.e[..., None], solution.r[:, None])
    group = np.zeros((int(out.sum()), 6 + tested.group.shape[2], 1))
    of_field = (np.arange(len(shared)) < fitted.random.grid_columns)[:, None]
    whole, field = (
        predict_rows(
            tested, linear.frame_columns[out], group, offsets, values, kept.equations.units
        )[..., 0]
        for offsets, values in (
            (unit, shared),
            (np.zeros_like(unit), np.where(of_field, shared, 0.0)),
        )
    )
    fixed = linear.shared_columns[out] @ (solution.values / fitted.scale)
    return whole + fixed, field


def _fields(selection: Selection, fitted: FittedModel) -> dict[int, CameraField]:
    """Return the predicted field of each camera, with what its lens has already."""
    random, sigma = fitted.random, selection.null.variances.sigma
    values = _shared_coefficients(selection, fitted)
    posterior = posterior_covariance(fitted.factored)
    count = fitted.solution.e.size
    root = (
        sigma
        * fitted.factored.equations.split(
            posterior.root[:count].reshape(*fitted.solution.e.shape, -1), posterior.root[count:]
        )[2]
    )
    shared = sigma * posterior.shared / fitted.scale[:, None]
    fields, camera_of = (
        {},
        np.concatenate([np.full(2 * len(grid.centers), grid.camera) for grid in random.grids]),
    )
    for camera in np.unique(camera_of).tolist():
        grids = tuple(grid for grid in random.grids if grid.camera == camera)
        mine = np.flatnonzero(camera_of == camera)
        known = fitted.linear.state.lenses[camera].image_field
        fields[camera] = CameraField(
            _field(grids, values[mine], root[mine], known), grids, root[mine], shared
        )
    return fields


def _shared_coefficients(selection: Selection, fitted: FittedModel) -> Array:
    """Return the shared random coefficients (Q,) beside the shifts that are written."""
    null, shifts = selection.null, OpenShifts.from_selection(selection)
    at = null.columns_and_residual(shifts.columns)
    whole = np.zeros(len(null.scale) + 1)
    whole[at] = shifts.refit(null, null.information[np.ix_(at, at)])[2]
    e, r = null.factorization.coefficients(whole)
    return null.equations.split(e, r)[2]


def _field(
    grids: Sequence[ImageGrid], values: Array, root: Array, known: ImageField | None
) -> ImageField:
    """Return the field of bumps: coefficients (2 Q,), root of covariance; known: added to it."""
    finest = min(grid.pitch for grid in grids)
    low = np.min([grid.centers.min(axis=0) - _EDGE * grid.pitch for grid in grids], axis=0)
    high = np.max([grid.centers.max(axis=0) + _EDGE * grid.pitch for grid in grids], axis=0)
    if known is not None:
        low, high = np.minimum(low, known.nodes[0, 0]), np.maximum(high, known.nodes[-1, -1])
    low = np.round(low)
    columns, rows = (np.ceil((high - low) / (_PITCH * finest)).astype(int) + 1).clip(
        MIN_NODES, MAX_NODES
    )
    pitch = np.full(2, round(_PITCH * finest, _DIGITS))
    nodes = ImageField(low, pitch, np.zeros((rows, columns, 2))).nodes
    bumps = sparse.hstack(
        [
            bump_values(nodes, np.ones(nodes.shape[:2], dtype=bool), grid.centers, grid.pitch)
            for grid in grids
        ],
        format='csr',
    )
    there = (bumps @ values.reshape(-1, 2)).reshape(nodes.shape)
    spread = (bumps @ root.reshape(bumps.shape[1], -1)).reshape(rows, columns, 2, -1)
    if known is not None:
        there = there + known.displacement(nodes)
    stderr = np.sqrt((spread**2).sum(axis=-1).mean(axis=-1))
    field = ImageField.interpolate(low, pitch, there, np.round(stderr, _DIGITS))
    return replace(field, values=np.round(field.values, _DIGITS))
