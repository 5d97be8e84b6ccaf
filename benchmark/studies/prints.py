"""Boards other than chessboards as `simulate.render` prints them, exact to the box of a sample."""

from __future__ import annotations

import cv2
import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.detect.finders import dictionary_of
from fisheye_svp_ros.detect.patterns import Pattern
from fisheye_svp_ros.simulate.render import Drawing, Print

_RADIUS = 0.3  # of a circle, over the distance of the nearest other


def printed(pattern: Pattern) -> Print:
    """Return the print of a pattern; its points are in the pattern's order, its y down."""
    drawing = {
        'charuco': _charuco,
        'aprilgrid': _aprilgrid,
        'circles': _circles,
        'asymmetric_circles': _circles,
    }.get(pattern.kind)
    return Print(
        pattern.columns, pattern.rows, pattern.size, drawing=drawing(pattern) if drawing else None
    )


def _circles(pattern: Pattern) -> Drawing:
    points = pattern.points[:, :2] / pattern.size
    apart = np.sort(np.linalg.norm(points - points[0], axis=-1))[1]
    radius = _RADIUS * apart
    step = 2 if pattern.kind == 'asymmetric_circles' else 1

    def ink(places: Array, width: Array) -> Array:
        row = np.clip(np.round(places[..., 1]), 0, pattern.rows - 1)
        first = row % 2 if step == 2 else 0.0
        column = np.clip(np.round((places[..., 0] - first) / step), 0, pattern.columns - 1)
        off = places - np.stack([first + step * column, row], axis=-1)
        far = np.maximum(np.linalg.norm(off, axis=-1), 1e-9)
        across = np.maximum((np.abs(off) * width).sum(axis=-1) / far, 1e-12)
        return np.asarray(np.clip((radius - far) / across + 0.5, 0.0, 1.0))

    return Drawing(points, points.min(axis=0) - radius, points.max(axis=0) + radius, ink)


def _charuco(pattern: Pattern) -> Drawing:
    bits = _bits(pattern, 1, pattern.columns * pattern.rows // 2)
    y, x = np.mgrid[: pattern.rows, : pattern.columns]
    white = (x + y) % 2 == 1
    number = np.where(white, np.cumsum(white).reshape(white.shape) - 1, 0)
    side = pattern.marker / pattern.size
    chess = Print(pattern.columns - 1, pattern.rows - 1, 1.0)

    def ink(places: Array, width: Array) -> Array:
        line = np.clip(np.round(places), 0, (chess.columns - 1, chess.rows - 1))
        face = np.where(line % 2 == 0, 1, -1) * np.clip(2 * (places - line) / width, -1, 1)
        squares = 0.5 + 0.5 * face[..., 0] * face[..., 1]
        own = np.clip(np.floor(places).astype(int) + 1, 0, (pattern.columns - 1, pattern.rows - 1))
        here = (number[own[..., 1], own[..., 0]], white[own[..., 1], own[..., 0]])
        tag = _tags(bits, here[0], (places - own + 1 - (1 - side) / 2) / side, width / side)
        return np.asarray(squares + here[1] * tag)

    return Drawing(
        chess.corners[:, :2],
        np.array([-1.0, -1.0]),
        np.array([chess.columns, chess.rows], dtype=float),
        ink,
    )


def _aprilgrid(pattern: Pattern) -> Drawing:
    bits = _bits(pattern, 2, pattern.columns * pattern.rows)
    points = pattern.points[:, :2] / pattern.size * [1.0, -1.0]
    step = (points[4] - points[0])[0] if pattern.columns > 1 else 1.3
    gap = step - 1
    bottom = points[:, 1].max()  # of the lowest tags; rows are counted from there, upwards

    def ink(places: Array, width: Array) -> Array:
        x, y = places[..., 0], bottom - places[..., 1]
        column = np.clip(np.floor((x + gap / 2) / step), 0, pattern.columns - 1).astype(int)
        row = np.clip(np.floor((y + gap / 2) / step), 0, pattern.rows - 1).astype(int)
        inside = np.stack([x - column * step, 1 - (y - row * step)], axis=-1)
        tag = _tags(bits, row * pattern.columns + column, inside, width)
        # The small squares between the corners of tags
        middle = np.stack([np.round((x + gap / 2) / step), np.round((y + gap / 2) / step)], -1)
        off = np.abs(np.stack([x, y], axis=-1) + gap / 2 - middle * step)
        small = np.clip((gap / 2 - off) / width + 0.5, 0.0, 1.0)
        return np.asarray(tag + small[..., 0] * small[..., 1])

    low = np.array([-gap, points[:, 1].min() - gap])
    return Drawing(points, low, np.array([points[:, 0].max() + gap, bottom + gap]), ink)


def _bits(pattern: Pattern, border: int, count: int) -> Array:
    """Return sums (K, n + 1, n + 1) of the ink of tags of n x n cells."""
    dictionary = dictionary_of(pattern)
    cells = dictionary.markerSize + 2 * border
    tags = [
        cv2.aruco.generateImageMarker(dictionary, tag, cells, borderBits=border)
        for tag in range(count)
    ]
    sums = (np.stack(tags) < 128).astype(float).cumsum(axis=1).cumsum(axis=2)
    return np.pad(sums, ((0, 0), (1, 0), (1, 0)))


def _tags(sums: Array, tag: Index, places: Array, width: Array) -> Array:
    """Return the share of ink in boxes about places (..., 2) of a tag 0 to 1, and of a width."""
    cells = sums.shape[-1] - 1
    low, high = (np.clip(cells * (places + way * width / 2), 0, cells) for way in (-1, 1))

    def total(x: Array, y: Array) -> Array:
        i, j = (np.minimum(np.floor(one).astype(int), cells - 1) for one in (y, x))
        b, a = y - i, x - j
        return np.asarray(
            (1 - b) * (1 - a) * sums[tag, i, j]
            + (1 - b) * a * sums[tag, i, j + 1]
            + b * (1 - a) * sums[tag, i + 1, j]
            + b * a * sums[tag, i + 1, j + 1]
        )

    (x0, y0), (x1, y1) = np.moveaxis(low, -1, 0), np.moveaxis(high, -1, 0)
    area = (cells * width).prod(axis=-1)
    return np.asarray((total(x1, y1) - total(x0, y1) - total(x1, y0) + total(x0, y0)) / area)
