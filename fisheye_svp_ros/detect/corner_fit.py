"""Where a corner is, to a hundredth of a pixel, and how sure that is.

The image around a corner is a blurred step across two edges: across their product for the corner
of a chessboard (an X), within both for the corner of a square (an L).  Fitted by least squares are
the corner, both edges' directions, curvatures (lines are bent through a fisheye) and blurs,
brightness and its gradient.  An X looks the same from both sides of its corner, so what the model
leaves out (oblique blur, noise that grows with the light) does not move it to one side.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import erf

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.detect.windows import IN_SILENCE, PIXEL, WindowProblem, Windows, windows

_SMALLEST, _LARGEST = 2.5, 10.0  # radius of the window, px
_WINDOW_SHARE = 0.62  # of the distance to the next edge
_SKIRT = 2.5  # blurs of the next edge that stay out of the window
_UNKNOWNS = 12  # u, v; of two edges angle, bend, log blur; brightness, contrast, its gradient
CONTRAST = 6.0  # over the noise, below which a corner is not one
_ROOT = float(np.sqrt(2 / np.pi))


class Corners(NamedTuple):
    """Corners (N,): uv (N, 2), px; sigma of u and of v, px; blur, px; contrast; ok.

    contrast: half the step in brightness, above 0 where the quarter towards both axes is bright.
    """

    uv: Array
    sigma: Array
    blur: Array
    contrast: Array
    ok: Mask


@np.errstate(**IN_SILENCE)
def fit_corners(
    pixels: Array,
    start: Array,
    axes: Array,
    clearance: Array,
    square: bool = False,
    censored: bool = True,
) -> Corners:
    """Fit corners in an image (H, W) of any brightness scale.

    start (N, 2), px, to within about a third of the clearance; axes (N, 2, 2): rows are the
    directions, in the image, of the board's two axes (into the square for an L); clearance (N,):
    distance to the next parallel edge, px; square: they are L corners; censored: light at the end
    of the scale may have been any beyond it.
    """
    radius = np.clip(_WINDOW_SHARE * clearance, _SMALLEST, _LARGEST)
    cut = windows(pixels, start, radius.max(initial=_SMALLEST))
    if square or not censored:
        # An edge of unknown height would move an L; paper as bright as pixels can be is usual.
        cut = cut._replace(clipped=np.zeros_like(cut.clipped))
    problem = _Problem(cut, radius, start - cut.place, square)
    values = problem.solve(problem.start(axes))
    judged = problem.judge(values, symmetric=not square)
    # Smoothing a brightness that rises moves edges down the slope.
    uv, contrast = values[:, :2] + PIXEL * values[:, 10:] + cut.place, values[:, 9]
    blur = np.sqrt(np.maximum(np.exp(2 * values[:, 6:8]).max(axis=1) - PIXEL, 0.0))
    ok = (
        judged.settled
        & (np.linalg.norm(uv - start, axis=1) < 0.7 * radius)
        & (blur < 0.7 * radius)
        & (np.abs(contrast) > CONTRAST * judged.noise)
        & (np.abs(np.sin(values[:, 2] - values[:, 3])) > 0.17)
        & (problem.weight.sum(axis=1) > 0.7 * np.pi * radius**2)
    )
    sigma, ok = judged.shrink_sigma(ok)
    return Corners(uv, sigma, blur, contrast, ok)


def edge_clearance(clearance: Array, blur: Array) -> Array:
    """Return the clearance (N,), px, that leaves an edge so far away, and so blurred, outside."""
    reach = clearance - _SKIRT * np.sqrt(blur**2 + PIXEL)
    return np.asarray(np.maximum(reach, _SMALLEST) / _WINDOW_SHARE)


class _Problem(WindowProblem):
    """Corners; state (N, 12)."""

    def __init__(self, cut: Windows, radius: Array, start: Array, square: bool) -> None:
        distance = np.hypot(cut.offset[0] - start[:, :1], cut.offset[1] - start[:, 1:])
        super().__init__(cut, np.clip(radius[:, None] + 0.5 - distance, 0.0, 1.0) * cut.inside)
        self._first, self._square = start, square

    def start(self, axes: Array) -> Array:
        """Return a start (N, 12): the edges along the axes, brightness and contrast by a sum."""
        values = np.zeros((len(self._first), _UNKNOWNS))
        values[:, :2] = self._first
        for edge in (0, 1):
            along, other = axes[:, 1 - edge], axes[:, edge]
            normal = np.stack([along[:, 1], -along[:, 0]], axis=-1)
            normal *= np.sign((normal * other).sum(axis=1, keepdims=True))
            values[:, 2 + edge] = np.arctan2(normal[:, 1], normal[:, 0])
        return self.fit_brightness(values, 8)

    def outside_domain(self, values: Array) -> Mask:
        return np.asarray(np.abs(values[:, 6:8]).max(axis=1) > 4)

    def model(self, values: Array, index: Index) -> tuple[Array, Array]:
        du = self.cut.offset[0] - values[:, :1]
        dv = self.cut.offset[1] - values[:, 1:2]
        edges = [_edge(du, dv, *(values[:, k + i : k + i + 1] for k in (2, 4, 6))) for i in (0, 1)]
        corner = _blurred_l if self._square else _cross
        between = values[:, 2:3] - values[:, 3:4]
        shape, *by_edge, by_cosine = corner(edges[0][0], edges[1][0], np.cos(between))
        light = 1 + values[:, 10:11] * du + values[:, 11:12] * dv
        level, contrast = values[:, 8:9], values[:, 9:10]
        face = level + contrast * shape
        jacobian = np.empty((*du.shape, _UNKNOWNS))
        slope = [contrast * light * by_edge[i] for i in (0, 1)]
        for axis in (0, 1):
            jacobian[..., axis] = (
                slope[0] * edges[0][1 + axis]
                + slope[1] * edges[1][1 + axis]
                - face * values[:, 10 + axis, None]
            )
        for i in (0, 1):
            turned = contrast * light * by_cosine * (2 * i - 1) * np.sin(between)
            jacobian[..., 2 + i] = slope[i] * edges[i][3] + turned
            jacobian[..., 4 + i] = slope[i] * edges[i][4]
            jacobian[..., 6 + i] = slope[i] * edges[i][5]
        jacobian[..., 8], jacobian[..., 9] = light, shape * light
        jacobian[..., 10], jacobian[..., 11] = face * du, face * dv
        return face * light, jacobian


def _cross(a: Array, b: Array, alike: Array) -> tuple[Array, Array, Array, Array]:
    """Return a blurred X (A, P), -1 to 1, and its derivatives by a, b and alike.

    a, b: distances from the edges over their blurs; alike (A, 1): cosine between the edges.  What
    a blur makes of a corner is the chance that two Gaussian numbers, correlated so, lie on one
    side each, by the first terms of the tetrachoric series (Pearson, Phil. Trans. A 195, 1900).
    """
    first, second = erf(a / np.sqrt(2)), erf(b / np.sqrt(2))
    by_a, by_b = _ROOT * np.exp(-0.5 * a * a), _ROOT * np.exp(-0.5 * b * b)
    both, square, cube = by_a * by_b, alike**2 / 2, alike**3 / 6
    across, other = a * a - 1, b * b - 1
    more = alike + square * a * b + cube * across * other
    return (
        first * second + both * more,
        by_a * second + both * (square * b + 2 * cube * a * other - a * more),
        by_b * first + both * (square * a + 2 * cube * b * across - b * more),
        both * (1 + alike * a * b + square * across * other),
    )


def _blurred_l(a: Array, b: Array, alike: Array) -> tuple[Array, Array, Array, Array]:
    """Return a blurred L (A, P), -1 to 1, and its derivatives: the X and both edges, halved."""
    shape, by_a, by_b, by_alike = _cross(a, b, alike)
    edges = [(erf(d / np.sqrt(2)), _ROOT * np.exp(-0.5 * d * d)) for d in (a, b)]
    return (
        (shape + edges[0][0] + edges[1][0] - 1) / 2,
        (by_a + edges[0][1]) / 2,
        (by_b + edges[1][1]) / 2,
        by_alike / 2,
    )


def _edge(du: Array, dv: Array, angle: Array, bend: Array, size: Array) -> tuple[Array, ...]:
    """Return the distance (A, P) from an edge over its blur, and its derivatives.

    By u, v, angle, bend, size: the logarithm of the blur, which moves a bent edge towards its
    inner side.
    """
    blur = np.exp(np.clip(size, -5, 5))
    cos, sin = np.cos(angle), np.sin(angle)
    across, along = cos * du + sin * dv, cos * dv - sin * du
    sharp, lean = (across + 0.5 * bend * along * along) / blur, bend * along
    inwards = 0.5 * bend * blur
    return (
        sharp + inwards,
        (lean * sin - cos) / blur,
        -(lean * cos + sin) / blur,
        along * (1 - bend * across) / blur,
        0.5 * (along * along / blur + blur),
        inwards - sharp,
    )
