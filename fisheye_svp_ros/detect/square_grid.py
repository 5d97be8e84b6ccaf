"""A grid of separate dark squares: contours with four corners, joined from square to square."""

from __future__ import annotations

from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.detect.patterns import Pattern

_BLOCKS = (31, 61, 121, 241)  # px, of the local threshold
_DARKNESS_LEVELS = (10, 30, 60)  # grey levels below the mean there
_ROUNDNESS = 0.04  # of its perimeter, what a side through a fisheye may bend
_MAX_OFFSET = 0.3  # of the step to the next square, how far off its centre may be
_GROWTH = 4.0  # of the area, from square to square
_MIN_AREA = 40  # px^2


def find_squares(image: NDArray[np.uint8], pattern: Pattern) -> tuple[Index, Array] | None:
    """Return the corners of a grid of dark squares in a grey image, None without a whole one.

    Corners go around each square from its corner of least x and y, squares row by row.
    """
    step = 1 + float(np.linalg.norm(pattern.points[4] - pattern.points[1])
                     / pattern.size if pattern.columns > 1 else 1)
    tries = (_quads(image, block, below) for block, below in product(_BLOCKS, _DARKNESS_LEVELS))
    together = np.empty((0, 4, 2))
    for quads in tries:
        # The edge of a shadow spoils some squares at each threshold, and not the same ones.
        together = _merge_quads(together, quads)
        for squares in (quads, together):
            for first in range(len(squares)):
                found = _complete_corners(_grow_grid(squares, first, step), pattern)
                if found is not None:
                    return np.arange(4 * pattern.columns * pattern.rows), found
    return None


def _merge_quads(quads: Array, more: Array) -> Array:
    """Return quadrilaterals and those of `more` that lie elsewhere."""
    distance = np.linalg.norm(more.mean(axis=1)[:, None] - quads.mean(axis=1), axis=-1)
    size = np.linalg.norm(more[:, 2] - more[:, 0], axis=-1)
    return np.concatenate([quads, more[distance.min(axis=1, initial=np.inf) > _MAX_OFFSET * size]])


def _quads(image: NDArray[np.uint8], block: int, below: int) -> Array:
    """Return quadrilaterals (Q, 4, 2), px, darker than their surroundings, clockwise as seen."""
    dark = cv2.adaptiveThreshold(image, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV,
                                 block, below)
    contours, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    quads = []
    for contour in contours:
        if cv2.contourArea(contour) < _MIN_AREA:
            continue
        corners = cv2.approxPolyDP(contour, _ROUNDNESS * cv2.arcLength(contour, True), True)
        if len(corners) == 4 and cv2.isContourConvex(corners):
            quad = corners[:, 0].astype(float)
            a, b = quad[1] - quad[0], quad[3] - quad[0]
            clockwise = a[0] * b[1] - a[1] * b[0] > 0
            quads.append(quad if clockwise else quad[::-1])
    return np.array(quads).reshape(-1, 4, 2)


def _grow_grid(quads: Array, first: int, step: float) -> dict[tuple[int, int], Array]:
    """Return the squares by column and row that can be reached from the first one."""
    grid = {(0, 0): quads[first]}
    centres = quads.mean(axis=1)
    used, waiting = {first}, [(0, 0)]
    while waiting:
        column, row = waiting.pop()
        quad = grid[column, row]
        sides = ((quad[1] + quad[2] - quad[0] - quad[3]) / 2,
                 (quad[3] + quad[2] - quad[0] - quad[1]) / 2)
        for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            place = (column + dx, row + dy)
            move = step * (dx * sides[0] + dy * sides[1])
            distance = np.linalg.norm(centres - quad.mean(axis=0) - move, axis=1)
            nearest = int(np.argmin(distance))
            far = distance[nearest] > _MAX_OFFSET * np.linalg.norm(move)
            growth = _area(quads[nearest]) / _area(quad)
            unlike = not 1 / _GROWTH < growth < _GROWTH
            if place in grid or nearest in used or far or unlike:
                continue
            turned = [np.roll(quads[nearest], k, axis=0) for k in range(4)]
            grid[place] = max(turned, key=lambda q: float((q[1] - q[0]) @ sides[0]
                                                          + (q[3] - q[0]) @ sides[1]))
            used.add(nearest)
            waiting.append(place)
    return grid


def _area(quad: Array) -> float:
    a, b = quad[2] - quad[0], quad[3] - quad[1]
    return abs(float(a[0] * b[1] - a[1] * b[0])) / 2


def _complete_corners(grid: dict[tuple[int, int], Array], pattern: Pattern) -> Array | None:
    """Return the corners (N, 2) of a complete grid, turned by a quarter where need be."""
    places = np.array(list(grid))
    low, size = places.min(axis=0), np.ptp(places, axis=0) + 1
    if len(grid) != pattern.columns * pattern.rows:
        return None
    quads = np.empty((size[1], size[0], 4, 2))
    for (column, row), quad in grid.items():
        quads[row - low[1], column - low[0]] = quad
    if tuple(size) == (pattern.rows, pattern.columns):
        quads = np.roll(np.swapaxes(quads, 0, 1)[:, ::-1], 1, axis=2)
    elif tuple(size) != (pattern.columns, pattern.rows):
        return None
    return np.asarray(quads.reshape(-1, 2))
