"""Where the corners of a black square are: where its four edges, each fitted along itself, meet.

The image of a corner alone is rounded by blur, towards the dark side, by a quarter of a pixel at
usual sharpness: a tag of 20 px then seems two hundredths farther away.  An edge is not moved: its
brightness rises evenly about where it is.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.detect.finders import Grey

# From corner to corner, -1 to 1; corners are rounded
_EDGE_SAMPLES = 2 * np.linspace(0.1, 0.9, 24) - 1
_STRIP_SAMPLES = np.linspace(-1, 1, 17)  # half widths of the strip
_STEPS = (_STRIP_SAMPLES[1:] + _STRIP_SAMPLES[:-1]) / 2
_STRIP_SHARE, _MIN_STRIP, _MAX_STRIP = 0.125, 1.2, 4.0  # of a side (a cell of a tag); px
_ROUNDS, _MEETINGS = 3, 5
_NOISE = 0.08  # px, of an edge at one place
_BEND = 400.0  # px, the radius to which a fisheye may bend a straight edge
_MIN_BEND = 0.02  # px


def _powers(place: Array) -> Array:
    """Return what a curve is made of (..., 3): its height, slope and bend."""
    return np.stack([np.ones_like(place), place, place**2 - 1], axis=-1)


_POWERS = _powers(_EDGE_SAMPLES)


class _Edges(NamedTuple):
    """Edges (T, 4): start (.., 2) and span to the next corner, px, normal (.., 2) outwards."""

    start: Array
    span: Array
    normal: Array

    def pixels_at(self, place: Array, off: Array) -> Array:
        """Return pixels at places -1 to 1 along the edges, off px outwards of their chords."""
        share = 0.5 * (place[..., None] + 1)
        extra = (slice(None), slice(None)) + (None,) * (place.ndim - 2)
        return np.asarray(
            self.start[extra] + share * self.span[extra] + off[..., None] * self.normal[extra]
        )


def fit_quads(image: Grey, corners: Array) -> Array:
    """Return corners (T, 4, 2), px, of black squares on white, given to within a cell of a tag.

    image: grey (H, W). A square whose edges do not meet near its corners stays as it is.
    """
    if not len(corners):
        return corners
    following = np.roll(corners, -1, axis=1)
    span = following - corners
    length = np.linalg.norm(span, axis=-1)
    normal = np.stack([-span[..., 1], span[..., 0]], axis=-1) / length[..., None]
    outwards = (corners + following) / 2 - corners.mean(axis=1, keepdims=True)
    normal *= np.sign((normal * outwards).sum(axis=-1, keepdims=True))
    edges = _Edges(corners, span, normal)
    strip = np.clip(_STRIP_SHARE * length.min(axis=1), _MIN_STRIP, _MAX_STRIP)
    curve, light = np.zeros((*length.shape, 3)), image.astype(np.float32)
    for _ in range(_ROUNDS):
        curve = _fit_curves(light, edges, curve, strip, length)
    fitted = _meet(edges, curve)
    moved = np.linalg.norm(fitted - corners, axis=-1).max(axis=1)
    near = moved < 2 * strip  # False where not finite
    return np.where(near[:, None, None], fitted, corners)


def _fit_curves(
    image: NDArray[np.float32], edges: _Edges, curve: Array, strip: Array, length: Array
) -> Array:
    """Return coefficients (T, 4, 3) of _POWERS, px outwards, of the edges in strips about them."""
    middle = curve @ _POWERS.T
    off = middle[..., None] + strip[:, None, None, None] * _STRIP_SAMPLES
    place = np.broadcast_to(_EDGE_SAMPLES[:, None], off.shape)
    pixels = edges.pixels_at(place, off).reshape(len(strip), -1, 2).astype(np.float32)
    light = cv2.remap(
        image, pixels[..., 0], pixels[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )
    rise = np.maximum(np.diff(light.reshape(off.shape).astype(float), axis=-1), 0) ** 2
    total = rise.sum(axis=-1)
    found = middle + strip[:, None, None] * (rise @ _STEPS) / np.maximum(total, 1e-9)
    weight = np.minimum(total / np.maximum(np.median(total, axis=-1, keepdims=True), 1e-9), 1)
    weighted = weight[..., None] * _POWERS
    normal = np.swapaxes(weighted, -1, -2) @ _POWERS
    bend = np.maximum(length**2 / (8 * _BEND), _MIN_BEND)
    normal[..., 2, 2] += (_NOISE / bend) ** 2
    normal += 1e-9 * np.eye(3)  # an edge without contrast stays on its chord
    right = np.swapaxes(weighted, -1, -2) @ found[..., None]
    return np.asarray(np.linalg.solve(normal, right)[..., 0])


def _meet(edges: _Edges, curve: Array) -> Array:
    """Return where each edge (T, 4) meets the one before it (T, 4, 2), px, by Newton's method."""
    before = np.roll(np.arange(4), 1)
    ends = np.ones(curve.shape[:2]), -np.ones(curve.shape[:2])
    sides = [
        (_Edges(*(one[:, order] for one in edges)), curve[:, order])
        for order in (before, np.arange(4))
    ]
    for _ in range(_MEETINGS):
        (first, along), (second, other) = (
            _point_and_tangent(*side, end) for side, end in zip(sides, ends, strict=True)
        )
        jacobian = np.stack([along, -other], axis=-1) + 1e-12 * np.eye(2)
        step = np.linalg.solve(jacobian, (second - first)[..., None])[..., 0]
        ends = ends[0] + step[..., 0], ends[1] + step[..., 1]
    return _point_and_tangent(*sides[1], ends[1])[0]


def _point_and_tangent(edges: _Edges, curve: Array, place: Array) -> tuple[Array, Array]:
    """Return pixels (T, 4, 2) of curves at places (T, 4), and their derivatives."""
    slope = curve[..., 1] + 2 * curve[..., 2] * place
    point = edges.pixels_at(place, (curve * _powers(place)).sum(axis=-1))
    return point, edges.span / 2 + slope[..., None] * edges.normal
