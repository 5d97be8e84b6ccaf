"""Landmarks and environments: known 3-D points with ids, in the paper's world frame."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.errors import ObservationError

SPREADS = ('whole', 'inner', 'outer')
RADII = (2.0, 0.5, 0.2)
MOST_LANDMARK = 2**32 - 1  # the largest id, as messages hold it


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


def check_landmarks(landmarks: Landmarks, where: str) -> Landmarks:
    """Return the landmarks; raise ObservationError for none, a repeated id or a bad point."""
    if not len(landmarks.ids):
        raise ObservationError(f'{where}: no landmark in it; at least one is needed')
    values, counts = np.unique(landmarks.ids, return_counts=True)
    if np.any(counts > 1):
        raise ObservationError(f'{where}: landmark {values[counts > 1][0]} is listed twice')
    bad = ~np.isfinite(landmarks.points).all(axis=-1)
    if np.any(bad):
        raise ObservationError(f'{where}: landmark {landmarks.ids[bad][0]} has a coordinate '
                               'that is not a finite number')
    return landmarks
