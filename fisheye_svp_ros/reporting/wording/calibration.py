"""What a calibration says of its estimate: why its residual is not the least there is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_WORTH_SAYING = 1.001  # residuals over those of least squares


def estimate_sentence(figures: Mapping[str, Any]) -> str:
    """Return why the residual is larger than that of least squares; '' where it is not.

    figures: the `calibration` block of a lens.
    """
    least = figures.get('least_squares_rms_px')
    if least is None or figures['rms_px'] < _WORTH_SAYING * least:
        return ''
    return (
        f'rms {figures["rms_px"]:.4f} px on the board as stated, {least:.4f} px by least squares, '
        'which bends the lens to errors of the board (--plain writes that lens)'
    )
