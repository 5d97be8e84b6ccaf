"""What errors depend on: the columns of a table, grouped by what was swept."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy import special

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.simulate.scenario import SCALARS

if TYPE_CHECKING:
    from pandas import DataFrame

_REPEATS = ('seed',)  # differ so that the noise does
_BAND = (5.0, 95.0)  # percent


class ErrorCurve(NamedTuple):
    """An error over values x (X,) of a parameter: median, low and high (5 and 95 %), (X,).

    key: the values of the parameters that tell this curve from the others.
    """

    key: tuple[Any, ...]
    x: list[Any]
    median: Array
    low: Array
    high: Array


class ResidualRatio(NamedTuple):
    """Residuals beside their noise: ratio (K,) of rms to sigma, and the density noise predicts.

    at, density (M,): of that ratio where nothing but noise is in the image points.
    """

    label: str
    ratio: Array
    at: Array
    density: Array


def swept_parameters(table: DataFrame) -> list[str]:
    """Return the parameters that differ between rows, but for those that only redraw noise."""
    return [
        name
        for name in SCALARS
        if name in table and name not in _REPEATS and table[name].nunique() > 1
    ]


def is_number(table: DataFrame, name: str) -> bool:
    """Say whether a column holds numbers."""
    return str(table[name].dtype.kind) in 'iuf'


def curves(table: DataFrame, metric: str, x: str, by: Sequence[str]) -> list[ErrorCurve]:
    """Return an error over parameter x, a curve a combination of the parameters `by`."""
    values, places = _metric_column(table, metric), _slots(table, x)
    groups: dict[tuple[Any, ...], Any] = {(): np.arange(len(values))}
    for name in by:
        groups = {
            (*key, value): np.intersect1d(rows, slot)
            for key, rows in groups.items()
            for value, slot in _slots(table, name).items()
        }
    drawn = []
    for key, rows in groups.items():
        cells = [values[np.intersect1d(rows, place)] for place in places.values()]
        low, middle, high = np.array(
            [
                np.percentile(cell, (_BAND[0], 50.0, _BAND[1])) if len(cell) else [np.nan] * 3
                for cell in (cell[np.isfinite(cell)] for cell in cells)
            ]
        ).T
        drawn.append(ErrorCurve(key, list(places), middle, low, high))
    return drawn


def grid(table: DataFrame, metric: str, x: str, y: str) -> tuple[list[Any], list[Any], Array]:
    """Return values (X,), (Y,) of two parameters, and the median magnitude (Y, X) of an error.

    NaN where there is none.
    """
    values, columns, lines = (
        np.abs(_metric_column(table, metric)),
        _slots(table, x),
        _slots(table, y),
    )
    median = np.full((len(lines), len(columns)), np.nan)
    for i, line in enumerate(lines.values()):
        for j, column in enumerate(columns.values()):
            cell = values[np.intersect1d(line, column)]
            if np.isfinite(cell).any():
                median[i, j] = np.nanmedian(cell)
    return list(columns), list(lines), median


def noise_spreads(table: DataFrame, by: str | None) -> list[ResidualRatio]:
    """Return the residuals of localizations beside what their noise alone would leave.

    N image points of noise sigma in u and in v leave, after a pose is fitted to them, a sum of
    squares of sigma^2 chi^2 with 2 N - 6 degrees of freedom.
    """
    sigma, rms = _metric_column(table, 'noise_px'), _metric_column(table, 'localizer.rms_px')
    points = _metric_column(table, 'localizer.points')
    groups = _slots(table, by) if by else {'': np.arange(len(rms))}
    ratios = []
    for label, rows in groups.items():
        kept = rows[(sigma[rows] > 0) & np.isfinite(rms[rows])]
        if len(kept):
            ratio = rms[kept] / sigma[kept]
            axis = np.linspace(0.0, max(2.5, min(1.1 * ratio.max(), 20.0)), 400)
            counts, share = np.unique(points[kept], return_counts=True)
            # The ratio r is sqrt(chi^2 / N): density of chi^2 at N r^2, times 2 N r.
            density = sum(
                part / len(kept) * _density_of_chi2(n * axis**2, 2 * n - 6) * 2 * n * axis
                for n, part in zip(counts, share, strict=True)
            )
            name = f'{by} {value_text(label)}' if by else ''
            ratios.append(ResidualRatio(name, ratio, axis, np.asarray(density)))
    return ratios


def _density_of_chi2(x: Array, freedom: float) -> Array:
    """Return the density of chi^2; `scipy.stats` takes half a second to import."""
    half = freedom / 2
    logs = special.xlogy(half - 1, x) - x / 2 - half * np.log(2) - special.gammaln(half)
    return np.asarray(np.exp(logs))


def _metric_column(table: DataFrame, name: str) -> Array:
    """Return a column, NaN = empty; of calibrations only those from all sets of a scenario."""
    cells: Array = table[name].to_numpy(float, na_value=np.nan, copy=True)
    if name.startswith('stereo_calibrator.') and {'set', 'sets'} <= {*table}:
        cells[(table['set'] + 1 != table['sets']).to_numpy(bool)] = np.nan
    return cells


def _slots(table: DataFrame, name: str) -> dict[Any, Any]:
    """Return the rows of each value of a column: numbers ascend, names are as they come."""
    rows = table.groupby(name, sort=False).indices
    values = table[name].dropna().unique().tolist()
    return {value: rows[value] for value in (sorted(values) if is_number(table, name) else values)}


def value_text(value: Any) -> str:
    """Return the value of a parameter as text."""
    return f'{value:g}' if isinstance(value, float) else str(value)
