"""How far a calibration may be trusted, beside random effects and other targets, or in water.

What `calibrate` says of a lens under the null model; what a lens file says of its parameters; and
the lens as photographs under water call for it: in air they seldom fill the image as those through
a port do, and beyond them the curve of a lens may be anything.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.diagnosis.lens_errors import LensErrors
from fisheye_svp_ros.diagnosis.null_model import NullModel
from fisheye_svp_ros.diagnosis.outliers import (
    NO_OUTLIERS,
    Outliers,
    find_outliers,
    without_points,
)
from fisheye_svp_ros.diagnosis.uncertainty import total_errors
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.mixed_model import pseudo_inverse
from fisheye_svp_ros.optics.lens import Lens, field_of_view, intrinsic_names, parameter_values
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.solve.bundle_adjustment import Prior, adjust
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.lens_calibration import Calibration
from fisheye_svp_ros.solve.rig_state import (
    Linearization,
    RigState,
    RigViews,
    group_by_frame,
    is_shared,
)

_SHIFT_NAMES = ('s0', 'e0', 'e1', 'e2', 'thickness')
_INTERVAL_SIGMAS = 2.0  # standard errors of an interval
_MAX_ROUNDS = 4
_KNOWN_SHARE = 0.01  # of an image height, beside what the focal length is off by
_SAMPLES = 200
_REACH_GROWTH = 1.25  # from fit to fit: the field whose points are taken in
_MIN_VIEW_POINTS = 8  # points of a view
_MIN_EIGENVALUE = 1e-8  # eigenvalue of correlations, beside what numbers hold
_MEDIAN_SIZE = 0.6745  # of the size of a normal number
_MAX_SIGMAS = 4.0  # standard deviations, rms, that no intrinsics are off
_INDEX_SIGMA = 0.1  # standard deviation of an index before anything is known of the medium


@dataclass(frozen=True)
class Admissible:
    """A parameter of a lens over all targets that the data admit.

    low, high: of 95 % intervals with the target as it is said to be and with its shape, scale and
    boards free; settled: whether the two agree, for a viewpoint shift also that it is not zero.
    """

    low: float
    high: float
    settled: bool


@dataclass(frozen=True)
class LensTrust:
    """Standard errors of parameters, the target as it is said to be, and their ranges, by name.

    covariance (K, K): of all of them, over all targets that the data admit.
    """

    stderr: dict[str, float]
    admissible: dict[str, Admissible]
    covariance: Array

    @property
    def doubtful_shift(self) -> dict[str, Admissible]:
        """The coefficients of a viewpoint shift that a target of another shape can explain."""
        return {name: range_ for name, range_ in self.admissible.items()
                if name in _SHIFT_NAMES and not range_.settled}


def calibrate_without_outliers(
    observations: Observations, calibrate: Callable[[Observations], Calibration]
) -> tuple[Calibration, Observations, Outliers]:
    """Calibrate a lens of one camera anew for as long as outliers are found.

    calibrate: fits a lens to some of the rows.  Returns the last lens, the rows that it is of, and
    those that are set aside.
    """
    rows = np.arange(len(observations))
    rejected, rounds = NO_OUTLIERS, 0
    while True:
        result = calibrate(observations.take(rows))
        rows = rows[~np.isin(observations.frame[rows], result.left_out)]
        table = observations.take(rows)
        data = group_by_frame(table)
        found = find_outliers(data, initial_state(data, result.adjusted.lens))[1]
        rounds += 1
        if not len(found.rows) or rounds == _MAX_ROUNDS:
            return result, table, rejected
        rejected = rejected.join(found._replace(rows=rows[found.rows]))
        rows = np.delete(rows, found.rows)


def assess_lens(observations: Observations, lens: Lens, names: Sequence[str]) -> LensTrust:
    """Return what the null model of a diagnosis says of a lens fitted to one camera's views.

    names: the parameters that were fitted.
    """
    data = group_by_frame(observations)
    null = NullModel.estimate(data, adjust(data, initial_state(data, lens), names), names)
    # What else the lens has, its corrections, is fitted along and follows them.
    errors = total_errors(null)[: len(names)]
    stderr = {name: float(error) for name, error in zip(names, errors, strict=True)}
    moved, covariance = _free_target(null, len(names))
    values = parameter_values(lens, names)
    admissible = {
        name: _admissible(name, (value, error), (value + step, spread)) for name, value, error,
        step, spread in zip(names, values, errors, moved, np.sqrt(np.diag(covariance)),
                            strict=True)}
    # The values stand for a target as it is said to be: what another would move them by is
    # doubt, too.
    covariance = covariance + np.outer(moved, moved)
    known = np.sqrt(np.diag(covariance))
    larger = np.maximum(np.nan_to_num(errors), known) / np.maximum(known, 1e-300)
    return LensTrust(stderr, admissible, covariance * np.outer(larger, larger))


def with_covariance(lens: Lens, trusted: LensTrust) -> Lens:
    """Return a calibrated lens whose `calibration` says how sure its numbers are, any target.

    stderr: one each, by name; covariance: of all, in the same order.
    """
    errors = np.sqrt(np.diag(trusted.covariance)).tolist()
    return replace(lens, calibration={
        **(lens.calibration or {}), 'stderr': dict(zip(trusted.stderr, errors, strict=True)),
        'covariance': trusted.covariance.tolist()})


def _free_target(null: NullModel, count: int) -> tuple[Array, Array]:
    """Return how far parameters (K,) move once the target is free, and their covariance (K, K).

    count: of these, the first of what is in the model.
    """
    own = null.included_columns
    columns, prior = [own], [np.zeros(null.column_count)]
    for form, effect in enumerate(null.fixed.forms.effects):
        if effect.budget_stage() == 'target':
            columns.append(null.form_columns(form))
            prior.append(null.prior_precision(columns[-1], effect))
    every, information = np.concatenate(columns), null.information
    # Larger errors than `large` are no target that anybody would take for exact.
    inverse, _ = pseudo_inverse(
        information[np.ix_(every, every)] + np.diag(np.concatenate(prior)), 1e-13
    )
    own, scale = own[:count], null.scale[:count]
    return (inverse @ information[every, -1])[own] / scale, (
        inverse[np.ix_(own, own)] / np.outer(scale, scale))


def _admissible(name: str, *found: tuple[float, float]) -> Admissible:
    """Return the range of a parameter from values and standard errors, by target said and free."""
    (value, stderr), (moved, spread) = found
    ends = [middle + sign * _INTERVAL_SIGMAS * error
            for middle, error in found for sign in (-1, 1)]
    sure = name not in _SHIFT_NAMES or min(ends) > 0 or max(ends) < 0
    near = abs(moved - value) < _INTERVAL_SIGMAS * np.hypot(stderr, spread)
    return Admissible(min(ends), max(ends), bool(sure and near))


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
