"""How far off poses and image points may be by a model: noise, parameters, and what remains.

What a diagnosis leaves without a name (its variance components) is no noise: it does not average
out over the points of a view.  Carried through the solver, it stands beside noise and parameters.
`diagnose` writes all of it into the lens as `uncertainty`; who solves with that lens may ask it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask, flat_rows
from fisheye_svp_ros.diagnosis.fitted_model import FittedModel
from fisheye_svp_ros.diagnosis.null_model import FINEST_FIELD, NullModel
from fisheye_svp_ros.diagnosis.random_effects import (
    IN_MILLIMETRES,
    MILLIMETRE,
    NAMES,
    STAGE_OF,
    ColumnGeometry,
    make_random_effects,
)
from fisheye_svp_ros.effects.base import Effect
from fisheye_svp_ros.effects.extension import Target
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.effects.resizing import ImageChange, resize_covariance
from fisheye_svp_ros.effects.target_map import KnownTarget
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.mixed_model import (
    LAMBDA_ABSENT,
    RandomColumns,
    Variances,
    no_variances,
    pseudo_inverse,
)
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, identity
from fisheye_svp_ros.scene.observations import Views
from fisheye_svp_ros.solve.localization import Localization
from fisheye_svp_ros.solve.rig_state import Linearization, RigState, RigViews, is_shared

_STEP_SIGMAS = 1e-3  # of a standard error
_OF_IMAGE = np.array([name.startswith('image_') for name in NAMES])  # components
_OF_TARGET = np.array([STAGE_OF[name] == 'target' for name in NAMES])


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
    these; geometry: what they are of, None for a lens without such effects.
    """

    names: tuple[str, ...]
    covariance: Array
    variances: Variances
    geometry: ColumnGeometry | None

    @classmethod
    def from_null_model(cls, null: NullModel, fitted: FittedModel) -> ModelErrors:
        """Return the errors of what was fitted under a null model.

        Parameters take up part of an image field that has no name: what it does to them is not
        counted beside the field.
        """
        lam = np.where(_OF_IMAGE, LAMBDA_ABSENT, null.variances.lam)
        bare = replace(null, variances=replace(null.variances, lam=lam))
        own, scale = null.included_columns, null.scale[: null.column_count]
        inverse = pseudo_inverse(bare.information[np.ix_(own, own)], 1e-13)
        finest = [grid.pitch for grid in null.random.grids if grid.name == FINEST_FIELD]
        modes, alone = fitted.target_modes(null.variances.sigma)
        geometry = ColumnGeometry.measure(
            null.linear, max(finest, default=np.nan), modes, alone, null.random.normals
        )
        return cls(
            shared_names(null.linear), inverse / np.outer(scale, scale), null.variances, geometry
        )

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
        noise = self.variances.sigma**2 * maps @ turned
        if self.geometry is None:
            return ErrorParts(noise, parameters, np.zeros_like(noise))
        random, variance = self._random_columns(linear)
        own = maps @ random.group
        misfit = (own * variance[random.group_label]) @ np.swapaxes(own, -1, -2)
        misfit = misfit + self._landmark_covariances(random, maps)
        rows, columns = maps.shape[-1], random.shared_columns
        for f in range(len(maps)):
            field = (columns[f * rows : (f + 1) * rows].T @ turned[f]).T
            misfit[f] += (field * variance[random.shared_label]) @ field.T
        return ErrorParts(noise, parameters, misfit)

    def of_points(self, linear: Linearization) -> ErrorParts:
        """Return variances (F, M), px^2, of u and v of the points of a fit.

        Of the lens alone: a turn of the camera as a whole is taken out, as poses take it up, and
        what stays with the target is left out.
        """
        turn = _turn_columns(linear)
        weight = linear.row_weight
        columns = linear.shared_columns * mask_shared(
            linear, lambda effect: effect.stage in ('pupil', 'ray', 'image', 'detector')
        )
        flat, around = flat_rows(columns), flat_rows(turn)
        columns = (flat - around @ np.linalg.lstsq(around, flat, rcond=None)[0]).reshape(
            columns.shape
        )
        random, variance = self._random_columns(linear)
        misfit = random.group**2 @ variance[random.group_label]
        label = random.shared_label[: random.shared.shape[1]]
        fields = random.shared.power(2) @ np.where(
            np.append(_OF_IMAGE, False)[label], variance[label], 0.0
        )
        misfit = misfit + np.asarray(fields).reshape(misfit.shape)
        px = np.where(weight > 0, weight, np.nan) ** -2.0
        parameters = np.einsum('fmk,kl,fml->fm', columns, self._covariance_of(linear), columns)
        return ErrorParts(self.variances.sigma**2 * px, parameters * px, misfit * px)

    def summary(self, linear: Linearization) -> dict[str, dict[str, float]]:
        """Return root mean squares of what each part adds, over the frames and points of a fit.

        position_m, rotation_rad: of a pose from one frame; image_px: of a coordinate.
        """
        found: dict[str, dict[str, float]] = {
            'image_px': {
                name: float(np.sqrt(np.nanmean(part)))
                for name, part in self.of_points(linear)._asdict().items()
            }
        }
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
        alive = self.variances.alive & ~_OF_TARGET
        random = make_random_effects(linear, geometry=self.geometry).select(alive)
        return random.columns, np.append(self.variances.tau**2, 0.0)

    def _landmark_covariances(self, random: RandomColumns, maps: Array) -> Array:
        """Return covariances (F, Q, Q) of linear functions (F, Q, M) by what the target is off."""
        assert self.geometry is not None
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
        what: {
            name: float(np.sqrt(np.trace(part[:, mine, mine], axis1=1, axis2=2).mean()))
            for name, part in parts._asdict().items()
        }
        for what, mine in (('position_m', slice(0, 3)), ('rotation_rad', slice(3, 6)))
    }


def pose_maps(columns: Array) -> Array:
    """Return what a least-squares pose makes of whitened image points: (F, 6, M) from (F, M, 6).

    Rows that are zero in the columns have no say.
    """
    turned = np.swapaxes(columns, -1, -2)
    return np.asarray(np.linalg.solve(turned @ columns, turned))


def shared_names(linear: Linearization, state: RigState | None = None) -> tuple[str, ...]:
    """Return the names of what is shared in a linearization: rig, intrinsics, effects.

    state: whose effects, None for its own.
    """
    terms = [
        name
        for term in (state or linear.state).terms
        if is_shared(term.effect)
        for name in parameter_names(term.effect)
    ]
    rig = (f'rig.{i}' for i in range(count_rig_columns(linear)))
    return (*rig, *linear.free, *terms)


def count_rig_columns(linear: Linearization) -> int:
    """Return how many of what is shared, the first ones, place further cameras and boards."""
    return 6 * (len(linear.state.rig.position) - 1)


def parameter_names(effect: Effect) -> list[str]:
    """Return the names of the parameters of an effect, with its own before them."""
    return [f'{effect.name}.{parameter.name}' for parameter in effect.parameters]


def _shared_columns(linear: Linearization) -> Array:
    """Return the columns (F, M, K) of what is shared, of the rig where several cameras see."""
    columns = linear.shared_columns.copy()
    rig = 6 * (linear.data.cameras - 1)
    columns[np.bincount(linear.data.frame_of) < 2, :, :rig] = 0.0
    return columns


def mask_shared(linear: Linearization, which: Callable[[Effect], bool]) -> Mask:
    """Return which of what is shared (K,) are intrinsics, or effects of some kind."""
    own = [
        np.full(len(term.values), which(term.effect))
        for term in linear.state.terms
        if is_shared(term.effect)
    ]
    return np.concatenate(
        [
            np.zeros(count_rig_columns(linear), dtype=bool),
            np.ones(len(linear.free), dtype=bool),
            *own,
        ]
    )


def _turn_columns(linear: Linearization) -> Array:
    """Return whitened derivatives (F, M, 3) by a turn of the camera that all frames share."""
    rotation = linear.state.view_poses(linear.data).rotation
    return linear.whiten(np.nan_to_num(linear.linear.d_pose[..., 3:] @ rotation[:, None]))


def with_uncertainty(
    errors: ModelErrors,
    linear: Linearization,
    noise: float,
    misfit: float,
    lenses_of: Callable[[RigState], Mapping[str, Lens]],
) -> dict[str, Lens]:
    """Return the lenses of a diagnosis, each with what is known of its errors.

    linear: the fit; noise, and misfit that remains, px; lenses_of: makes lenses of its state.
    """
    lenses, by = lenses_of(linear.state), {}
    for name in lenses:
        by[name] = np.zeros((len(_numbers(lenses[name])), len(errors.covariance)))
    frames = np.zeros((linear.data.frames, 6))
    for k, stderr in enumerate(np.sqrt(np.diag(errors.covariance))):
        if k < count_rig_columns(linear) or not stderr:
            continue  # of the rig
        step = np.zeros(len(errors.covariance))
        step[k] = _STEP_SIGMAS * stderr
        one, other = (
            lenses_of(linear.state.retract(linear.free, frames, way)) for way in (step, -step)
        )
        for name, columns in by.items():
            values = [np.array([*_numbers(lens[name]).values()]) for lens in (one, other)]
            columns[:, k] = (values[0] - values[1]) / (2 * step[k])
    return {
        name: replace(
            lens,
            uncertainty=_entry(
                errors,
                camera,
                noise,
                misfit,
                by[name] @ errors.covariance @ by[name].T,
                list(_numbers(lens)),
            ),
        )
        for camera, (name, lens) in enumerate(lenses.items())
    }


def _numbers(lens: Lens) -> dict[str, float]:
    """Return all numbers of a lens: of its curves, its corrections and those of its target."""
    target = Target.from_entries(lens.target, lens.name)
    terms = (*ForwardModel(lens).terms, *(target.terms if target else ()))
    return {
        **lens.parameters,
        **{
            name: float(value)
            for term in terms
            for name, value in zip(parameter_names(term.effect), term.values, strict=True)
        },
    }


def _entry(
    errors: ModelErrors,
    camera: int,
    noise: float,
    misfit: float,
    covariance: Array,
    names: list[str],
) -> dict[str, Any]:
    geometry, variances = errors.geometry, errors.variances
    assert geometry is not None
    sizes = {
        name: float(size)
        for name, size in zip(NAMES, variances.tau, strict=True)
        if size and STAGE_OF[name] != 'target'
    }
    target = geometry.target
    modes = geometry.modes.reshape(len(target.points), -1)
    off = np.concatenate([geometry.alone, modes], axis=1)
    known = np.diag(covariance) > 0
    return {
        'noise_px': noise,
        'misfit_px': misfit,
        'parameters': [name for name, there in zip(names, known, strict=True) if there],
        'covariance': covariance[np.ix_(known, known)].tolist(),
        'components': sizes,
        'extent_px': geometry.extents[camera].tolist(),
        'finest_px': float(geometry.finest) if np.isfinite(geometry.finest) else None,
        'normals': geometry.normals.tolist(),
        'landmarks': [
            [*pair, *place, *(float(f'{value:.6g}') for value in values)]
            for *pair, place, values in zip(
                target.landmark.tolist(),
                target.board.tolist(),
                target.points.tolist(),
                off,
                strict=True,
            )
        ],
    }


def _mean_normals(entry: Mapping[str, Any], boards: Index) -> Array:
    """Return the mean normals (boards, 3) that an entry holds; zeros in older files."""
    shape = len(np.unique(boards)), 3
    return np.array(entry.get('normals', np.zeros(shape)), dtype=float).reshape(shape)


def calibrated_covariance(lens: Lens) -> tuple[tuple[str, ...], Array] | None:
    """Return names and covariance (K, K) from the `calibration` block of a lens; None without.

    Raises LensError for half of it, or what cannot be.
    """
    stated = lens.calibration or {}
    if stated.get('covariance') is None:
        return None
    try:
        names, whole = tuple(stated['stderr']), np.array(stated['covariance'], dtype=float)
        right = whole.shape == (len(names), len(names)) and np.isfinite(whole).all()
        if not (right and (np.diag(whole) >= 0).all()):
            raise ValueError
    except (KeyError, TypeError, ValueError) as cause:
        raise LensError(
            f'lens {lens.name!r}: calibration: covariance is not a matrix of finite numbers '
            'with a row and a column for each name in stderr. Calibrate again, or leave it out'
        ) from cause
    return names, whole


def resize_uncertainty(entry: Mapping[str, Any], change: ImageChange) -> dict[str, Any]:
    """Return what the file of a lens says of its errors, for an image that is cut and scaled.

    change: of both axes alike.
    """
    scale = change.mean_scale
    found = dict(entry)
    for name in ('noise_px', 'misfit_px', 'finest_px'):
        if isinstance(entry.get(name), float):
            found[name] = scale * entry[name]
    if 'extent_px' in entry:
        found['extent_px'] = change.apply(np.array(entry['extent_px'], dtype=float)).tolist()
    if 'covariance' in entry:
        names, covariance = entry['parameters'], np.array(entry['covariance'], dtype=float)
        covariance = covariance.reshape(len(names), len(names))
        found['covariance'] = resize_covariance(names, covariance, change).tolist()
    if 'components' in entry:
        found['components'] = {
            name: size if name in IN_MILLIMETRES else scale * size
            for name, size in entry['components'].items()
        }
    return found


@dataclass(frozen=True)
class LensErrors:
    """A lens and what its file says of its errors.

    noise, misfit: of a coordinate of an image point, px; model: of its parameters, and of what
    remains without a name, over the noise.
    """

    lens: Lens
    noise: float
    misfit: float
    model: ModelErrors

    @classmethod
    def from_lens(cls, lens: Lens) -> LensErrors:
        """Return what a lens carries; raise LensError for one that carries nothing, or half."""
        entry = lens.uncertainty
        if entry is None:
            return cls._from_calibration(lens)
        try:
            size = np.array([float(entry['components'].get(name, 0.0)) for name in NAMES])
            lam = np.where(size > 0, 1 / np.maximum(size, 1e-30) ** 2, LAMBDA_ABSENT)
            finest = entry['finest_px']
            rows = np.array(entry['landmarks'], dtype=float)
            rows = rows.reshape(len(rows), -1)
            if rows.shape[1] < 8:
                raise ValueError('landmarks without how far they may be off')
            ids, boards = (np.array([*map(int, rows[:, i])], dtype=np.int64) for i in (0, 1))
            geometry = ColumnGeometry(
                np.array(entry['extent_px'], dtype=float).reshape(1, 2, 2),
                np.nan if finest is None else float(finest),
                KnownTarget(ids, boards, rows[:, 2:5]),
                rows[:, 8:].reshape(len(rows), 3, -1),
                rows[:, 5:8],
                _mean_normals(entry, boards),
            )
            names = tuple(map(str, entry['parameters']))
            covariance = np.array(entry['covariance'], dtype=float).reshape(len(names), len(names))
            found = cls(
                lens,
                float(entry['noise_px']),
                float(entry['misfit_px']),
                ModelErrors(names, covariance, Variances(1.0, lam, np.zeros(0)), geometry),
            )
        except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as cause:
            raise LensError(f'lens {lens.name!r}: uncertainty is incomplete ({cause})') from cause
        numbers = (found.noise, found.misfit, *covariance.ravel(), *size)
        wide = np.diff(geometry.extents, axis=1) > 0
        if not (
            np.isfinite(numbers).all()
            and found.noise > 0
            and len(rows)
            and wide.all()
            and np.isfinite(rows).all()
            and np.isfinite(geometry.normals).all()
            and (np.diag(covariance) >= 0).all()
        ):
            raise LensError(f'lens {lens.name!r}: uncertainty holds a number that cannot be')
        return found

    @classmethod
    def _from_calibration(cls, lens: Lens) -> LensErrors:
        """Return what `calibrate` states: whatever its fit leaves counts as noise."""
        stated, rms = calibrated_covariance(lens), (lens.calibration or {}).get('rms_px')
        if stated is None or not isinstance(rms, float) or not 0 < rms < np.inf:
            raise LensError(
                f'lens {lens.name!r} has no uncertainty; use a lens that `calibrate` or '
                '`diagnose -o` writes'
            )
        return cls(
            lens, rms / 2**0.5, 0.0, ModelErrors(*stated, no_variances(len(NAMES), 0), None)
        )

    def inflate_sigma(self, sigma: Array | float) -> Array | float:
        """Return sigma (...), px, of image points by this lens: noise and what remains."""
        return np.hypot(sigma, self.misfit)

    def of_poses(self, views: Views, pose: Pose) -> ErrorParts:
        """Return covariances (S, 6, 6), m and rad, of poses, for noise of 1 / weight."""
        linear = self.linearize(views, pose)
        return self.model.propagate(linear, pose_maps(linear.frame_columns))

    def of_solved_poses(
        self, views: Views, solved: Localization, sigma: float | None
    ) -> ErrorParts:
        """Return covariances (S, 6, 6), m and rad, of the change in `Pose.retract` of poses.

        sigma: noise and misfit that were estimated with weights of 1, px: the noise is what they
        leave beside the misfit of the lens, and at least that of the lens; None where weights are
        1 / `inflate_sigma(sigma)`.  A pose whose misfit the solver
        found to be more than it may be is so much more uncertain.
        """
        linear = self.linearize(views, solved.pose)
        maps = pose_maps(linear.frame_columns)
        parts = self.model.propagate(linear, maps)
        excess = np.trace(solved.covariance - solved.added, axis1=1, axis2=2)
        excess = excess / np.trace(parts.noise, axis1=1, axis2=2) / (sigma or 1.0) ** 2
        if sigma is None:
            weight = linear.data.blocks(views.weight[..., None] * np.ones(2))
            of_noise = 1 - (self.misfit * weight) ** 2
        else:
            # Points of a room need not be as sharp as those of a board.
            measured = max(sigma**2 - self.misfit**2, 0.0)
            of_noise = np.full(maps.shape[::2], max(self.noise**2, measured))
        parts = parts._replace(noise=(maps * of_noise[:, None]) @ np.swapaxes(maps, -1, -2))
        parts = ErrorParts(*(part * excess[:, None, None] for part in parts))
        return parts._replace(noise=parts.noise + solved.added)

    def linearize(self, views: Views, pose: Pose) -> Linearization:
        """Linearize views of this lens, with the numbers that are uncertain free."""
        model = ForwardModel(self.lens)
        views, terms = model.assign_boards(views), model.terms_for(views)
        bare = replace(self.lens, corrections={}, target={})
        own = [name for name in self.model.names if name == 'f' or name in bare.parameters]
        state = RigState(pose, identity(1), bare, terms)
        return Linearization(RigViews.of_one_camera(views), state, own)
