"""Where a corner is, to a hundredth of a pixel, and how sure that is.

The image around a corner is a blurred step across two edges: across their product for the corner
of a chessboard (an X), within both for the corner of a square (an L).  Fitted by least squares are
the corner, both edges' directions, curvatures (lines are bent through a fisheye) and blurs,
brightness and its gradient.  An X looks the same from both sides of its corner, so what the model
leaves out (oblique blur, noise that grows with the light) does not move it to one side.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.special import digamma, erf, fdtrc, polygamma

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.solve.least_squares import Arrays, dense_step, levenberg_marquardt

_SMALLEST, _LARGEST = 2.5, 10.0  # radius of the window, px
_WITHIN = 0.62  # of the distance to the next edge
_SKIRT = 2.5  # blurs of the next edge that stay out of the window
_UNKNOWNS = 12  # u, v; of two edges angle, bend, log blur; brightness, contrast, its gradient
_ITERATIONS = 25
_FEW = 8  # corners of one photograph, whose noise tells little of each other's
_MUCH, _CHANCE = 4.0, 1e-6  # so much noisier a window is not by chance
_CONTRAST = 6.0  # over the noise, below which a corner is not one
_SMOOTHING = 0.8  # px; sharpened photographs have edges that would fall between pixels
_PIXEL = 1 / 12 + _SMOOTHING**2  # px^2: what pixels and smoothing add to the blur
_KEPT = 1 / (4 * np.pi * _SMOOTHING**2)  # of the variance of white noise, after smoothing
_PROBES, _EACH = 64, 8  # windows of noise, and how many of them tell what one window leaves
_INDEPENDENT = 1 / (2 * np.pi * _SMOOTHING**2)  # of smoothed pixels: one over their rho^2 summed
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


def room(clearance: Array, blur: Array) -> Array:
    """Return the clearance (N,), px, that leaves an edge so far away, and so blurred, outside."""
    reach = clearance - _SKIRT * np.sqrt(blur**2 + _PIXEL)
    return np.asarray(np.maximum(reach, _SMALLEST) / _WITHIN)


def _judged(
    values: Array, residual: Array, jacobian: Array, weight: Array, place: Index, start: Array,
    radius: Array, square: bool, shape: tuple[int, Index],
) -> Corners:
    side, round_ = shape
    weighted = np.swapaxes(jacobian * weight[..., None], -1, -2)
    hessian, pull = weighted @ jacobian, (weighted @ residual[..., None])[..., 0]
    scale = np.sqrt(np.maximum(np.einsum('nii->ni', hessian), 1e-30))
    unit = hessian / (scale[:, :, None] * scale[:, None, :]) + 1e-12 * np.eye(_UNKNOWNS)
    covariance = np.linalg.inv(unit) / (scale[:, :, None] * scale[:, None, :])
    gain = covariance @ weighted
    # What is left of the residuals over what is left of noise of unit size, fitted likewise.
    probes = _unit_noise(side)
    chosen = (np.arange(len(values))[:, None] * _EACH + np.arange(_EACH)) % len(probes)
    noise = probes[chosen][..., round_]
    noise -= (noise @ np.swapaxes(gain, -1, -2)) @ np.swapaxes(jacobian, -1, -2)
    windows = np.zeros((len(values), 2 + _EACH, side * side))
    windows[..., round_] = np.concatenate([weight[:, None], residual[:, None], noise], axis=1)
    squares = _squares(windows, values[:, :2], side, square)
    usual = squares[:, 1:].mean(axis=1)
    noise2 = squares[:, 0] / np.maximum(usual, 1e-9)
    freedom = np.maximum(usual / _KEPT * _INDEPENDENT, 1.0)
    # Smoothed noise is correlated: what each raw pixel moves the corner by, squared and summed.
    moved = np.zeros((len(values), 2, side * side))
    moved[..., round_] = gain[:, :2]
    moved = gaussian_filter(moved.reshape(-1, 2, side, side), (0, 0, _SMOOTHING, _SMOOTHING))
    gain2 = (moved**2).sum(axis=(1, 2, 3)) / 2
    sigma = np.sqrt(noise2 * gain2)
    # What the fit would still move the corner by; a blur may take longer to settle.
    left = np.linalg.norm((covariance[:, :2] @ pull[..., None])[..., 0], axis=1)
    uv, blur, contrast = values[:, :2] + place, np.exp(values[:, 6:8]).max(axis=1), values[:, 9]
    blur = np.sqrt(np.maximum(blur**2 - _PIXEL, 0.0))
    between = np.abs(np.sin(values[:, 2] - values[:, 3]))
    ok = (
        np.isfinite(uv).all(axis=1) & np.isfinite(sigma) & (sigma < 1)
        & (left < 0.1 * sigma + 1e-4)
        & (np.linalg.norm(uv - start, axis=1) < 0.7 * radius) & (blur < 0.7 * radius)
        & (np.abs(contrast) > _CONTRAST * np.sqrt(_KEPT * noise2)) & (between > 0.17)
        & (weight.sum(axis=1) > 0.7 * np.pi * radius**2)
    )
    if ok.sum() >= _FEW:
        alike, foreign = _moderated(noise2[ok], freedom[ok])
        sigma[ok] = np.sqrt(alike * gain2[ok])
        ok[ok] = ~foreign
    return Corners(uv, sigma, blur, contrast, ok)


def _moderated(noise2: Array, freedom: Array) -> tuple[Array, Mask]:
    """Return variances (N,), each from so few degrees of freedom, drawn towards their common one.

    By as much as they scatter no more than variances of one noise do (empirical Bayes).  Also
    which (N,) are beyond all others: something else is in their windows, the edge of the field.
    Source: Smyth, Linear models and empirical Bayes methods, Statistical Applications in Genetics
    and Molecular Biology 3 (2004), section 6.2.
    """
    half = freedom / 2
    level = np.log(np.maximum(noise2, 1e-30)) - digamma(half) + np.log(half)
    centre = float(np.median(level))
    spread = (1.4826 * np.median(np.abs(level - centre))) ** 2 - polygamma(1, half).mean()
    # 1 / (x - 0.5) is near the trigamma of x, from above one on.
    prior = 2 * min(1 / max(float(spread), 1e-6) + 0.5, 1e6)
    common = np.exp(centre + digamma(prior / 2) - np.log(prior / 2))
    foreign = fdtrc(freedom, prior, noise2 / (_MUCH * common)) < _CHANCE
    return (prior * common + freedom * noise2) / (prior + freedom), np.asarray(foreign)


@lru_cache(maxsize=8)
def _unit_noise(side: int) -> Array:
    """Return windows (K, side * side) of white noise of unit variance, smoothed as images are."""
    noise = np.random.default_rng(0).standard_normal((_PROBES, side + 8, side + 8))
    smooth = gaussian_filter(noise, (0, _SMOOTHING, _SMOOTHING))[:, 4:-4, 4:-4]
    return np.asarray(smooth.reshape(_PROBES, -1))


def _squares(windows: Array, corner: Array, side: int, square: bool) -> Array:
    """Return sums (N, K) of squares of residuals, windows[:, 1:] (N, 1 + K, P); first are weights.

    Of an X only what differs from one side of the corner to the other counts: the halo that
    sharpening leaves along edges is the same on both, and moves nothing.
    """
    if square:
        return np.asarray((windows[:, :1] * windows[:, 1:] ** 2).sum(axis=-1))
    # The mirror image of each pixel lies between four others.
    opposite = 2 * corner[:, ::-1, None] + side - 1 - np.arange(side)
    first = np.floor(opposite).astype(np.int64)
    part = opposite[..., 0] - first[..., 0]
    inside = (first >= 0) & (first < side - 1)
    first = np.clip(first, 0, side - 2)
    grid = windows.reshape(*windows.shape[:2], side, side)
    system = np.arange(len(corner))[:, None, None]
    mirrored = np.zeros_like(grid)
    for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
        share = np.abs(1 - down - part[:, 0]) * np.abs(1 - right - part[:, 1])
        mirrored += share[:, None, None, None] * np.moveaxis(
            grid[system, :, first[:, 0, :, None] + down, first[:, 1, None] + right], -1, 1)
    pairs = grid[:, 0] * mirrored[:, 0] * (inside[:, 0, :, None] & inside[:, 1, None])
    odd2 = (grid[:, 1:] - mirrored[:, 1:]) ** 2 / 4
    return np.asarray((pairs[:, None] * odd2).sum(axis=(-2, -1)))


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
        corner = _inner if self._square else _cross
        between = values[:, 2:3] - values[:, 3:4]
        shape, *by_edge, by_cosine = corner(edges[0][0], edges[1][0], np.cos(between))
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
            turned = contrast * light * by_cosine * (2 * i - 1) * np.sin(between)
            jacobian[..., 2 + i] = slope[i] * edges[i][3] + turned
            jacobian[..., 4 + i] = slope[i] * edges[i][4]
            jacobian[..., 6 + i] = slope[i] * edges[i][5]
        jacobian[..., 8], jacobian[..., 9] = light, shape * light
        jacobian[..., 10], jacobian[..., 11] = face * du, face * dv
        return face * light, jacobian, self._weight[index]


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


def _inner(a: Array, b: Array, alike: Array) -> tuple[Array, Array, Array, Array]:
    """Return a blurred L (A, P), -1 to 1, and its derivatives: the X and both edges, halved."""
    shape, by_a, by_b, by_alike = _cross(a, b, alike)
    edges = [(erf(d / np.sqrt(2)), _ROOT * np.exp(-0.5 * d * d)) for d in (a, b)]
    return ((shape + edges[0][0] + edges[1][0] - 1) / 2,
            (by_a + edges[0][1]) / 2, (by_b + edges[1][1]) / 2, by_alike / 2)


def _edge(du: Array, dv: Array, angle: Array, bend: Array, size: Array) -> tuple[Array, ...]:
    """Return the distance (A, P) from an edge over its blur, and its derivatives.

    By u, v, angle, bend, size: the logarithm of the blur.
    """
    blur = np.exp(np.clip(size, -5, 5))
    cos, sin = np.cos(angle), np.sin(angle)
    across, along = cos * du + sin * dv, cos * dv - sin * du
    distance, lean = (across + 0.5 * bend * along * along) / blur, bend * along
    return (
        distance, (lean * sin - cos) / blur, -(lean * cos + sin) / blur,
        along * (1 - bend * across) / blur, 0.5 * along * along / blur, -distance,
    )
