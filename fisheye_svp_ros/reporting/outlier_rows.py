"""Outliers as rows that a person reads: one for each view and reason."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

_MAX_LANDMARKS = 6  # landmarks named in a row


class OutlierRow(NamedTuple):
    """Outliers of one view for one reason: its name, camera, landmarks, largest error in px."""

    where: str
    camera: str
    landmarks: str
    points: int
    px: float
    why: str


def outlier_rows(gross: Sequence[Mapping[str, Any]]) -> list[OutlierRow]:
    """Return one row for each view and reason, the most points first.

    gross: as in diagnosis.json, one entry a point.
    """
    groups: dict[tuple[str, str, str], list[Mapping[str, Any]]] = {}
    for one in gross:
        where = one.get('photograph') or f'frame {one["frame"]}'
        groups.setdefault((where, one.get('camera', ''), one['why']), []).append(one)
    rows = [
        OutlierRow(where, camera, _numbers([one['landmark'] for one in points]), len(points),
                   max(one['px'] for one in points), why)
        for (where, camera, why), points in groups.items()
    ]
    return sorted(rows, key=lambda row: (-row.points, -row.px))


def _numbers(landmarks: Sequence[int]) -> str:
    """Return landmark numbers, ascending, at most so many and the count of the others."""
    names = [str(number) for number in sorted(landmarks)]
    more = f' and {len(names) - _MAX_LANDMARKS} more' if len(names) > _MAX_LANDMARKS else ''
    return ', '.join(names[:_MAX_LANDMARKS]) + more
