"""AprilGrids drawn as Kalibr's kalibr_create_target_pdf draws them, photographed by a fisheye.

The geometry is that of the published program: y up, tag `columns * y + x` at (x, y) times the
step, ink where a bit of the code is 0, the matrix of bits turned by two quarters, and small
squares beyond the corners.  Nothing here is of the package.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

# Codes of the family 36h11 as the AprilTags C++ library publishes them
CODES = (
    0xD5D628584, 0xD97F18B49, 0xDD280910E, 0xE479E9C98, 0xEBCBCA822, 0xF31DAB3AC, 0x056A5D085,
    0x10652E1D4, 0x22B1DFEAD, 0x265AD0472, 0x34FE91B86, 0x3FF962CD5, 0x43A25329A, 0x474B4385F,
    0x4E9D243E9, 0x5246149AE, 0x5997F5538, 0x683BB6C4C, 0x6BE4A7211, 0x7E3158EEA, 0x81DA494AF,
    0x858339A74, 0x8CD51A5FE, 0x9F21CC2D7, 0xA2CABC89C, 0xADC58D9EB, 0xB16E7DFB0, 0xB8C05EB3A,
    0xD25EF139D, 0xD607E1962, 0xE4ABA3076, 0x2DDE6A3DA, 0x43D40C678, 0x5620BE351, 0x64C47FA65,
    0x686D7002A, 0x6C16605EF, 0x6FBF50BB4, 0x8D06D39DC, 0x9F53856B5,
)  # fmt: skip
_CELL = 20  # px of the drawing
_MARGIN = 0.6  # of a tag
_FINE = 2  # samples along a pixel
SIZE, FOCAL = (640, 480), 260.0  # px, of an equidistant camera


@dataclass(frozen=True)
class Grid:
    """A printed grid; tag, m; gap: spacing over the size of a tag; skipped: tags left out.

    turn: quarter turns of the bits, 2 in Kalibr; from_top: rows of ids from the top; first: id.
    """

    columns: int = 4
    rows: int = 4
    tag: float = 0.04
    gap: float = 0.3
    border: int = 2
    turn: int = 2
    first: int = 0
    from_top: bool = False
    skipped: Collection[int] = ()
    inverted: bool = False
    squares: bool = True  # beyond the corners

    @property
    def target(self) -> str:
        """Kalibr's YAML of it."""
        return (
            f"target_type: 'aprilgrid'\ntagCols: {self.columns}\ntagRows: {self.rows}\n"
            f'tagSize: {self.tag}\ntagSpacing: {self.gap}\n'
        )

    @property
    def corners(self) -> NDArray[np.float64]:
        """Corners (4 * columns * rows, 2), m: tags row by row upwards, from their lower left."""
        y, x = np.mgrid[: self.rows, : self.columns]
        low = np.stack([x.ravel(), y.ravel()], axis=-1) * (1 + self.gap)
        square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
        return self.tag * (low[:, None] + square).reshape(-1, 2)

    def draw(self) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
        """Return the sheet, its first row at the bottom, and its low end (2,), m."""
        cells = 6 + 2 * self.border
        side = _CELL * cells
        margin = round((_MARGIN + self.gap) * side)
        step, small = round((1 + self.gap) * side), round(self.gap * side)
        sheet = np.full(
            ((self.rows - 1) * step + side + 2 * margin,
             (self.columns - 1) * step + side + 2 * margin), 235, np.uint8
        )  # fmt: skip
        for y in range(self.rows):
            for x in range(self.columns):
                row = self.rows - 1 - y if self.from_top else y
                number = self.first + self.columns * row + x
                if number in self.skipped:
                    continue
                u, v = margin + x * step, margin + y * step
                sheet[v : v + side, u : u + side] = self._tag(CODES[number])
                for du in (-small, side) if self.squares else ():
                    for dv in (-small, side):
                        sheet[v + dv : v + dv + small, u + du : u + du + small] = 20
        return (255 - sheet if self.inverted else sheet), np.full(2, -margin * self.tag / side)

    def _tag(self, code: int) -> NDArray[np.uint8]:
        ink = np.array([[not code & (1 << (6 * i + j)) for j in range(6)] for i in range(6)])
        ink = np.rot90(ink, self.turn)[::-1]  # drawn from the top down
        ink = np.pad(ink, self.border, constant_values=True)
        return np.where(np.kron(ink, np.ones((_CELL, _CELL))) > 0, 20, 235).astype(np.uint8)


def poses(count: int, seed: int = 0) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return turns (3, 3) of boards, y up, and places (3,), m, of their middles."""
    rng, views = np.random.default_rng(seed), []
    for _ in range(count):
        tilt = cv2.Rodrigues(rng.uniform(-0.6, 0.6, 3))[0]
        place = np.array([*rng.uniform(-0.06, 0.06, 2), rng.uniform(0.17, 0.24)])
        views.append((tilt @ np.diag([1.0, -1.0, -1.0]), place))
    return views


def project(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return image points (N, 2), px, of points (N, 3) in the camera frame."""
    across = np.linalg.norm(points[:, :2], axis=1)
    theta = np.arctan2(across, points[:, 2])
    middle = (np.array(SIZE) - 1) / 2
    return middle + (FOCAL * theta / np.maximum(across, 1e-12))[:, None] * points[:, :2]


@cache
def _rays() -> NDArray[np.float64]:
    width, height = SIZE
    v, u = np.mgrid[: height * _FINE, : width * _FINE]
    at = (np.stack([u, v], axis=-1) + 0.5) / _FINE - 0.5 - (np.array(SIZE) - 1) / 2
    radius = np.linalg.norm(at, axis=-1, keepdims=True)
    theta = radius / FOCAL
    return np.concatenate([at / np.maximum(radius, 1e-9) * np.sin(theta), np.cos(theta)], axis=-1)


def photograph(
    grids: list[tuple[Grid, NDArray[np.float64], NDArray[np.float64]]], seed: int = 0
) -> tuple[NDArray[np.uint8], list[NDArray[np.float64]]]:
    """Return a photograph of grids at poses, and where the corners of each are in it, px."""
    rays = _rays()
    image, truth = np.full(rays.shape[:2], 120, np.uint8), []
    for grid, turn, place in grids:
        sheet, low = grid.draw()
        scale = _CELL * (6 + 2 * grid.border) / grid.tag
        origin = place - turn[:, :2] @ grid.corners.mean(axis=0)
        with np.errstate(divide='ignore', invalid='ignore'):
            reach = (origin @ turn[:, 2]) / (rays @ turn[:, 2])
        xy = ((rays * reach[..., None] - origin) @ turn[:, :2] - low) * scale - 0.5
        xy[~(reach > 0)] = -10
        seen = ((xy > 0) & (xy < np.array(sheet.shape[::-1]) - 1)).all(axis=-1)
        xy = xy.astype(np.float32)
        image[seen] = cv2.remap(sheet, xy[..., 0], xy[..., 1], cv2.INTER_LINEAR)[seen]
        flat = np.pad(grid.corners, ((0, 0), (0, 1)))
        truth.append(project(flat @ turn.T + origin))
    image = cv2.resize(
        cv2.GaussianBlur(image, (0, 0), 0.6 * _FINE), SIZE, interpolation=cv2.INTER_AREA
    )
    noise = np.random.default_rng(seed).normal(0, 1.5, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8), truth
