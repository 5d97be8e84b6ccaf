"""Rows: undistortion maps of 1280 x 800 pixels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from benchmark.speed import engines
from benchmark.speed.harness import Row, Side, require
from benchmark.speed.peers import camera_matrix
from benchmark.speed.scenes import shift_lens, svp_lens
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.rectify.cameras import rectified_camera
from fisheye_svp_ros.rectify.maps import Maps, Rectification

OPENCV = 'cv2.fisheye.initUndistortRectifyMap'
_SIZE, _FIELD = (1280, 800), np.radians(100.0)
_TEXT = 'To a pinhole camera 100 degrees wide, float32.'


def rows(repeats: int = 15) -> list[Row]:
    """Return the rows about maps to a pinhole camera."""
    return [
        _maps('Undistortion maps of 1280 x 800, ShiftVP', shift_lens(), repeats),
        _maps(
            'Undistortion maps of 1280 x 800, SVP Kannala-Brandt', svp_lens(), repeats, opencv=True
        ),
    ]


def _maps(title: str, lens: Lens, repeats: int, opencv: bool = False) -> Row:
    camera = rectified_camera('pinhole', _SIZE, _FIELD)
    side = Rectification(lens, camera)
    exact, mask = side.maps[:2], side.maps.mask

    def error(found: Sequence[Any]) -> float:
        return max(
            float(np.abs(one - other)[mask].max())
            for one, other in zip(found, exact, strict=False)
        )

    def ours() -> Maps:
        return replace(side).maps  # a copy has none yet

    def theirs() -> Side:
        require('cv2')
        import cv2

        matrix, k = camera_matrix(lens)

        return Side(
            OPENCV,
            lambda: cv2.fisheye.initUndistortRectifyMap(
                matrix, k, np.eye(3), camera.k, _SIZE, cv2.CV_32FC1
            ),
            1,
            error,
        )

    makers: dict[str, Callable[[], Side]] = engines.sides(ours, work=1, error=error)
    if opencv:
        makers |= {OPENCV: theirs}
    return engines.row(title, ('ms', 1e-3), makers, repeats, error_unit='px', text=_TEXT)
