"""How far off parameters, poses and image points may be.

Standard errors: of the null model, between frames, of a broad field and of the selection.  What a
diagnosis leaves without a name (its variance components) is no noise: it does not average out over
the points of a view.  Carried through the solver, it stands beside noise and parameters.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy import special

from fisheye_svp_ros.arrays import Array, Index, Mask, flat_rows
from fisheye_svp_ros.diagnosis.effect_tests import EffectTests
from fisheye_svp_ros.diagnosis.fitted_model import FittedModel
from fisheye_svp_ros.diagnosis.null_model import FINEST_FIELD, NullModel
from fisheye_svp_ros.diagnosis.random_effects import (
    MILLIMETRE,
    NAMES,
    STAGE_OF,
    ColumnGeometry,
    make_random_effects,
)
from fisheye_svp_ros.effects.base import Effect, Term
from fisheye_svp_ros.mixed_model import (
    LAMBDA_ABSENT,
    RandomColumns,
    Score,
    Variances,
    pseudo_inverse,
)
from fisheye_svp_ros.solve.rig_state import Linearization, is_shared

_MAX_MODELS = 40
_MIN_FRAMES = 3
_ODDS_WINDOW = 6.0  # of the criterion: odds of 20, beyond which a model counts for nothing


def total_errors(null: NullModel, averaged_kinds: Collection[str] = ()) -> Array:
    """Return the standard errors (K,) of all that is shared, other likely models allowed for.

    averaged_kinds: kinds of effects whose share in these is counted elsewhere.
    """
    parts = standard_errors(null), field_uncertainty(null), model_uncertainty(null, averaged_kinds)
    return np.asarray(np.sqrt(np.square(parts).sum(axis=0)))


def standard_errors(null: NullModel, jackknife: bool = True) -> Array:
    """Return the standard errors (K,) of all that is shared: rig, intrinsics, effects.

    From the information of the null model; where estimates without each of the frames change by
    more than that allows, as much larger (a jackknife, beside what it should be: a frame on which
    much depends may change much).
    NaN where the data leave a parameter open.
    """
    own, reported = null.included_columns, _reporting_matrix(null)
    estimate, variance, open_ = _estimate(null.information, own, reported)
    if jackknife and null.linear.data.frames > 2:
        changed, allowed = np.zeros(null.column_count), np.zeros(null.column_count)
        for part in null.information_without_frames(np.append(own, len(null.scale))):
            other, wider, lost = _estimate(part, own, reported)
            changed += np.where(lost, 0.0, (other - estimate) ** 2)
            allowed += np.where(lost, 0.0, wider - variance)
        least = np.maximum(1e-9 * variance, 1e-300)  # nothing is known of what the data leave open
        variance = variance * np.maximum(changed / np.maximum(allowed, least), 1.0)
    errors = np.sqrt(variance) / null.scale[: null.column_count]
    return np.where(open_, np.nan, errors)


def _reporting_matrix(null: NullModel) -> Array:
    """Return what makes coefficients (X,), normalised, those that are reported: (X, X)."""
    found = np.eye(len(null.scale))
    for effect, columns, _ in null.terms:
        scale = null.scale[columns]
        own = effect.report_values(np.eye(len(columns)))
        found[np.ix_(columns, columns)] = scale[:, None] * own / scale
    return found


def _estimate(
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


def field_uncertainty(null: NullModel) -> Array:
    """Return what the unknown size of a broad image field adds to standard errors (K,).

    What intrinsics and effects take up of such a field is lost for its variance, which is found
    too small then, or nothing.  Each size, none among them, is as probable as its restricted
    likelihood says, and adds what it brings and the square of the change.
    """
    own, reported = null.included_columns, _reporting_matrix(null)
    freedom = null.freedom
    estimate, variance, _ = _estimate(null.information, own, reported)
    likelihoods, more = [], []
    for logs, information in null.field_alternatives:
        noise = null.remaining_information(information, own)[-1, -1] / freedom
        values = np.linalg.eigvalsh(information[np.ix_(own, own)])
        determinant = np.log(np.maximum(values, 1e-12)).sum()
        likelihoods.append(-(logs + determinant + freedom * np.log(noise)) / 2)
        other, wider, _ = _estimate(information / noise, own, reported)
        more.append(wider - variance + (other - estimate) ** 2)
    added = np.maximum(special.softmax(likelihoods) @ np.array(more), 0.0)
    return np.asarray(np.sqrt(added) / null.scale[: null.column_count])


def model_uncertainty(null: NullModel, averaged_kinds: Collection[str] = ()) -> Array:
    """Return what other models, likely too, add to standard errors (K,) of what is shared.

    Each model with more effects, or with another effect in the place of one, is as probable as its
    evidence says (`_log_odds`, Occam's window), and adds so much of the variance that it brings
    and of the square of the change.  Beside a further form of an effect or one that does nearly
    the same, or without it, its parameters mean something else: for them that model does not
    count.  What is added is hardly larger than large, however little the data say of it.
    averaged_kinds: kinds of effects that are added to none.
    """
    own, information, reported = null.column_count, null.information, _reporting_matrix(null)
    prior = np.zeros(len(information))
    for form, effect in enumerate(null.fixed.forms.effects):
        prior[null.form_columns(form)] = null.prior_precision(null.form_columns(form), effect)
    estimate, variance, _ = _estimate(information, np.arange(own), reported)
    models = _likely_models(null, averaged_kinds)
    weights = special.softmax([one.criterion / 2 for one in models])
    added = np.zeros(own)
    for weight, one in zip(weights, models, strict=True):
        there = one.included < own
        at, more = one.included[there], np.zeros(own)
        other, wider, _ = _estimate(
            null.restrict_information(information, at) + np.diag(prior), one.included, reported)
        change = other[there] - estimate[at]
        more[at] = np.maximum(wider[there] - variance[at], 0.0) + change**2
        for effect, columns, _ in null.terms:
            if one.kinds & _effect_family(effect):
                more[columns] = 0.0
        added += weight * more
    return np.asarray(np.sqrt(added) / null.scale[:own])


def _log_odds(null: NullModel, score: Score) -> float:
    """Return twice the logarithm of the odds that an effect of such a score is there (BIC).

    What counts as so many observations are the frames: points of one have errors in common.
    Source: Raftery 1995, eq. 35; Pauler, The Schwarz criterion and related methods for normal
    linear models (1998), for the number.
    """
    frames = max(null.linear.data.frames, _MIN_FRAMES)
    return float(score.statistic - score.rank * np.log(frames))


def _is_likely(null: NullModel, least: float, score: Score) -> bool:
    return _log_odds(null, score) > least


class _Model(NamedTuple):
    """A model: its criterion beside the chosen one, its columns, kinds of what differs."""

    criterion: float
    included: Index
    kinds: frozenset[str]


def _likely_models(null: NullModel, averaged_kinds: Collection[str]) -> list[_Model]:
    """Return the chosen model, those with an effect exchanged, and larger, likelier ones of each.

    The likeliest of those at hand is extended first, and so many are enough.
    """
    tests, found = EffectTests(null), dict[frozenset[int], _Model]()
    waiting = {frozenset[int](): _Model(0.0, null.included_columns, frozenset())}
    waiting |= dict(_exchange_effects(null))
    while waiting and len(found) < _MAX_MODELS:
        forms, model = max(waiting.items(), key=lambda item: item[1].criterion)
        found[forms] = waiting.pop(forms)
        for one in tests.candidates(
                model.included, per_frame=False, worth=partial(_is_likely, null, 0.0)):
            kinds, gain = _effect_family(one.effect), _log_odds(null, one.score)
            if model.kinds & kinds or {*one.effect.kinds} & {*averaged_kinds}:
                continue
            if (larger := forms | {one.form}) not in found:
                columns = np.concatenate([model.included, null.form_columns(one.form)])
                waiting[larger] = _Model(model.criterion + gain, columns, model.kinds | kinds)
    return [*found.values()]


def _exchange_effects(null: NullModel) -> Iterator[tuple[frozenset[int], _Model]]:
    """Yield models with another effect in the place of one, by what is gone (~i) and the form.

    Beside other effects of the recording intrinsics mean something else: those stay as they are.
    """
    tests = EffectTests(null)
    for i, (effect, columns, _) in enumerate(null.terms):
        if not _is_lasting(effect):
            continue
        rest = np.setdiff1d(null.included_columns, columns)
        score = tests.score_beside(rest, columns)
        lost = _log_odds(null, score)
        least = lost - _ODDS_WINDOW
        for one in tests.candidates(
                rest, per_frame=False, worth=partial(_is_likely, null, least)):
            kinds = frozenset(one.effect.kinds)
            gain = _log_odds(null, one.score) - lost
            if _is_lasting(one.effect) and not null.effect_kinds & kinds:
                included = np.concatenate([rest, null.form_columns(one.form)])
                yield frozenset({~i, one.form}), _Model(
                    gain, included, kinds | set(effect.kinds))


def _effect_family(effect: Effect) -> set[str]:
    """Return the kinds of an effect, and of a more common one that does nearly the same."""
    alike = effect.rarer_than or effect.name
    return {*effect.kinds, *(kind.replace(effect.name, alike) for kind in effect.kinds)}


def _is_lasting(effect: Effect) -> bool:
    return not (effect.per_frame or effect.of_recording)


class ErrorParts(NamedTuple):
    """Covariances, or variances, of the same shape: of noise, parameters, and what remains."""

    noise: Array
    parameters: Array
    misfit: Array

    @property
    def total(self) -> Array:
        """All three together."""
        return self.noise + self.parameters + self.misfit


@dataclass(frozen=True)
class ModelErrors:
    """What is known of the errors of a model.

    names (K,), covariance (K, K): of its parameters, beside its random effects; variances: of
    these; geometry: what they are of.
    """

    names: tuple[str, ...]
    covariance: Array
    variances: Variances
    geometry: ColumnGeometry

    @classmethod
    def from_null_model(cls, null: NullModel, fitted: FittedModel) -> ModelErrors:
        """Return the errors of what was fitted under a null model.

        Parameters take up part of an image field that has no name: what it does to them is not
        counted beside the field.
        """
        lam = np.where(np.isin(np.arange(len(NAMES)), _image_components()), LAMBDA_ABSENT,
                       null.variances.lam)
        bare = replace(null, variances=replace(null.variances, lam=lam))
        own = null.included_columns
        inverse, _ = pseudo_inverse(bare.information[np.ix_(own, own)], 1e-13)
        scale = null.scale[own]
        finest = [grid.pitch for grid in null.random.grids if grid.name == FINEST_FIELD]
        modes, alone = fitted.target_modes(null.variances.sigma)
        geometry = ColumnGeometry.measure(null.linear, max(finest, default=np.nan), modes, alone)
        return cls(shared_names(null.linear), inverse / np.outer(scale, scale), null.variances,
                   geometry)

    def of_poses(self, linear: Linearization) -> ErrorParts:
        """Return covariances (F, 6, 6), m and rad, of the change in `Pose.retract` of each frame.

        linear: frames that were posed with the lens of the diagnosis, those it was made of or
        others.  A frame that one camera alone shows has the pose of that camera: the rig, which
        such frames say nothing of, is taken as it is.
        """
        return self.propagate(linear, pose_maps(linear.frame_columns))

    def propagate(self, linear: Linearization, maps: Array) -> ErrorParts:
        """Return covariances (F, Q, Q) of linear functions (F, Q, M) of whitened image points."""
        turned = np.swapaxes(maps, -1, -2)
        shared = maps @ _shared_columns(linear)
        covariance = self._covariance_of(linear)
        parameters = shared @ covariance @ np.swapaxes(shared, -1, -2)
        random, variance = self._random_columns(linear)
        own = maps @ random.group
        misfit = (own * variance[random.group_label]) @ np.swapaxes(own, -1, -2)
        misfit = misfit + self._landmark_covariances(random, maps)
        rows = maps.shape[-1]
        for f in range(len(maps)):
            field = (random.shared[f * rows:(f + 1) * rows].T @ turned[f]).T
            misfit[f] += (field * variance[random.shared_label]) @ field.T
        return ErrorParts(self.variances.sigma**2 * maps @ turned, parameters, misfit)

    def of_points(self, linear: Linearization) -> ErrorParts:
        """Return variances (F, M), px^2, of u and v of the points of a fit.

        Of the lens alone: a turn of the camera as a whole is taken out, as poses take it up, and
        what stays with the target is left out.
        """
        turn = _turn_columns(linear)
        weight = linear.row_weight
        columns = linear.shared_columns * _lens_mask(linear)
        flat, around = flat_rows(columns), flat_rows(turn)
        columns = (flat - around @ np.linalg.lstsq(around, flat, rcond=None)[0]).reshape(
            columns.shape)
        random, variance = self._random_columns(linear)
        misfit = random.group**2 @ variance[random.group_label]
        fields = random.shared.power(2) @ np.where(
            np.isin(random.shared_label, _image_components()), variance[random.shared_label], 0.0)
        misfit = misfit + np.asarray(fields).reshape(misfit.shape)
        px = np.where(weight > 0, weight, np.nan) ** -2.0
        parameters = np.einsum(
            'fmk,kl,fml->fm', columns, self._covariance_of(linear), columns)
        return ErrorParts(self.variances.sigma**2 * px, parameters * px, misfit * px)

    def summary(self, linear: Linearization) -> dict[str, dict[str, float]]:
        """Return root mean squares of what each part adds, over the frames and points of a fit.

        position_m, rotation_rad: of a pose from one frame; image_px: of a coordinate.
        """
        found: dict[str, dict[str, float]] = {'image_px': {
            name: float(np.sqrt(np.nanmean(part)))
            for name, part in self.of_points(linear)._asdict().items()
        }}
        if linear.data.poses is not None:
            return found
        return found | pose_summary(self.of_poses(linear))

    def _covariance_of(self, linear: Linearization) -> Array:
        """Return the covariance of what is shared in a linearization, zero for what is exact."""
        at = {name: i for i, name in enumerate(self.names)}
        index = np.array([at.get(name, len(at)) for name in shared_names(linear)], dtype=np.int64)
        return np.pad(self.covariance, (0, 1))[np.ix_(index, index)]

    def _random_columns(self, linear: Linearization) -> tuple[RandomColumns, Array]:
        """Return the random columns of the frames, and the variance of each component, last 0."""
        alive = self.variances.alive & ~_target_components()
        random = make_random_effects(linear, geometry=self.geometry).select(alive)
        return random.columns, np.append(self.variances.tau**2, 0.0)

    def _landmark_covariances(self, random: RandomColumns, maps: Array) -> Array:
        """Return covariances (F, Q, Q) of linear functions (F, Q, M) by what the target is off."""
        frames, count = random.unit.shape
        shown = (random.unit >= 0)[..., None]
        shift = maps.reshape(frames, -1, count, 2).swapaxes(1, 2) @ random.offset / MILLIMETRE
        alone = shift * (self.geometry.alone[random.unit] * shown)[:, :, None]
        alone = alone.swapaxes(1, 2).reshape(frames, maps.shape[1], -1)
        modes = self.geometry.modes[random.unit] * shown[..., None]
        modes = np.einsum('fnqa,fnak->fqk', shift, modes, optimize=True)
        return np.asarray(alone @ np.swapaxes(alone, -1, -2) + modes @ np.swapaxes(modes, -1, -2))


def pose_summary(parts: ErrorParts) -> dict[str, dict[str, float]]:
    """Return root mean squares of position_m and rotation_rad from covariances (F, 6, 6)."""
    return {
        what: {name: float(np.sqrt(np.trace(part[:, mine, mine], axis1=1, axis2=2).mean()))
               for name, part in parts._asdict().items()}
        for what, mine in (('position_m', slice(0, 3)), ('rotation_rad', slice(3, 6)))
    }


def pose_maps(columns: Array) -> Array:
    """Return what a least-squares pose makes of whitened image points: (F, 6, M) from (F, M, 6).

    Rows that are zero in the columns have no say.
    """
    turned = np.swapaxes(columns, -1, -2)
    return np.asarray(np.linalg.solve(turned @ columns, turned))


def _image_components() -> Index:
    return np.array([i for i, name in enumerate(NAMES) if name.startswith('image_')])


def _target_components() -> Mask:
    return np.array([STAGE_OF[name] == 'target' for name in NAMES])


def shared_names(linear: Linearization) -> tuple[str, ...]:
    """Return the names of what is shared in a linearization: rig, intrinsics, effects."""
    terms = [name for term in linear.state.terms if is_shared(term[0])
             for name in parameter_names(term)]
    rig = linear.shared_columns.shape[-1] - len(linear.free) - len(terms)
    return (*(f'rig.{i}' for i in range(rig)), *linear.free, *terms)


def parameter_names(term: Term) -> list[str]:
    """Return the names of the parameters of an effect, with its own before them."""
    return [f'{term[0].name}.{parameter.name}' for parameter in term[0].parameters]


def _shared_columns(linear: Linearization) -> Array:
    """Return the columns (F, M, K) of what is shared, of the rig where several cameras see."""
    columns = linear.shared_columns.copy()
    rig = 6 * (linear.data.cameras - 1)
    columns[np.bincount(linear.data.frame_of) < 2, :, :rig] = 0.0
    return columns


def _lens_mask(linear: Linearization) -> Array:
    """Return 1 for what is shared (K,) and moves with the lens, 0 for rig and target."""
    terms = [(effect, len(values)) for effect, values in linear.state.terms if is_shared(effect)]
    own = [np.full(count, effect.stage in ('ray', 'image', 'detector')) for effect, count in terms]
    free = len(linear.free)
    rig = linear.shared_columns.shape[-1] - free - sum(count for _, count in terms)
    return np.concatenate([np.zeros(rig), np.ones(free), *own])


def _turn_columns(linear: Linearization) -> Array:
    """Return whitened derivatives (F, M, 3) by a turn of the camera that all frames share."""
    rotation = linear.state.view_poses(linear.data).rotation
    return linear.whiten(np.nan_to_num(linear.linear.d_pose[..., 3:] @ rotation[:, None]))
