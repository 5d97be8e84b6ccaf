"""Rows of the tables of a diagnosis: variance budget, uncertainty, intrinsics, outliers."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from fisheye_svp_ros.diagnosis import Diagnosis
from fisheye_svp_ros.reporting.cause_text import bare_probability, percent
from fisheye_svp_ros.reporting.terminal import UNITS, with_error

_UNCERTAIN = {
    'image_px': ('an image point, u or v', 1.0, 'px'),
    'position_m': ('position from one frame', 1e3, 'mm'),
    'rotation_rad': ('orientation from one frame', 180 / math.pi, 'deg'),
}
COMPONENTS = {
    'named_lens': 'lens, identified', 'named_target': 'target, identified',
    'named_frame': 'frames, identified',
    'image_broad': 'image field, correlated over 1/3 of the width',
    'image_coarse': 'image field, correlated over 1/6 of the width',
    'image_fine': 'image field, correlated over 1/14 of the width',
    'image_finest': 'finer image field',
    'landmark_in_plane': 'landmarks along their board',
    'landmark_normal': 'landmarks off their board', 'landmark': 'landmarks',
    'board_stretch': 'stretch of the board', 'board_in_plane': 'board field along it',
    'board_normal': 'board field off it',
    'frame_focal': 'focal length of each frame', 'frame_centre': 'principal point of each frame',
    'frame_linear': 'linear field of each frame',
    'frame_quadratic': 'quadratic field of each frame',
    'frame_bumps': 'image field of each frame', 'frame_bend': 'bend of the board in each frame',
    'frame_sag': 'bend of the board that follows its tilt',
    'frame_similar': 'landmarks in similar views', 'noise': 'noise of image points',
}
_MAX_LANDMARKS = 6  # landmarks named in a row


def budget_rows(diagnosis: Diagnosis) -> Iterable[tuple[str, str, str, str, str]]:
    """Yield the variance budget: part, stage, sd in px, share, p-value."""
    for part in diagnosis.components:
        yield (COMPONENTS[part.name], part.stage, f'{part.sd_px:.3f}', percent(part.share),
               '-' if part.name == 'noise' else bare_probability(part.p_value))


def uncertainty_rows(diagnosis: Diagnosis) -> Iterable[tuple[str, ...]]:
    """Yield what noise, parameters and remaining misfit make uncertain, and all together."""
    for name, parts in diagnosis.uncertainty.items():
        label, factor, unit = _UNCERTAIN[name]
        sizes = (*parts.values(), math.hypot(*parts.values()))
        yield label, *(f'{factor * value:.3g}' for value in sizes), unit


def intrinsic_rows(diagnosis: Diagnosis) -> Iterable[tuple[str, str, str]]:
    """Yield each free intrinsic and its unit, before and after, with its standard error."""
    for name, value in diagnosis.intrinsics.items():
        unit = UNITS.get(name.rpartition('.')[2])
        yield (
            f'{name}, {unit}' if unit else name,
            ' ± '.join(with_error(value.before, value.before_stderr)),
            ' ± '.join(with_error(value.after, value.after_stderr)),
        )


class OutlierRow(NamedTuple):
    """Outliers of one view for one reason: its name, camera, landmarks, largest error in px."""

    where: str
    camera: str
    landmarks: str
    points: int
    px: float
    why: str


def outlier_rows(gross: Sequence[Mapping[str, Any]]) -> list[OutlierRow]:
    """Return a row for each view and reason, most points first; gross: as in diagnosis.json."""
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
