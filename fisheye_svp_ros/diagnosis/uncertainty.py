"""How far a pose or an image point may be off: noise, parameters, and the misfit that remains.

What a diagnosis leaves without a name (its variance components) is no noise: it does not average
out over the points of a view.  Carried through the solver, it stands beside noise and parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.diagnosis.evidence import Evidence, pseudo_inverse
from fisheye_svp_ros.diagnosis.gathered import MILLIMETRE, Setting
from fisheye_svp_ros.diagnosis.model import Linearised, flat_rows, is_shared
from fisheye_svp_ros.diagnosis.random_effects import NAMES, STAGE_OF, Design, design
from fisheye_svp_ros.diagnosis.refit import Fitted, target_modes
from fisheye_svp_ros.diagnosis.reml import GONE, Variances


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
class ModelError:
    """What a diagnosis knows of its own errors.

    variances: of the null model; covariance (K, K): of all that is shared, beside it; setting:
    what the variances are of.
    """

    variances: Variances
    covariance: Array
    setting: Setting

    @classmethod
    def of(cls, evidence: Evidence, fitted: Fitted) -> ModelError:
        """Return the errors of what was fitted under a null model; fitted: of the evidence.

        Parameters take up part of an image field that has no name: what it does to them is not
        counted beside the field.
        """
        lam = np.where(np.isin(np.arange(len(NAMES)), _of_the_image()), GONE,
                       evidence.variances.lam)
        bare = replace(evidence, variances=replace(evidence.variances, lam=lam))
        own = np.arange(evidence.own)
        inverse, _ = pseudo_inverse(bare.information[np.ix_(own, own)], 1e-13)
        scale = evidence.scale[own]
        finest = [grid.pitch for grid in evidence.design.grids if grid.name == 'image_finest']
        modes, alone = target_modes(fitted, evidence.variances.sigma)
        return cls(evidence.variances, inverse / np.outer(scale, scale),
                   Setting.of(evidence.linear, max(finest, default=np.nan), modes, alone))

    def of_poses(self, linear: Linearised) -> ErrorParts:
        """Return covariances (F, 6, 6), m and rad, of the change in `Pose.retract` of each frame.

        linear: frames that were posed with the lens of the diagnosis, those it was made of or
        others.
        """
        return self.through(linear, pose_maps(linear.frame_columns))

    def through(self, linear: Linearised, maps: Array) -> ErrorParts:
        """Return covariances (F, Q, Q) of linear functions (F, Q, M) of whitened image points."""
        turned = np.swapaxes(maps, -1, -2)
        shared = maps @ linear.shared_columns
        parameters = shared @ self.covariance @ np.swapaxes(shared, -1, -2)
        random, variance = self._design(linear)
        own = maps @ random.frame
        misfit = (own * variance[random.frame_label]) @ np.swapaxes(own, -1, -2)
        misfit = misfit + self._of_landmarks(random, maps)
        rows = maps.shape[-1]
        for f in range(len(maps)):
            field = (random.shared[f * rows:(f + 1) * rows].T @ turned[f]).T
            misfit[f] += (field * variance[random.shared_label]) @ field.T
        return ErrorParts(self.variances.sigma**2 * maps @ turned, parameters, misfit)

    def of_points(self, linear: Linearised) -> ErrorParts:
        """Return variances (F, M), px^2, of u and v of the points of a fit.

        Of the lens alone: a turn of the camera as a whole is taken out, as poses take it up, and
        what stays with the target is left out.
        """
        turn = _turns(linear)
        weight = linear.row_weight
        columns = linear.shared_columns * _of_the_lens(linear)
        flat, around = flat_rows(columns), flat_rows(turn)
        columns = (flat - around @ np.linalg.lstsq(around, flat, rcond=None)[0]).reshape(
            columns.shape)
        random, variance = self._design(linear)
        misfit = random.frame**2 @ variance[random.frame_label]
        fields = random.shared.power(2) @ np.where(
            np.isin(random.shared_label, _of_the_image()), variance[random.shared_label], 0.0)
        misfit = misfit + np.asarray(fields).reshape(misfit.shape)
        px = np.where(weight > 0, weight, np.nan) ** -2.0
        parameters = np.einsum('fmk,kl,fml->fm', columns, self.covariance, columns)
        return ErrorParts(self.variances.sigma**2 * px, parameters * px, misfit * px)

    def summary(self, linear: Linearised) -> dict[str, dict[str, float]]:
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

    def _design(self, linear: Linearised) -> tuple[Design, Array]:
        """Return the random columns of the frames, and the variance of each component, last 0."""
        alive = self.variances.alive & ~_of_the_target()
        random = design(linear, setting=self.setting).kept(alive)
        return random, np.append(self.variances.tau**2, 0.0)

    def _of_landmarks(self, random: Design, maps: Array) -> Array:
        """Return covariances (F, Q, Q) of linear functions (F, Q, M) by what the target is off."""
        frames, count = random.slot.shape
        shown = (random.slot >= 0)[..., None]
        moved = maps.reshape(frames, -1, count, 2).swapaxes(1, 2) @ random.place / MILLIMETRE
        alone = moved * (self.setting.alone[random.slot] * shown)[:, :, None]
        alone = alone.swapaxes(1, 2).reshape(frames, maps.shape[1], -1)
        modes = self.setting.modes[random.slot] * shown[..., None]
        modes = np.einsum('fnqa,fnak->fqk', moved, modes, optimize=True)
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


def _of_the_image() -> Index:
    return np.array([i for i, name in enumerate(NAMES) if name.startswith('image_')])


def _of_the_target() -> Mask:
    return np.array([STAGE_OF[name] == 'target' for name in NAMES])


def _of_the_lens(linear: Linearised) -> Array:
    """Return 1 for what is shared (K,) and moves with the lens, 0 for rig and target."""
    terms = [(effect, len(values)) for effect, values in linear.state.terms if is_shared(effect)]
    own = [np.full(count, effect.stage in ('ray', 'image', 'detector')) for effect, count in terms]
    free = len(linear.free)
    rig = linear.shared_columns.shape[-1] - free - sum(count for _, count in terms)
    return np.concatenate([np.zeros(rig), np.ones(free), *own])


def _turns(linear: Linearised) -> Array:
    """Return whitened derivatives (F, M, 3) by a turn of the camera that all frames share."""
    rotation = linear.state.view_poses(linear.data).rotation
    return linear.whitened(np.nan_to_num(linear.linear.d_pose[..., 3:] @ rotation[:, None]))
