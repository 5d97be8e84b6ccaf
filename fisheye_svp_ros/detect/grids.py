"""Grids of circles, and of separate dark squares: joined from one to the next.

How far apart neighbors are, over the ellipse that each of them is, a fisheye hardly changes.
"""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.detect.patterns import LocatedPoints, Pattern

_BLOCKS = (31, 91, 271)  # px, of the local threshold
_MIN_DARKNESS = 8  # grey levels from the mean there
_SMOOTHING = (1.0, 2.0)  # px, the least that leaves noise without contours
_LEAST, _LARGEST = 12.0, 0.02  # px^2; of the image: area of a circle
_AREA_TOLERANCE = 0.1  # how far its area may be from its ellipse's
_RING, _EVEN = 1.3, 0.4  # of its size, where all must be another brightness; of the most
_AZIMUTHS = np.arange(16) * np.pi / 8
_NEIGHBOR = 1.22  # times the usual distance; diagonal neighbors are at 1.41
_MIN_STEP_COSINE = 0.8  # least cosine between a step and the one before
_SEEDS = 8
_SQUARE_BLOCKS = (31, 61, 121, 241)  # px, of the local threshold
_DARKNESS_LEVELS = (10, 30, 60)  # grey levels below the mean there
_ROUNDNESS = 0.04  # of its perimeter, what a side through a fisheye may bend
_MAX_OFFSET = 0.3  # of the step to the next square, how far off its center may be
_GROWTH = 4.0  # of the area, from square to square
_MIN_AREA = 40  # px^2

Grid = dict[tuple[int, int], int]


class Ellipses(NamedTuple):
    """Centers (B, 2), px, and matrices (B, 2, 2) that turn an ellipse into the unit circle."""

    center: Array
    matrix: Array


def find_circles(image: NDArray[np.uint8], pattern: Pattern) -> LocatedPoints | None:
    """Return the circles of a grid in a grey image, dark or bright; None without a whole one."""
    wanted = _lattice(pattern)
    for soft, bright in itertools.product(_SMOOTHING, (False, True)):
        seen = _ellipses(np.asarray(cv2.GaussianBlur(image, (0, 0), soft), np.uint8), bright)
        if len(seen.center) < len(wanted):
            continue
        near = _neighbors(seen)
        off = np.linalg.norm(seen.center - np.median(seen.center, axis=0), axis=1)
        inner = np.lexsort((off, -near.sum(axis=1)))
        for seed in inner[:_SEEDS].tolist():
            grid = _grow_grid(seen, near, seed)
            order = _assign_blobs(grid, wanted) if len(grid) >= len(wanted) else None
            if order is not None:
                return LocatedPoints(np.arange(len(order)), seen.center[order])
    return None


def _lattice(pattern: Pattern) -> Index:
    """Return integer places (N, 2) of the points, neighbors one apart."""
    xy = np.round(pattern.points[:, :2] / pattern.size).astype(np.int64)
    if pattern.kind == 'asymmetric_circles':
        xy = np.stack([xy.sum(axis=1), xy[:, 1] - xy[:, 0]], axis=-1) // 2
    return xy


def _ellipses(image: NDArray[np.uint8], bright: bool) -> Ellipses:
    kind = cv2.THRESH_BINARY if bright else cv2.THRESH_BINARY_INV
    contours: list[Any] = []
    for block in _BLOCKS:
        mask = cv2.adaptiveThreshold(
            image,
            255,
            cv2.ADAPTIVE_THRESH_MEAN_C,
            kind,
            block,
            -_MIN_DARKNESS if bright else _MIN_DARKNESS,
        )
        contours += cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
    every = _standing_out(image, _elliptic(contours, _LARGEST * image.size), bright)
    centers, matrices = np.empty((0, 2)), np.empty((0, 2, 2))
    for center, matrix in zip(*every, strict=True):
        off = np.linalg.norm(np.einsum('iab,ib->ia', matrices, center - centers), axis=1)
        if off.min(initial=np.inf) > 1:
            centers = np.vstack([centers, center])
            matrices = np.concatenate([matrices, [matrix]])
    return Ellipses(centers, matrices)


def _elliptic(contours: list[Any], largest: float) -> Ellipses:
    """Return those contours that are ellipses, and not too small or too large, px^2."""
    parts = np.array(
        [
            [part[name] for name in ('m00', 'm10', 'm01', 'mu20', 'mu11', 'mu02')]
            for part in map(cv2.moments, contours)
        ]
    ).reshape(-1, 6)
    parts = parts[(parts[:, 0] >= _LEAST) & (parts[:, 0] <= largest)]
    # The largest first: a circle larger than the block has a hole.
    area, *rest = parts[np.argsort(-parts[:, 0], kind='stable')].T
    u, v, *spreads = (part / area for part in rest)
    spread = np.stack(spreads, axis=-1)[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    inner = np.linalg.det(spread)
    own = inner > 0
    own[own] = np.abs(4 * np.pi * np.sqrt(inner[own]) / area[own] - 1) <= _AREA_TOLERANCE
    size, turn = np.linalg.eigh(spread[own])
    matrices = (turn / (2 * np.sqrt(size))[:, None]) @ np.swapaxes(turn, 1, 2)
    return Ellipses(np.stack([u, v], axis=-1)[own], matrices)


def _standing_out(image: NDArray[np.uint8], blobs: Ellipses, bright: bool) -> Ellipses:
    """Return the ellipses around which all is darker, or brighter, and much the same.

    Noise is not, nor is the paper between circles.
    """
    height, width = image.shape
    circle = _RING * np.stack([np.cos(_AZIMUTHS), np.sin(_AZIMUTHS)], axis=-1)
    ring = circle @ np.linalg.inv(blobs.matrix)
    places = np.concatenate([blobs.center[:, None], blobs.center[:, None] + ring], axis=1)
    u, v = np.moveaxis(np.round(places).astype(np.int64), -1, 0)
    level = image[v.clip(0, height - 1), u.clip(0, width - 1)].astype(float)
    step = (level[:, 1:] - level[:, :1]) * (-1 if bright else 1)
    even = step.min(axis=1) > np.maximum(_EVEN * step.max(axis=1), _MIN_DARKNESS)
    return Ellipses(blobs.center[even], blobs.matrix[even])


def _neighbors(blobs: Ellipses) -> Mask:
    """Return which ellipses (B, B) are as far apart as most are from their nearest ones."""
    move = blobs.center[None] - blobs.center[:, None]
    far = np.linalg.norm(np.einsum('iab,ijb->ija', blobs.matrix, move), axis=-1)
    far = (far + far.T) / 2
    np.fill_diagonal(far, np.inf)
    usual = np.median(np.sort(far, axis=1)[:, 1])
    return np.asarray((far < _NEIGHBOR * usual) & (far > usual / _NEIGHBOR))


def _grow_grid(blobs: Ellipses, near: Mask, seed: int) -> Grid:
    """Return ellipses by column and row that can be reached from a first one, step by step."""
    move = blobs.center[near[seed]] - blobs.center[seed]
    if len(move) < 2:
        return {}
    unit = _units(move, blobs.matrix[seed])
    second = move[np.argmin(np.abs(unit @ unit[0]))]
    clockwise = move[0][0] * second[1] - move[0][1] * second[0] > 0
    steps = np.array([move[0], second if clockwise else -second])
    grid, own, used, waiting = {(0, 0): seed}, {(0, 0): steps}, {seed}, [(0, 0)]
    while waiting:
        place = waiting.pop(0)
        here = grid[place]
        others = np.flatnonzero(near[here])
        units = _units(blobs.center[others] - blobs.center[here], blobs.matrix[here])
        for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
            other = (place[0] + sign * (axis == 0), place[1] + sign * (axis == 1))
            along = units @ _units(sign * own[place][axis], blobs.matrix[here])
            if other in grid or not len(along) or along.max() < _MIN_STEP_COSINE:
                continue
            next_one = int(others[np.argmax(along)])
            if next_one in used:
                continue
            steps = own[place].copy()
            steps[axis] = sign * (blobs.center[next_one] - blobs.center[here])
            grid[other], own[other] = next_one, steps
            used.add(next_one)
            waiting.append(other)
    return grid


def _units(move: Array, matrix: Array) -> Array:
    """Return directions (..., 2) as they are where an ellipse is the unit circle."""
    turned = move @ matrix
    return np.asarray(turned / np.linalg.norm(turned, axis=-1, keepdims=True))


def _assign_blobs(grid: Grid, wanted: Index) -> list[int] | None:
    """Return the blobs (N,) of the wanted places, turned and moved to where all are; once."""
    placements = []
    turned = wanted
    low = np.array(list(grid)).min(axis=0)
    size = np.ptp(np.array(list(grid)), axis=0)
    for _ in range(4):
        turned = np.stack([-turned[:, 1], turned[:, 0]], axis=-1)
        places = turned - turned.min(axis=0)
        spare = size - places.max(axis=0)
        for right in range(spare[0] + 1):
            for down in range(spare[1] + 1):
                keys = [(int(a), int(b)) for a, b in places + low + (right, down)]
                if all(key in grid for key in keys):
                    placements.append([grid[key] for key in keys])
    same = {tuple(sorted(placement)) for placement in placements}
    return placements[0] if len(same) == 1 else None


def find_squares(image: NDArray[np.uint8], pattern: Pattern) -> LocatedPoints | None:
    """Return the corners of a grid of dark squares in a grey image, None without a whole one.

    Corners go around each square from its corner of least x and y, squares row by row.
    """
    step = 1 + float(
        np.linalg.norm(pattern.points[4] - pattern.points[1]) / pattern.size
        if pattern.columns > 1
        else 1
    )
    levels = itertools.product(_SQUARE_BLOCKS, _DARKNESS_LEVELS)
    tries = (_quads(image, block, below) for block, below in levels)
    together = np.empty((0, 4, 2))
    for quads in tries:
        # The edge of a shadow spoils some squares at each threshold, and not the same ones.
        together = _merge_quads(together, quads)
        for squares in (quads, together):
            for first in range(len(squares)):
                corners = _complete_corners(_grow_squares(squares, first, step), pattern)
                if corners is not None:
                    return LocatedPoints(np.arange(4 * pattern.columns * pattern.rows), corners)
    return None


def _merge_quads(quads: Array, more: Array) -> Array:
    """Return quadrilaterals and those of `more` that lie elsewhere."""
    distance = np.linalg.norm(more.mean(axis=1)[:, None] - quads.mean(axis=1), axis=-1)
    size = np.linalg.norm(more[:, 2] - more[:, 0], axis=-1)
    return np.concatenate([quads, more[distance.min(axis=1, initial=np.inf) > _MAX_OFFSET * size]])


def _quads(image: NDArray[np.uint8], block: int, below: int) -> Array:
    """Return quadrilaterals (Q, 4, 2), px, darker than their surroundings, clockwise as seen."""
    dark = cv2.adaptiveThreshold(
        image, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, block, below
    )
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


def _grow_squares(quads: Array, first: int, step: float) -> dict[tuple[int, int], Array]:
    """Return the squares by column and row that can be reached from the first one."""
    grid = {(0, 0): quads[first]}
    centers = quads.mean(axis=1)
    used, waiting = {first}, [(0, 0)]
    while waiting:
        column, row = waiting.pop()
        quad = grid[column, row]
        sides = (
            (quad[1] + quad[2] - quad[0] - quad[3]) / 2,
            (quad[3] + quad[2] - quad[0] - quad[1]) / 2,
        )
        for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            place = (column + dx, row + dy)
            move = step * (dx * sides[0] + dy * sides[1])
            distance = np.linalg.norm(centers - quad.mean(axis=0) - move, axis=1)
            nearest = int(np.argmin(distance))
            far = distance[nearest] > _MAX_OFFSET * np.linalg.norm(move)
            growth = _area(quads[nearest]) / _area(quad)
            unlike = not 1 / _GROWTH < growth < _GROWTH
            if place in grid or nearest in used or far or unlike:
                continue
            turned = [np.roll(quads[nearest], k, axis=0) for k in range(4)]
            grid[place] = max(
                turned, key=lambda q: float((q[1] - q[0]) @ sides[0] + (q[3] - q[0]) @ sides[1])
            )
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
