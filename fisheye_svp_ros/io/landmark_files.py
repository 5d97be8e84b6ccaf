"""Landmarks from files: Kita's environment, and landmarks as CSV."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.io.csv_files import CsvTable
from fisheye_svp_ros.io.files import read_yaml
from fisheye_svp_ros.io.share import config_path
from fisheye_svp_ros.scene.observations import MOST_LANDMARK, SPREADS, Landmarks, check_landmarks


def environment(spread: str, radius: float) -> Landmarks:
    """Return Kita's environment: `spread` whole, inner or outer, `radius` in m (section 3).

    Raises ObservationError for an unknown spread or an impossible radius.
    """
    if spread not in SPREADS:
        names = ', '.join(SPREADS)
        raise ObservationError(f'environment {spread!r} is unknown; choose from {names}')
    if not (np.isfinite(radius) and radius > 0):
        raise ObservationError(f'environment radius is {radius} m; it must be above 0')
    # Incidence angle and azimuth around -z, degrees
    document = read_yaml(config_path('environments/kita.yaml'), ObservationError)
    groups = [np.array(document[name], dtype=float) for name in ('inner', 'outer')]
    incidence, azimuth = np.radians(np.concatenate(groups)).T
    directions = np.stack(
        [
            np.sin(incidence) * np.cos(azimuth),
            np.sin(incidence) * np.sin(azimuth),
            -np.cos(incidence),
        ],
        axis=-1,
    )
    chosen = np.repeat(
        [spread in ('whole', name) for name in ('inner', 'outer')], [*map(len, groups)]
    )
    return Landmarks(np.flatnonzero(chosen), radius * directions[chosen])


def load_landmarks(path: str | Path) -> Landmarks:
    """Read landmarks from a CSV with the columns landmark, x, y, z (m).

    Raises ObservationError naming file, line and column.
    """
    table = CsvTable(Path(path), ('landmark', 'x', 'y', 'z'))
    landmarks = Landmarks(table.integers('landmark', MOST_LANDMARK), table.numbers('x', 'y', 'z'))
    return check_landmarks(landmarks, str(path))
