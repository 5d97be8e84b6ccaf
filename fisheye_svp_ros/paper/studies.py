"""Results of studies that take minutes, as `make study NAME=paper` left them in config/."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.io.files import read_yaml
from fisheye_svp_ros.io.share import config_path
from fisheye_svp_ros.optics.curves import Gennery
from fisheye_svp_ros.paper.tables import CALIBRATION, LENSES
from fisheye_svp_ros.scene.observations import RADII, SPREADS

COMMAND = 'make study NAME=paper'
NAMES = ('f', 's0', 'e0', 'e1', 'e2')
CELLS_NEEDED = 35  # of 36 z and residual cells within 10 %: what counts as a fit


class Member(NamedTuple):
    """One fit of tables 1 and 2 by the search.

    misfit: sum of squares over the 90 cells, each in its own sigma; cost: the same with priors;
    within_10, within_5: how many of the 36 z and residual cells lie within 10 % and 5 %;
    lens_numbers (2, 5): `NAMES`, px and m; layout (33, 2): incidence and azimuth, rad.
    """

    seed: int
    misfit: float
    cost: float
    within_10: int
    within_5: int
    lens_numbers: Array
    layout: Array


class Family(NamedTuple):
    """All fits of the search, and what tables 3 and 4 owe to the poses.

    low, high (2, 3, 3, 5): 5 % and 95 % quantiles of tables 3 and 4 over random sets of ten
    poses, in the paper's units.
    """

    members: tuple[Member, ...]
    low: Array
    high: Array

    @property
    def matching(self) -> list[Member]:
        """The members that reproduce tables 1 and 2."""
        return [member for member in self.members if member.within_10 >= CELLS_NEEDED]


class Stopping(NamedTuple):
    """Whether a solver that stops early explains the one cell of table 1 that is out of line.

    offset_mm (3,): published position less our optimum; relative_cost: its sum of squares over
    that of the optimum, less 1; dampings, gains (px²): how solvers damp, and the fall of the sum
    of squares at which they stop; off (lenses, dampings, gains, radii, spreads): how far from the
    optimum z then is, relative to z's error there, median over starts.
    """

    offset_mm: Array
    relative_cost: float
    dampings: tuple[str, ...]
    gains: tuple[float, ...]
    off: Array


def load_family(path: str | Path | None = None) -> Family:
    """Read the family, by default the one in config/.

    Raises ParameterError, naming the file, for one that the search did not make.
    """
    path, document = _read_study(path, 'paper_search.yaml')
    try:
        members = tuple(
            Member(
                member['seed'],
                member['misfit'],
                member['cost'],
                member['within_10'],
                member['within_5'],
                np.array([[member[lens][name] for name in NAMES] for lens in LENSES]),
                np.radians(
                    np.array([member['incidence_deg'], member['azimuth_deg']], dtype=float)
                ).T,
            )
            for member in document['members']
        )
        low, high = (
            np.array([document['calibration_range'][lens][end] for lens in LENSES]).reshape(
                CALIBRATION.shape
            )
            for end in ('low', 'high')
        )
    except (KeyError, TypeError, ValueError) as cause:
        raise ParameterError(f'{path}: not a family of fits; make one with: {COMMAND}') from cause
    return Family(members, low, high)


def load_stopping(path: str | Path | None = None) -> Stopping:
    """Read what the study of early stops found, by default from config/.

    Raises ParameterError, naming the file, for one that the study did not make.
    """
    path, document = _read_study(path, 'paper_stopping.yaml')
    try:
        dampings, gains = tuple(document['dampings']), tuple(document['gains_px2'])
        off = np.array([document['median_off_z'][lens] for lens in LENSES], dtype=float)
        return Stopping(
            np.array(document['published_minus_ours_mm'], dtype=float),
            float(document['relative_excess_of_squares']),
            dampings,
            gains,
            off.reshape(len(LENSES), len(dampings), len(gains), len(RADII), len(SPREADS)),
        )
    except (KeyError, TypeError, ValueError) as cause:
        raise ParameterError(
            f'{path}: not a study of early stops; make one with: {COMMAND}'
        ) from cause


def shift_curves(members: Sequence[Member], lens: str, theta: Array) -> Array:
    """Return the viewpoint shifts (M, T), m, of the members at incidence angles (T,), rad."""
    which = LENSES.index(lens)
    curves = [Gennery(*member.lens_numbers[which, 1:]) for member in members]
    return np.stack([curve.value_and_slope(theta, np.tan(theta / 2))[0] for curve in curves])


def _read_study(path: str | Path | None, name: str) -> tuple[Path, Mapping[str, Any]]:
    path = config_path(name) if path is None else Path(path)
    return path, read_yaml(path, ParameterError)
