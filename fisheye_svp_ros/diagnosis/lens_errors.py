"""How far off poses and stereo points by a diagnosed lens may be: what its file carries.

`diagnose` writes it into the lens as `uncertainty`; whoever solves with that lens may ask for it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.diagnosis.gathered_points import ColumnGeometry
from fisheye_svp_ros.diagnosis.model_errors import (
    ErrorParts,
    ModelErrors,
    parameter_names,
    pose_maps,
)
from fisheye_svp_ros.diagnosis.random_effects import NAMES, STAGE_OF
from fisheye_svp_ros.effects.extension import Target
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.mixed_model import LAMBDA_ABSENT, Variances
from fisheye_svp_ros.optics.lens import Lens, field_of_view, intrinsic_names, parameter_values
from fisheye_svp_ros.pose import Pose, identity
from fisheye_svp_ros.scene.observations import Views
from fisheye_svp_ros.solve.bundle_adjustment import Prior, adjust
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.localization import Localization
from fisheye_svp_ros.solve.outliers import find_outliers, without_points
from fisheye_svp_ros.solve.rig_state import Linearization, RigState, RigViews, is_shared

_STEP_SIGMAS = 1e-3  # of a standard error
_KNOWN_SHARE = 0.01  # of an image height, beside what the focal length is off by
_SAMPLES = 200
_REACH_GROWTH = 1.25  # from fit to fit: the field whose points are taken in
_MIN_VIEW_POINTS = 8  # points of a view
_MIN_EIGENVALUE = 1e-8  # eigenvalue of correlations, beside what numbers hold
_MEDIAN_SIZE = 0.6745  # of the size of a normal number
_MAX_SIGMAS = 4.0  # standard deviations, rms, that no intrinsics are off
_INDEX_SIGMA = 0.1  # standard deviation of an index before anything is known of the medium


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
    target = Target.from_entries(lens.target, lens.name)
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
            raise LensError(f'lens {lens.name!r} has no uncertainty; use the extended_lens.yaml '
                            'that `diagnose -o` writes')
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
        views, terms = model.assign_boards(views), model.terms_for(views)
        bare = replace(self.lens, corrections={}, target={})
        own = [name for name in self.model.names if name in bare.parameters]
        state = RigState(pose, identity(1), bare, terms)
        return Linearization(RigViews.of_one_camera(views), state, own)


@dataclass(frozen=True)
class InAir:
    """How sure the intrinsics of a lens are: names, covariance (K, K) of their values."""

    lens: Lens
    names: tuple[str, ...]
    covariance: Array

    @classmethod
    def from_lens(cls, lens: Lens) -> InAir | None:
        """Return what a lens file from `calibrate` or `diagnose` tells; None if it is nothing.

        Raises LensError for half of it, or what cannot be.
        """
        if lens.uncertainty is not None:
            errors = LensErrors.from_lens(lens)
            known, whole = errors.model.names, errors.model.covariance
        elif (said := lens.calibration or {}).get('covariance') is None:
            return None
        else:
            known, whole = _stated_covariance(lens, said)
        at = [i for i, name in enumerate(known) if name in ('f', *intrinsic_names(lens))]
        names = tuple(known[i] for i in at)
        return cls(lens, names, whole[np.ix_(at, at)]) if {'f', 'fx'} & set(names) else None

    @property
    def focal(self) -> float:
        """Relative standard error of the focal length."""
        at = next(i for i, name in enumerate(self.names) if name in ('f', 'fx'))
        return float(np.sqrt(self.covariance[at, at])) / self.lens.fx

    @property
    def reach(self) -> float:
        """Distance from the principal point, px, up to which the curve is known."""
        lens = self.lens
        theta = np.linspace(0.0, lens.max_incidence, _SAMPLES)[1:]
        height = lens.image_height.value_and_slope(theta)[0]
        by = {'f': height, 'fx': height, **dict(zip(
            lens.image_height.coefficient_names, lens.fx * lens.image_height.columns(theta).T,
            strict=True))}
        columns = np.stack([by.get(name, np.zeros_like(theta)) for name in self.names], axis=-1)
        spread = np.sqrt(np.einsum('tk,kl,tl->t', columns, self.covariance, columns))
        open_ = spread > (self.focal + _KNOWN_SHARE) * lens.fx * height
        return float(lens.fx * height[np.argmax(open_)]) if open_.any() else np.inf

    def fit_behind_port(
        self, everything: RigViews, lens: Lens, place: tuple[str, ...], index: str
    ) -> Lens | None:
        """Return the lens with the intrinsics that photographs behind its port call for.

        They move within what is known of them, beside the port's `place` and the medium's `index`;
        the field whose points are taken in grows, for beyond it nothing is known of the curve.
        None if they are far from what is known.  Raises GeometryError where a view cannot be
        posed.
        """
        names, reach = (*place, index, *self.names), self.reach
        while near := self.select_points(everything, reach):
            data, _ = find_outliers(near, initial_state(near, lens))
            state = adjust(data, initial_state(data, lens), place)
            state = adjust(data, state, names, self._prior(data, state, index))
            lens = replace(state.lens, max_incidence=field_of_view(state.lens))
            if near.views.used.sum() == everything.views.used.sum():
                break
            reach *= _REACH_GROWTH
        return lens if self.squared_distance(lens) < _MAX_SIGMAS**2 * len(self.names) else None

    def select_points(self, data: RigViews, reach: float) -> RigViews | None:
        """Return the points up to a distance from the principal point, px; None if too few."""
        off = np.linalg.norm(data.views.uv - [self.lens.cx, self.lens.cy], axis=-1)
        inside = data.views.used & (off <= reach)
        whole = (inside | ~data.views.used).all(axis=1, keepdims=True)
        inside &= whole | (inside.sum(axis=1, keepdims=True) >= _MIN_VIEW_POINTS)
        return without_points(data, ~inside) if inside.any() else None

    def squared_distance(self, lens: Lens) -> float:
        """Return how unlikely the intrinsics of a lens are: squares of standard deviations."""
        found, own = (np.array(parameter_values(one, self.names)) for one in (lens, self.lens))
        return float(((self._root @ (found - own)) ** 2).sum())

    @property
    def _root(self) -> Array:
        """What values are off, times this (K, K), is of unit covariance."""
        size = np.sqrt(np.maximum(np.diag(self.covariance), 1e-300))
        values, vectors = np.linalg.eigh(self.covariance / np.outer(size, size))
        return np.asarray((vectors / np.sqrt(np.maximum(values, _MIN_EIGENVALUE))).T / size)

    def _prior(self, data: RigViews, state: RigState, index: str) -> Prior:
        """Return what is known of index and intrinsics, beside rows as noisy as a fit's."""
        linear = Linearization(data, state, ())
        noise = float(np.median(np.abs(linear.residual[linear.row_mask]))) / _MEDIAN_SIZE
        others = sum(len(values) for effect, values in state.terms if is_shared(effect))
        mean = np.concatenate([[state.lens.parameters[index]],
                               parameter_values(self.lens, self.names),
                               np.zeros(others)])
        root = np.zeros((1 + len(self.names), len(mean)))
        root[0, 0] = 1 / _INDEX_SIGMA
        root[1:, 1:1 + len(self.names)] = self._root
        return Prior(mean, noise * root)


def _stated_covariance(lens: Lens, said: Mapping[str, Any]) -> tuple[tuple[str, ...], Array]:
    """Return names and covariance (K, K) from the `calibration` block of a lens file."""
    try:
        names, whole = tuple(said['stderr']), np.array(said['covariance'], dtype=float)
        right = whole.shape == (len(names), len(names)) and np.isfinite(whole).all()
        if not (right and (np.diag(whole) >= 0).all()):
            raise ValueError
    except (KeyError, TypeError, ValueError) as cause:
        raise LensError(f'lens {lens.name!r}: calibration: covariance is no matrix of finite '
                        'numbers, a row and a column for each name in stderr; calibrate anew, or '
                        'leave it out') from cause
    return names, whole


def stated_parameters(lenses: Mapping[str, Lens]) -> dict[str, tuple[float, float]]:
    """Return the parameters of lenses as given, each with the error that its file states."""
    stated = {}
    for camera, lens in lenses.items():
        air = InAir.from_lens(lens)
        errors = {} if air is None else dict(
            zip(air.names, np.sqrt(np.diag(air.covariance)).tolist(), strict=True))
        for name, value in lens.parameters.items():
            error = errors.get('f' if name in ('fx', 'fy') and 'f' in errors else name, 0.0)
            stated[f'{camera}.{name}' if camera else name] = value, error
    return stated
