"""How far a calibration may be trusted, beside random effects and other targets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.diagnosis import NullModel, total_errors
from fisheye_svp_ros.mixed_model import pseudo_inverse
from fisheye_svp_ros.optics.lens import Lens, parameter_values
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.solve.bundle_adjustment import adjust
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.lens_calibration import Calibration
from fisheye_svp_ros.solve.outliers import NO_OUTLIERS, Outliers, find_outliers
from fisheye_svp_ros.solve.rig_state import group_by_frame

_SHIFT_NAMES = ('s0', 'e0', 'e1', 'e2', 'thickness')
_INTERVAL_SIGMAS = 2.0  # standard errors of an interval
_MAX_ROUNDS = 4


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
    """Return what the null model says of a lens fitted to one camera's views, names being free."""
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
