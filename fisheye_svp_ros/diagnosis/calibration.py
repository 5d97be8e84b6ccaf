"""How far a calibration may be trusted, beside random local errors and other targets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.diagnosis.adjustment import fit, start
from fisheye_svp_ros.diagnosis.budget import stage_of
from fisheye_svp_ros.diagnosis.evidence import Evidence, gather_evidence, pseudo_inverse
from fisheye_svp_ros.diagnosis.model import prepare
from fisheye_svp_ros.diagnosis.noise import NO_GROSS, Gross, find_gross_errors
from fisheye_svp_ros.diagnosis.standard_errors import honest_errors
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.solve.lens_adjustment import parameter_values
from fisheye_svp_ros.solve.lens_calibration import Calibration

_SHIFT_NAMES = ('s0', 'e0', 'e1', 'e2', 'thickness')
_WIDE = 2.0  # standard errors of an interval
_ROUNDS = 4


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
class Trust:
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


def calibrated_without_gross_errors(
    observations: Observations, calibrate: Callable[[Observations], Calibration]
) -> tuple[Calibration, Observations, Gross]:
    """Calibrate a lens of one camera anew for as long as gross errors are found.

    calibrate: fits a lens to some of the rows.  Returns the last lens, the rows that it is of, and
    those that are set aside.
    """
    rows = np.arange(len(observations))
    gross, rounds = NO_GROSS, 0
    while True:
        result = calibrate(observations.take(rows))
        rows = rows[~np.isin(observations.frame[rows], result.left_out)]
        table = observations.take(rows)
        data = prepare(table)
        found = find_gross_errors(data, start(data, result.adjusted.lens))[1]
        rounds += 1
        if not len(found.rows) or rounds == _ROUNDS:
            return result, table, gross
        gross = gross.joined(found._replace(rows=rows[found.rows]))
        rows = np.delete(rows, found.rows)


def trust(observations: Observations, lens: Lens, names: Sequence[str]) -> Trust:
    """Return what the null model of a diagnosis says of a lens fitted to one camera's views.

    names: the parameters that were fitted.
    """
    data = prepare(observations)
    evidence = gather_evidence(data, fit(data, start(data, lens), names), names)
    # What else the lens has, its corrections, is fitted along and follows them.
    errors = honest_errors(evidence)[: len(names)]
    stderr = {name: float(error) for name, error in zip(names, errors, strict=True)}
    moved, covariance = _any_target(evidence, len(names))
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
    return Trust(stderr, admissible, covariance * np.outer(larger, larger))


def with_stderr(lens: Lens, trusted: Trust) -> Lens:
    """Return a calibrated lens whose `calibration` says how sure its numbers are, any target.

    stderr: one each, by name; covariance: of all, in the same order.
    """
    errors = np.sqrt(np.diag(trusted.covariance)).tolist()
    return replace(lens, calibration={
        **(lens.calibration or {}), 'stderr': dict(zip(trusted.stderr, errors, strict=True)),
        'covariance': trusted.covariance.tolist()})


def _any_target(evidence: Evidence, count: int) -> tuple[Array, Array]:
    """Return how far parameters (K,) move once the target is free, and their covariance (K, K).

    count: of these, the first of what is in the model.
    """
    own = np.arange(evidence.own)
    columns, prior = [own], [np.zeros(evidence.own)]
    for form, effect in enumerate(evidence.forms.effects):
        if stage_of(effect.name) == 'target':
            columns.append(evidence.columns_of(form))
            large = np.array([parameter.large for parameter in effect.parameters])
            prior.append(1 / (large * evidence.scale[columns[-1]]) ** 2)
    every, information = np.concatenate(columns), evidence.information
    # Larger errors than `large` are no target that anybody would take for exact.
    inverse, _ = pseudo_inverse(
        information[np.ix_(every, every)] + np.diag(np.concatenate(prior)), 1e-13
    )
    own, scale = own[:count], evidence.scale[:count]
    return (inverse @ information[every, -1])[own] / scale, (
        inverse[np.ix_(own, own)] / np.outer(scale, scale))


def _admissible(name: str, *found: tuple[float, float]) -> Admissible:
    """Return the range of a parameter from values and standard errors, by target said and free."""
    (value, stderr), (moved, spread) = found
    ends = [middle + sign * _WIDE * error for middle, error in found for sign in (-1, 1)]
    sure = name not in _SHIFT_NAMES or min(ends) > 0 or max(ends) < 0
    near = abs(moved - value) < _WIDE * np.hypot(stderr, spread)
    return Admissible(min(ends), max(ends), bool(sure and near))
