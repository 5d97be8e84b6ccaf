"""What lenses predict of another board, the measure of a lens."""

from __future__ import annotations

from math import isfinite
from pathlib import Path

from fisheye_svp_ros.diagnosis import TwoDatasets
from fisheye_svp_ros.reporting.wording.findings import pixels


def travel_sentence(against: TwoDatasets) -> str:
    """Return how both lenses predict the other set; '' where it was not measured."""
    if against.travel is None:
        return ''
    given, extended = map(_error, against.travel)
    return (
        f'{given} as given, {extended} extended: errors of the lenses on '
        f'{Path(against.source).name}, its poses and landmark offsets fitted anew'
    )


def _error(px: float) -> str:
    return f'{pixels(px)} px' if isfinite(px) else 'some points out of sight'
