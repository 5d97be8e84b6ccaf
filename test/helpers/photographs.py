"""Rendered photographs of a small board through a small fisheye lens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache, lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from fisheye_svp_ros.optics.camera import Rays, project
from fisheye_svp_ros.optics.curves import Gennery, KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.simulate.render import Exposure, Print, pixel_rays, render
from fisheye_svp_ros.simulate.targets import board_views

LENS = Lens(
    'small',
    424,
    400,
    142.0,
    142.0,
    211.3,
    200.2,
    KannalaBrandt(-0.01, 0.004, -0.0015),
    np.radians(92.0),
    Gennery(e0=0.003),
)
BOARD = 'chessboard:6x5:30mm'
PRINTED = Print(6, 5, 0.030)


def poses(count: int, seed: int = 0, printed: Print = PRINTED) -> Pose:
    """Return poses that see the whole board."""
    return board_views(LENS, printed, count, (0.10, 0.2), np.random.default_rng(seed))


def photograph(
    pose: Pose, printed: Print = PRINTED, exposure: Exposure | None = None, seed: int = 0
) -> NDArray[np.uint8]:
    """Render one photograph."""
    if printed is PRINTED and exposure is None:  # of one pose many tests ask
        return _rendered(pose.rotation.tobytes(), pose.position.tobytes(), seed).copy()
    rng = np.random.default_rng(seed)
    return render(LENS, printed, pose, exposure or Exposure(), rng, rays=_rays())


@lru_cache(64)
def _rendered(rotation: bytes, position: bytes, seed: int) -> NDArray[np.uint8]:
    pose = Pose(np.frombuffer(rotation).reshape(3, 3), np.frombuffer(position))
    return render(LENS, PRINTED, pose, Exposure(), np.random.default_rng(seed), rays=_rays())


@cache
def _rays() -> Rays:
    return pixel_rays(LENS)


def true_corners(pose: Pose, printed: Print = PRINTED) -> NDArray[np.float64]:
    """Return where the corners are in the image, px."""
    return project(LENS, pose.into_body(printed.true_corners())).uv


def write(folder: Path, images: Sequence[NDArray[np.uint8]]) -> None:
    """Write photographs as 00.png and so on."""
    folder.mkdir(parents=True, exist_ok=True)
    for i, image in enumerate(images):
        cv2.imwrite(str(folder / f'{i:02d}.png'), image)


def printed_with(scatter: float, seed: int, printed: Print) -> Print:
    """Return a print whose corners are off by `scatter`, m, each its own way."""
    rng = np.random.default_rng(seed)
    off = scatter * rng.standard_normal((printed.rows, printed.columns, 2))

    def shift(place: NDArray[np.float64]) -> NDArray[np.float64]:
        column, row = np.moveaxis(place / printed.size, -1, 0)
        column = np.clip(np.round(column), 0, printed.columns - 1).astype(int)
        row = np.clip(np.round(row), 0, printed.rows - 1).astype(int)
        return np.asarray(off[row, column])

    return replace(printed, shift=shift)
