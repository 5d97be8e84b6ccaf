"""How far off poses and stereo points by a diagnosed lens may be: what its file carries.

`diagnose` writes it into the lens as `uncertainty`; whoever solves with that lens may ask for it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.random_effects import NAMES, STAGE_OF, ColumnGeometry
from fisheye_svp_ros.diagnosis.uncertainty import (
    ErrorParts,
    ModelErrors,
    parameter_names,
    pose_maps,
)
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.effects.target import Target
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.mixed_model import LAMBDA_ABSENT, Variances
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, identity
from fisheye_svp_ros.scene.observations import Observations, Views, views_of
from fisheye_svp_ros.solve.localization import Localization
from fisheye_svp_ros.solve.measured_poses import MeasuredPoses, localize_measured
from fisheye_svp_ros.solve.rig_state import Linearization, RigState, RigViews

_STEP_SIGMAS = 1e-3  # of a standard error
_MAX_POINTS = 500  # stereo points


def with_uncertainty(
    errors: ModelErrors, linear: Linearization, noise: float, misfit: float,
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
        if k < 6 * (linear.data.cameras - 1) or not stderr:
            continue  # of the rig
        step = np.zeros(len(errors.covariance))
        step[k] = _STEP_SIGMAS * stderr
        one, other = (lenses_of(linear.state.retract(linear.free, frames, way))
                      for way in (step, -step))
        for name, columns in by.items():
            values = [np.array([*_numbers(lens[name]).values()]) for lens in (one, other)]
            columns[:, k] = (values[0] - values[1]) / (2 * step[k])
    return {
        name: replace(lens, uncertainty=_entry(
            errors, camera, noise, misfit, by[name] @ errors.covariance @ by[name].T,
            list(_numbers(lens))))
        for camera, (name, lens) in enumerate(lenses.items())
    }


def _numbers(lens: Lens) -> dict[str, float]:
    """Return all numbers of a lens: of its curves, its corrections and those of its target."""
    target = Target.of(lens.target, lens.name)
    terms = (*ForwardModel(lens).terms, *(target.terms if target else ()))
    return {**lens.parameters, **{
        name: float(value) for term in terms for name, value in
        zip(parameter_names(term), term[1], strict=True)}}


def _entry(
    errors: ModelErrors, camera: int, noise: float, misfit: float, covariance: Array,
    names: list[str],
) -> dict[str, Any]:
    geometry, variances = errors.geometry, errors.variances
    sizes = {name: float(size) for name, size in zip(NAMES, variances.tau, strict=True)
             if size and STAGE_OF[name] != 'target'}
    modes = geometry.modes.reshape(len(geometry.points), -1)
    off = np.concatenate([geometry.alone, modes], axis=1)
    known = np.diag(covariance) > 0
    return {
        'noise_px': noise, 'misfit_px': misfit,
        'parameters': [name for name, there in zip(names, known, strict=True) if there],
        'covariance': covariance[np.ix_(known, known)].tolist(),
        'components': sizes,
        'extent_px': geometry.extents[camera].tolist(),
        'finest_px': float(geometry.finest) if np.isfinite(geometry.finest) else None,
        'landmarks': [[*pair, *place, *(float(f'{value:.6g}') for value in values)]
                      for *pair, place, values in zip(
            geometry.landmark.tolist(), geometry.board.tolist(), geometry.points.tolist(), off,
            strict=True)],
    }


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
            raise LensError(f'lens {lens.name!r} has no uncertainty; the extended_lens.yaml that '
                            '`diagnose -o` writes has')
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
                np.nan if finest is None else float(finest), ids, boards, rows[:, 2:5],
                rows[:, 8:].reshape(len(rows), 3, -1), rows[:, 5:8])
            names = tuple(map(str, entry['parameters']))
            covariance = np.array(entry['covariance'], dtype=float).reshape(len(names), len(names))
            found = cls(lens, float(entry['noise_px']), float(entry['misfit_px']),
                        ModelErrors(names, covariance, Variances(1.0, lam, np.zeros(0)), geometry))
        except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as cause:
            raise LensError(f'lens {lens.name!r}: uncertainty is incomplete ({cause})') from cause
        numbers = (found.noise, found.misfit, *covariance.ravel(), *size)
        wide = np.diff(geometry.extents, axis=1) > 0
        if not (np.isfinite(numbers).all() and found.noise > 0 and len(rows) and wide.all()
                and np.isfinite(rows).all() and (np.diag(covariance) >= 0).all()):
            raise LensError(f'lens {lens.name!r}: uncertainty holds a number that cannot be')
        return found

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

        sigma: noise that was estimated with weights of 1, px, in whose place that of the lens is
        taken; None where weights are 1 / `inflate_sigma(sigma)`.  A pose whose misfit the solver
        found to be more than it may be is so much more uncertain.
        """
        linear = self.linearize(views, solved.pose)
        maps = pose_maps(linear.frame_columns)
        parts = self.model.propagate(linear, maps)
        excess = np.trace(solved.covariance, axis1=1, axis2=2)
        excess = excess / np.trace(parts.noise, axis1=1, axis2=2) / (sigma or 1.0) ** 2
        if sigma is None:
            weight = linear.data.blocks(views.weight[..., None] * np.ones(2))
            of_noise = 1 - (self.misfit * weight) ** 2
        else:
            of_noise = np.full(maps.shape[::2], self.noise**2)
        parts = parts._replace(noise=(maps * of_noise[:, None]) @ np.swapaxes(maps, -1, -2))
        return ErrorParts(*(part * excess[:, None, None] for part in parts))

    def linearize(self, views: Views, pose: Pose) -> Linearization:
        """Linearise views of this lens, with the numbers that are uncertain free."""
        model = ForwardModel(self.lens)
        views, terms = model.labelled(views), model.terms_for(views)
        bare = replace(self.lens, corrections={}, target={})
        own = [name for name in self.model.names if name in bare.parameters]
        state = RigState(pose, identity(1), bare, terms)
        return Linearization(RigViews.of_one_camera(views), state, own)


def localize_with_errors(
    errors: LensErrors, observations: Observations
) -> tuple[MeasuredPoses, ErrorParts]:
    """Pose every frame of one camera's table that can be posed, and say how far off each may be.

    Raises ObservationError and GeometryError as `localize_measured` does.
    """
    allowed = replace(observations, sigma=np.asarray(errors.inflate_sigma(observations.sigma)))
    found = localize_measured(ForwardModel(errors.lens), allowed)
    kept = found.views._replace(weight=np.where(found.gross, 0.0, found.views.weight))
    parts = errors.of_solved_poses(kept, found.result, found.sigma)
    return found._replace(result=found.result._replace(covariance=parts.total)), parts


def depth_errors(left: LensErrors, right: LensErrors, rig: Pose, points: Array) -> ErrorParts:
    """Return covariances (N, 3, 3), m^2, of stereo points (N, 3), m, in the right camera.

    Of points of least reprojection error; rig: left camera in the right one, taken as it is.  NaN
    where a point is NaN or a camera does not see it.
    """
    found = [np.full((len(points), 3, 3), np.nan) for _ in ErrorParts._fields]
    for rows in _split_rows(np.flatnonzero(np.isfinite(points).all(axis=1))):
        views = views_of(points[rows, None], np.zeros((len(rows), 1, 2)))
        pairs = [(errors, errors.linearize(views, pose)) for errors, pose in (
            (left, rig.broadcast_to(len(rows))), (right, identity(len(rows))))]
        by = [linear.whiten(linear.linear.d_target) / errors.noise for errors, linear in pairs]
        seen = np.asarray(np.isfinite(by[0] + by[1]).all(axis=(1, 2)))
        by = [np.where(seen[:, None, None], one, np.eye(2, 3)) for one in by]
        rows_of_both = np.concatenate(by, axis=1)
        information = np.swapaxes(rows_of_both, -1, -2) @ rows_of_both
        information[~seen] = np.eye(3)
        for (errors, linear), one in zip(pairs, by, strict=True):
            maps = np.linalg.solve(information * errors.noise, np.swapaxes(one, -1, -2))
            parts = errors.model.propagate(linear, np.asarray(maps))
            parts = parts._replace(noise=parts.noise * errors.noise**2)
            for whole, part in zip(found, parts, strict=True):
                whole[rows] = np.nan_to_num(whole[rows]) + part
        for whole in found:
            whole[rows[~seen]] = np.nan
    return ErrorParts(*found)


def _split_rows(rows: Index) -> Iterator[Index]:
    for first in range(0, len(rows), _MAX_POINTS):
        yield rows[first:first + _MAX_POINTS]
