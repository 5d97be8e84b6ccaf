"""How far a calibration may be trusted, beside random local errors and other targets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fisheye_svp_ros.diagnosis.budget import stage_of
from fisheye_svp_ros.diagnosis.causes import standard_errors
from fisheye_svp_ros.diagnosis.evidence import Evidence, gather_evidence, pseudo_inverse
from fisheye_svp_ros.diagnosis.model import fit, prepare, start
from fisheye_svp_ros.diagnosis.noise import NO_GROSS, Gross, find_gross_errors
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
    """Standard errors of parameters, the target as it is said to be, and their ranges, by name."""

    stderr: dict[str, float]
    admissible: dict[str, Admissible]

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
    errors = standard_errors(evidence)
    stderr = {name: float(error) for name, error in zip(names, errors, strict=True)}
    return Trust(stderr, {
        name: _over_targets(evidence, i, name, float(value), stderr[name])
        for i, (name, value) in enumerate(zip(names, parameter_values(lens, names), strict=True))
    })


def with_stderr(lens: Lens, trusted: Trust) -> Lens:
    """Return a calibrated lens whose `calibration` says how sure its numbers are, with any target.

    A standard error each: a quarter of the 95 % range.
    """
    known = {name: (one.high - one.low) / (2 * _WIDE) for name, one in trusted.admissible.items()}
    return replace(lens, calibration={**(lens.calibration or {}), 'stderr': known})


def _over_targets(
    evidence: Evidence, column: int, name: str, value: float, stderr: float
) -> Admissible:
    """Return the range of a parameter with the target as it is said to be, and free."""
    columns, prior = [np.arange(evidence.own)], [np.zeros(evidence.own)]
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
    scale = evidence.scale[column]
    moved = value + float((inverse @ information[every, -1])[column] / scale)
    spread = float(np.sqrt(max(inverse[column, column], 0.0)) / scale)
    pairs = ((value, stderr), (moved, spread))
    ends = [middle + sign * _WIDE * error for middle, error in pairs for sign in (-1, 1)]
    sure = name not in _SHIFT_NAMES or min(ends) > 0 or max(ends) < 0
    near = abs(moved - value) < _WIDE * np.hypot(stderr, spread)
    return Admissible(min(ends), max(ends), bool(sure and near))
