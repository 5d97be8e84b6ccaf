"""Where a corner is, to a hundredth of a pixel, and how sure that is.

The image around a corner is a blurred step across two edges: across their product for the corner
of a chessboard (an X), within both for the corner of a square (an L).  Fitted by least squares are
the corner, both edges' directions, curvatures (lines are bent through a fisheye) and blurs,
brightness and its gradient.  An X looks the same from both sides of its corner, so what the model
leaves out (oblique blur, noise that grows with the light) does not move it to one side.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.special import erf

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.solve.least_squares import Arrays, dense_step, levenberg_marquardt

_SMALLEST, _LARGEST = 2.5, 10.0  # radius of the window, px
_WITHIN = 0.62  # of the distance to the next edge
_UNKNOWNS = 12  # u, v; of two edges angle, bend, log blur; brightness, contrast, its gradient
_ITERATIONS = 25
_CONTRAST = 6.0  # over the noise, below which a corner is not one
_SMOOTHING = 0.8  # px; sharpened photographs have edges that would fall between pixels
_PIXEL = 1 / 12 + _SMOOTHING**2  # px^2: what pixels and smoothing add to the blur
_KEPT = 1 / (4 * np.pi * _SMOOTHING**2)  # of the variance of white noise, after smoothing
_NEXT = float(np.exp(-1 / (4 * _SMOOTHING**2)))  # correlation of neighbours, after smoothing
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


def fit_corners(
    pixels: Array, start: Array, axes: Array, clearance: Array, square: bool = False
) -> Corners:
    """Fit corners in an image (H, W) of any brightness scale.

    start (N, 2), px, to within about a third of the clearance; axes (N, 2, 2): rows are the
    directions, in the image, of the board's two axes (into the square for an L); clearance (N,):
    distance to the next parallel edge, px; square: they are L corners.
    """
    radius = np.clip(_WITHIN * clearance, _SMALLEST, _LARGEST)
    half = int(np.ceil(radius.max(initial=_SMALLEST))) + 1
    height, width = pixels.shape
    place = np.round(start).astype(np.int64)
    v, u = np.mgrid[-half:half + 1, -half:half + 1].reshape(2, -1)
    round_ = np.flatnonzero(np.hypot(u, v) <= half + 0.5)  # no corners of the square
    u, v = u[round_], v[round_]
    columns, rows = place[:, :1] + u, place[:, 1:] + v
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    smooth = cv2.GaussianBlur(pixels.astype(np.float32), (0, 0), _SMOOTHING)
    data = smooth[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)].astype(float)
    problem = _Problem(
        data, np.stack([u, v]).astype(float), inside, radius, start - place, square
    )
    values = problem.start(axes)
    solved = levenberg_marquardt(problem, (values,), _ITERATIONS)
    values = solved.state[0]
    residual, jacobian, weight = problem.parts(values, np.arange(len(values)))
    shape = (2 * half + 1, round_)
    return _judged(values, residual, jacobian, weight, place, start, radius, square, shape)


def _judged(
    values: Array, residual: Array, jacobian: Array, weight: Array, place: Index, start: Array,
    radius: Array, square: bool, shape: tuple[int, Index],
) -> Corners:
    side, round_ = shape
    windows = np.zeros((2, len(values), side * side))
    windows[:, :, round_] = residual, weight
    noise2 = _noise(windows[0], windows[1], values[:, :2], side, square)
    weighted = np.swapaxes(jacobian * weight[..., None], -1, -2)
    hessian, pull = weighted @ jacobian, (weighted @ residual[..., None])[..., 0]
    scale = np.sqrt(np.maximum(np.einsum('nii->ni', hessian), 1e-30))
    unit = hessian / (scale[:, :, None] * scale[:, None, :]) + 1e-12 * np.eye(_UNKNOWNS)
    covariance = np.linalg.inv(unit) / (scale[:, :, None] * scale[:, None, :])
    # Smoothed noise is correlated: what each raw pixel moves the corner by, squared and summed.
    gain = np.zeros((len(values), 2, side * side))
    gain[:, :, round_] = covariance[:, :2] @ weighted
    gain = gaussian_filter(gain.reshape(-1, 2, side, side), (0, 0, _SMOOTHING, _SMOOTHING))
    sigma = np.sqrt(noise2 / _KEPT * (gain**2).sum(axis=(1, 2, 3)) / 2)
    # What the fit would still move the corner by; a blur may take longer to settle.
    left = np.linalg.norm((covariance[:, :2] @ pull[..., None])[..., 0], axis=1)
    uv, blur, contrast = values[:, :2] + place, np.exp(values[:, 6:8]).max(axis=1), values[:, 9]
    blur = np.sqrt(np.maximum(blur**2 - _PIXEL, 0.0))
    between = np.abs(np.sin(values[:, 2] - values[:, 3]))
    ok = (
        np.isfinite(uv).all(axis=1) & np.isfinite(sigma) & (sigma < 1)
        & (left < 0.1 * sigma + 1e-4)
        & (np.linalg.norm(uv - start, axis=1) < 0.7 * radius) & (blur < 0.7 * radius)
        & (np.abs(contrast) > _CONTRAST * np.sqrt(noise2)) & (between > 0.17)
        & (weight.sum(axis=1) > 0.7 * np.pi * radius**2)
    )
    return Corners(uv, sigma, blur, contrast, ok)


def _noise(residual: Array, weight: Array, corner: Array, side: int, square: bool) -> Array:
    """Return the variance (N,) of the noise in windows (N, P) of residuals.

    Of an X only what differs from one side of the corner to the other counts: the halo that
    sharpening leaves along edges is the same on both, and moves nothing.
    """
    if square:
        return np.asarray((weight * residual**2).sum(1)
                          / np.maximum(weight.sum(1) - _UNKNOWNS, 1.0))
    # The mirror image of each pixel lies between four others.
    opposite = 2 * corner[:, ::-1, None] + side - 1 - np.arange(side)
    first = np.floor(opposite).astype(np.int64)
    part = opposite[..., 0] - first[..., 0]
    inside = (first >= 0) & (first < side - 1)
    first = np.clip(first, 0, side - 2)
    grid = np.stack([residual, weight]).reshape(2, -1, side, side)
    system = np.arange(len(corner))[:, None, None]
    mirrored = np.zeros_like(grid)
    for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
        share = (np.abs(1 - down - part[:, 0]) * np.abs(1 - right - part[:, 1]))[:, None, None]
        mirrored += share * grid[:, system, first[:, 0, :, None] + down, first[:, 1, None] + right]
    pairs = grid[1] * mirrored[1] * (inside[:, 0, :, None] & inside[:, 1, None])
    odd2 = (pairs * (grid[0] - mirrored[0]) ** 2).sum(axis=(1, 2)) / 4
    # What lies between pixels scatters less, though smoothed ones less so.
    left = (1 - 2 * part * (1 - part) * (1 - _NEXT)).prod(axis=1)
    # Half of the pixels are the others' mirror images, half of the unknowns are odd.
    spare = np.maximum((pairs.sum(axis=(1, 2)) - _UNKNOWNS) / 2, 1.0)
    return np.asarray(odd2 * 2 / (1 + left) / spare)


class _Problem:
    """N corners as N independent systems, see least_squares.Problem; state (N, 12)."""

    def __init__(
        self, data: Array, offset: Array, inside: Mask, radius: Array, start: Array, square: bool
    ) -> None:
        self._data, self._offset, self._square = data, offset, square
        self._first = start
        distance = np.hypot(offset[0] - start[:, :1], offset[1] - start[:, 1:])
        self._weight = np.clip(radius[:, None] + 0.5 - distance, 0.0, 1.0) * inside
        # The scale of whitened residuals only says when to stop: at steps that change the window
        # by less than a thousandth of its contrast in all.
        self._noise = np.maximum(5e5 * data.std(axis=1), 1e-6)

    def start(self, axes: Array) -> Array:
        """Return a start (N, 12): the edges along the axes, brightness and contrast by a sum."""
        values = np.zeros((len(self._data), _UNKNOWNS))
        values[:, :2] = self._first
        for edge in (0, 1):
            along, other = axes[:, 1 - edge], axes[:, edge]
            normal = np.stack([along[:, 1], -along[:, 0]], axis=-1)
            normal *= np.sign((normal * other).sum(axis=1, keepdims=True))
            values[:, 2 + edge] = np.arctan2(normal[:, 1], normal[:, 0])
        values[:, 9] = 1.0
        shape, _, weight = self._model(values, np.arange(len(values)))
        total = np.maximum(weight.sum(axis=1), 1e-9)
        mean, level = (weight * shape).sum(1) / total, (weight * self._data).sum(1) / total
        off = weight * (shape - mean[:, None])
        values[:, 9] = (off * self._data).sum(1) / np.maximum((off * shape).sum(1), 1e-9)
        values[:, 8] = level - values[:, 9] * mean
        return values

    def parts(self, values: Array, index: Index) -> tuple[Array, Array, Array]:
        """Return residuals (A, P), derivatives of the model (A, P, 12) and weights (A, P)."""
        image, jacobian, weight = self._model(values, index)
        return self._data[index] - image, jacobian, weight

    def linearise(self, state: Arrays, index: Index) -> tuple[Array, Arrays]:
        residual, jacobian, weight = self.parts(state[0], index)
        weight = weight / self._noise[index, None] ** 2
        weighted = jacobian * weight[..., None]
        transposed = np.swapaxes(weighted, -1, -2)
        hessian = transposed @ jacobian
        gradient = -(transposed @ residual[..., None])[..., 0]
        cost = (weight * residual**2).sum(axis=1)
        lost = (np.abs(state[0][:, 6:8]).max(axis=1) > 4) | ~np.isfinite(cost)
        return np.where(lost, np.inf, cost), (hessian, gradient)

    def step(self, normal: Arrays, damping: Array) -> tuple[Arrays, Array]:
        return dense_step(normal, damping)

    def retract(self, state: Arrays, step: Arrays) -> Arrays:
        return (state[0] + step[0],)

    def _model(self, values: Array, index: Index) -> tuple[Array, Array, Array]:
        du = self._offset[0] - values[:, :1]
        dv = self._offset[1] - values[:, 1:2]
        edges = [
            _edge(du, dv, *(values[:, k + i:k + i + 1] for k in (2, 4, 6))) for i in (0, 1)
        ]
        first, second = edges[0][0], edges[1][0]
        if self._square:
            shape = (1 + first) * (1 + second) / 2 - 1
            by_edge = (1 + second) / 2, (1 + first) / 2
        else:
            shape, by_edge = first * second, (second, first)
        light = 1 + values[:, 10:11] * du + values[:, 11:12] * dv
        level, contrast = values[:, 8:9], values[:, 9:10]
        face = level + contrast * shape
        jacobian = np.empty((*du.shape, _UNKNOWNS))
        slope = [contrast * light * by_edge[i] for i in (0, 1)]
        for axis in (0, 1):
            jacobian[..., axis] = (
                slope[0] * edges[0][1 + axis] + slope[1] * edges[1][1 + axis]
                - face * values[:, 10 + axis, None]
            )
        for i in (0, 1):
            jacobian[..., 2 + i] = slope[i] * edges[i][3]
            jacobian[..., 4 + i] = slope[i] * edges[i][4]
            jacobian[..., 6 + i] = slope[i] * edges[i][5]
        jacobian[..., 8], jacobian[..., 9] = light, shape * light
        jacobian[..., 10], jacobian[..., 11] = face * du, face * dv
        return face * light, jacobian, self._weight[index]


def _edge(du: Array, dv: Array, angle: Array, bend: Array, size: Array) -> tuple[Array, ...]:
    """Return a blurred edge (A, P), -1 to 1, and its derivatives by u, v, angle, bend, size.

    size: logarithm of the blur.
    """
    blur = np.exp(np.clip(size, -5, 5))
    cos, sin = np.cos(angle), np.sin(angle)
    across, along = cos * du + sin * dv, cos * dv - sin * du
    distance = (across + 0.5 * bend * along * along) / blur
    slope = (_ROOT / blur) * np.exp(-0.5 * distance * distance)
    lean = bend * along
    return (
        erf(distance / np.sqrt(2)),
        slope * (lean * sin - cos), -slope * (lean * cos + sin),
        slope * along * (1 - bend * across), slope * (0.5 * along * along),
        -slope * distance * blur,
    )
