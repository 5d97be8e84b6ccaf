"""What the search writes: the two lenses, the layout, and the family of all fits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmark.studies.paper.search import INNER, Recovered, lens_with
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.io.lens_files import lens_to_dict
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.paper.extensions import pose_sets
from fisheye_svp_ros.paper.lens_evaluation import calibrate_rigs
from fisheye_svp_ros.paper.studies import NAMES
from fisheye_svp_ros.paper.tables import LENSES, agreeing

COMMAND = 'python -m benchmark.studies.paper search (make study NAME=paper)'


def calibration_range(lens: Lens, directions: Array) -> tuple[Array, Array]:
    """Return the 5 % and 95 % quantiles of table 3 or 4, each (3, 3, 5), over all pose sets.

    directions (N, 3), unit: of the landmarks.
    """
    tables = []
    for poses in pose_sets():
        try:
            tables.append(calibrate_rigs(lens, poses=poses, directions=directions)[0])
        except GeometryError:  # too near the landmarks at 0.2 m: no set to calibrate from
            continue
    low, high = np.quantile(tables, [0.05, 0.95], axis=0)
    return low, high


def best_of(found: Sequence[Recovered]) -> Recovered:
    """Return the solution of lowest cost; figures 9 and 10 have no say in it."""
    return min(found, key=lambda one: one.cost)


def lens_document(lens: Lens, best: Recovered, starts: int) -> dict[str, Any]:
    """Return the YAML mapping of one of the two lenses with the recovered curve."""
    numbers = best.lens_numbers[LENSES.index(lens.name)]
    recovered = lens_with(lens, np.array(_rounded(numbers)))
    return {**lens_to_dict(recovered), 'provenance': _provenance(best, starts)}


def layout_document(best: Recovered, starts: int) -> dict[str, Any]:
    """Return the YAML mapping of the recovered layout."""
    rows = [list(pair) for pair in zip(*map(_degrees, best.layout.T), strict=True)]
    return {'inner': rows[:INNER], 'outer': rows[INNER:], 'provenance': _provenance(best, starts)}


def whole_directions(best: Recovered) -> Array:
    """Return the unit directions (33, 3), world, of the layout as `layout_document` rounds it."""
    incidence, azimuth = np.radians(np.degrees(best.layout).round(2)).T
    return np.stack(
        [
            np.sin(incidence) * np.cos(azimuth),
            np.sin(incidence) * np.sin(azimuth),
            -np.cos(incidence),
        ],
        axis=-1,
    )


def family_document(
    found: Sequence[Recovered], ranges: Mapping[str, tuple[Array, Array]]
) -> dict[str, Any]:
    """Return the YAML mapping that `studies.load_family` reads.

    ranges: by lens, `calibration_range` with the recovered lens and layout.
    """
    return {
        'command': COMMAND,
        'members': [
            {
                'seed': one.seed,
                'misfit': round(one.misfit, 1),
                'cost': round(one.cost, 1),
                'within_10': agreeing(one.tables, 0.10),
                'within_5': agreeing(one.tables, 0.05),
                **{
                    name: dict(zip(NAMES, _rounded(numbers), strict=True))
                    for name, numbers in zip(LENSES, one.lens_numbers, strict=True)
                },
                'incidence_deg': _degrees(one.layout[:, 0]),
                'azimuth_deg': _degrees(one.layout[:, 1]),
            }
            for one in found
        ],
        'calibration_range': {
            lens: {'low': _numbers(low), 'high': _numbers(high)}
            for lens, (low, high) in ranges.items()
        },
    }


def _provenance(best: Recovered, starts: int) -> str:
    return (
        f"{COMMAND}; fitted to Kita's tables 1 and 2: the best of {starts} starts, number "
        f'{best.seed}, has {agreeing(best.tables, 0.10)} of the 36 z and residual cells within '
        f'10 % and {agreeing(best.tables, 0.05)} within 5 %'
    )


def _degrees(angles: Array) -> list[float]:
    return [float(angle) for angle in np.degrees(angles).round(2)]


def _rounded(numbers: Array) -> list[float]:
    return [round(float(numbers[0]), 2), *(round(float(value), 7) for value in numbers[1:])]


def _numbers(table: Array) -> list[float]:
    return [round(float(value), 5) for value in table.ravel()]
