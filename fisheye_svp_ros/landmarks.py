"""Landmarks and environments: known 3-D points with ids, in the paper's world frame."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.files import read_yaml
from fisheye_svp_ros.share import config_path

SPREADS = ('whole', 'inner', 'outer')
RADII = (2.0, 0.5, 0.2)


@dataclass(frozen=True)
class Landmarks:
    """ids (N,), unique; points (N, 3), m, in the world (or target) frame."""

    ids: Index
    points: Array

    def lookup(self, ids: Index) -> tuple[Array, Mask]:
        """Return the points (..., 3) of `ids` (...), and which of them are known."""
        slot = np.searchsorted(self.ids, ids, sorter=self._order)
        place = self._order[np.minimum(slot, len(self.ids) - 1)]
        known = np.asarray(self.ids[place] == ids)
        points = self.points.take(place, axis=0)
        points[~known] = np.nan
        return points, known

    @cached_property
    def _order(self) -> Index:
        return np.argsort(self.ids)


def environment(spread: str, radius: float, layout: str | Path | None = None) -> Landmarks:
    """Return Kita's environment: `spread` whole, inner or outer, `radius` in m (section 3).

    layout: YAML with the `directions` of the landmarks, default `config/environments/kita.yaml`.
    Directions are given by incidence angle and azimuth around -z, degrees.
    Raises ObservationError for an unknown spread or an impossible radius.
    """
    if spread not in SPREADS:
        known = ', '.join(SPREADS)
        raise ObservationError(f'environment {spread!r} is unknown; known are {known}')
    if not (np.isfinite(radius) and radius > 0):
        raise ObservationError(f'environment radius is {radius} m; it must be above 0')
    path = config_path('environments/kita.yaml') if layout is None else Path(layout)
    document = read_yaml(path, ObservationError)
    try:
        groups = {name: np.array(document[name], dtype=float) for name in ('inner', 'outer')}
        counts = [len(groups['inner']), len(groups['outer'])]
        incidence, azimuth = np.radians(np.concatenate(list(groups.values()))).T
    except (KeyError, ValueError, IndexError, TypeError) as cause:
        raise ObservationError(
            f'{path}: inner and outer must each be a list of [incidence_deg, azimuth_deg]'
        ) from cause
    directions = np.stack([
        np.sin(incidence) * np.cos(azimuth),
        np.sin(incidence) * np.sin(azimuth),
        -np.cos(incidence),
    ], axis=-1)
    chosen = np.repeat([spread in ('whole', 'inner'), spread in ('whole', 'outer')], counts)
    landmarks = Landmarks(np.flatnonzero(chosen), radius * directions[chosen])
    return check_landmarks(landmarks, str(path))


def load_landmarks(path: str | Path) -> Landmarks:
    """Read landmarks from a CSV with the columns landmark, x, y, z (m).

    Raises ObservationError naming file, line and column.
    """
    ids, points = [], []
    try:
        with Path(path).open(newline='', encoding='utf-8') as stream:
            reader = csv.DictReader(stream)
            missing = {'landmark', 'x', 'y', 'z'} - set(reader.fieldnames or [])
            if missing:
                raise ObservationError(f'{path}: column {sorted(missing)[0]!r} is missing')
            for row in reader:
                where = f'{path}, line {reader.line_num}'
                ids.append(_value(row, 'landmark', np.int64, where))
                points.append([_value(row, axis, float, where) for axis in 'xyz'])
    except (OSError, UnicodeDecodeError, csv.Error) as cause:
        raise ObservationError(f'{path}: cannot be read ({cause})') from cause
    landmarks = Landmarks(np.array(ids, dtype=np.int64), np.array(points).reshape(-1, 3))
    return check_landmarks(landmarks, str(path))


def check_landmarks(landmarks: Landmarks, where: str) -> Landmarks:
    """Return the landmarks; raise ObservationError for none, a repeated id or a bad point."""
    if not len(landmarks.ids):
        raise ObservationError(f'{where}: no landmark in it; at least one is needed')
    values, counts = np.unique(landmarks.ids, return_counts=True)
    if np.any(counts > 1):
        raise ObservationError(f'{where}: landmark {values[counts > 1][0]} stands there twice')
    bad = ~np.isfinite(landmarks.points).all(axis=-1)
    if np.any(bad):
        raise ObservationError(f'{where}: landmark {landmarks.ids[bad][0]} has a coordinate '
                               'that is not a finite number')
    return landmarks


def _value(row: dict[str, str], column: str, kind: type, where: str) -> Any:
    try:
        return kind(row[column])
    except (TypeError, ValueError, OverflowError) as cause:
        raise ObservationError(
            f'{where}: {column} is {row[column]!r}; a {"whole " * (kind is not float)}number is '
            'needed'
        ) from cause
