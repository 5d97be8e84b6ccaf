"""The family of lens curves and layouts that fit tables 1 and 2: kept, read back, summed up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.io.files import read_yaml
from fisheye_svp_ros.io.lens_files import lens_to_dict
from fisheye_svp_ros.io.share import config_path
from fisheye_svp_ros.optics.curves import Gennery
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.paper.search import (
    INNER,
    NAMES,
    Recovered,
    lens_with,
)
from fisheye_svp_ros.paper.tables import CALIBRATION, LENSES, agreeing

COMMAND = 'fisheye-svp paper --search -o config (make paper-search)'
CELLS_NEEDED = 35  # of 36 z and residual cells within 10 %: what counts as a fit


class Member(NamedTuple):
    """One fit: seed; misfit and cost (`paper_search.Recovered`); how many of the 36 z and residual
    cells lie within 10 % and 5 %; lens numbers (2, 5), px and m; layout (33, 2), rad.
    """

    seed: int
    misfit: float
    cost: float
    within_10: int
    within_5: int
    lens_numbers: Array
    layout: Array

    @property
    def fits(self) -> bool:
        """Whether it reproduces the tables as well as is asked for."""
        return self.within_10 >= CELLS_NEEDED


class Family(NamedTuple):
    """members: all fits; low, high (2, 3, 3, 5): tables 3 and 4 over random sets of ten poses,
    5 % and 95 % quantiles, in the paper's units.
    """

    members: tuple[Member, ...]
    low: Array
    high: Array

    @property
    def fits(self) -> list[Member]:
        """The members that reproduce tables 1 and 2."""
        return [one for one in self.members if one.fits]


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
    return np.stack([np.sin(incidence) * np.cos(azimuth), np.sin(incidence) * np.sin(azimuth),
                     -np.cos(incidence)], axis=-1)


def family_document(
    found: Sequence[Recovered], ranges: Mapping[str, tuple[Array, Array]]
) -> dict[str, Any]:
    """Return the YAML mapping that `load_family` reads.

    ranges: by lens, `paper_poses.calibration_range` with the recovered lens and layout.
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


def load_family(path: str | Path | None = None) -> Family:
    """Read the family, by default the one in config/.

    Raises ParameterError, naming the file, for one that `family_document` did not make.
    """
    path = config_path('paper_search.yaml') if path is None else Path(path)
    document = read_yaml(path, ParameterError)
    try:
        members = tuple(
            Member(
                one['seed'], one['misfit'], one['cost'], one['within_10'], one['within_5'],
                np.array([[one[lens][name] for name in NAMES] for lens in LENSES]),
                np.radians(np.array([one['incidence_deg'], one['azimuth_deg']], dtype=float)).T,
            )
            for one in document['members']
        )
        low, high = (
            np.array([document['calibration_range'][lens][end] for lens in LENSES])
            .reshape(CALIBRATION.shape)
            for end in ('low', 'high')
        )
    except (KeyError, TypeError, ValueError) as cause:
        raise ParameterError(f'{path}: not a family of fits; make one with: {COMMAND}') from cause
    return Family(members, low, high)


def shift_curves(members: Sequence[Member], lens: str, theta: Array) -> Array:
    """Return the viewpoint shifts (M, T), m, of the members at incidence angles (T,), rad."""
    which = LENSES.index(lens)
    curves = [Gennery(*one.lens_numbers[which, 1:]) for one in members]
    return np.stack([curve.value_and_slope(theta, np.tan(theta / 2))[0] for curve in curves])


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
