"""How far off poses and image points may be by a model: noise, parameters, and what remains.

What a diagnosis leaves without a name (its variance components) is no noise: it does not average
out over the points of a view.  Carried through the solver, it stands beside noise and parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask, flat_rows
from fisheye_svp_ros.diagnosis.fitted_model import FittedModel
from fisheye_svp_ros.diagnosis.gathered_points import MILLIMETRE, ColumnGeometry
from fisheye_svp_ros.diagnosis.null_model import FINEST_FIELD, NullModel
from fisheye_svp_ros.diagnosis.random_effects import NAMES, STAGE_OF, make_random_effects
from fisheye_svp_ros.effects.base import Term
from fisheye_svp_ros.mixed_model import (
    LAMBDA_ABSENT,
    RandomColumns,
    Variances,
    pseudo_inverse,
)
from fisheye_svp_ros.solve.rig_state import Linearization, is_shared


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
        rows, columns = maps.shape[-1], random.shared_columns
        for f in range(len(maps)):
            field = (columns[f * rows:(f + 1) * rows].T @ turned[f]).T
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
        label = random.shared_label[: random.shared.shape[1]]
        fields = random.shared.power(2) @ np.where(
            np.isin(label, _image_components()), variance[label], 0.0)
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
