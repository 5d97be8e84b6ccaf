"""Windows of an image around points, models fitted to them, and how sure that makes the points.

Every window is a system of its own.  What noise moves a point by follows from the residuals of its
window and of the whole photograph, as far as its windows have it in common.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.special import digamma, fdtrc, polygamma

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.detect.photographs import Pixels
from fisheye_svp_ros.solve.least_squares import Arrays, dense_step, levenberg_marquardt

SMOOTHING = 0.8  # px; sharpened photographs have edges that would fall between pixels
PIXEL = 1 / 12 + SMOOTHING**2  # px^2: what pixels and smoothing add to the blur
_ITERATIONS = 25
_MIN_POINTS = 8  # points of one photograph, whose noise tells little of each other's
_MUCH, _CHANCE = 4.0, 1e-6  # so much noisier a window is not by chance
_NOISE_RATIO = 1 / (4 * np.pi * SMOOTHING**2)  # of the variance of white noise, after smoothing
_PROBES, _EACH = 64, 8  # windows of noise, and how many of them tell what one window leaves
_CLIP_SHARE = 0.02  # of a smoothed pixel
_SIGHT = 4  # px that smoothing sees
_ROUNDING = 1 / 12  # variance of a whole number
_RIM = 2  # px along the border, where smoothing has seen the image's mirror image


# A fit that diverges overflows, and is rejected for that; nobody needs to read about it.
IN_SILENCE: dict[str, Any] = {'over': 'ignore', 'invalid': 'ignore', 'divide': 'ignore'}


class Windows(NamedTuple):
    """Round windows (N, P) of a smoothed image: data; offset (2, P), px, from place (N, 2).

    inside (N, P): the image but for its rim; clipped (N, P): light at the end of the scale is in
    it; side, px, of the square around, and which of its pixels are in a window, (P,); rounding:
    variance of a pixel from that alone.
    """

    data: Array
    offset: Array
    place: Index
    inside: Mask
    clipped: Mask
    side: int
    round: Index
    rounding: float


class WindowFit(NamedTuple):
    """How sure fits (N,) are: sigma of u and of v, px; noise, of a smoothed pixel; settled.

    noise2, gain2, freedom (N,): variance of a pixel, what it is multiplied by, of how many.
    """

    sigma: Array
    noise: Array
    settled: Mask
    noise2: Array
    gain2: Array
    freedom: Array

    def shrink_sigma(self, ok: Mask) -> tuple[Array, Mask]:
        """Return sigma (N,) drawn towards the noise of all that are ok (N,), and which still are.

        Something else is in the windows of the others.
        """
        if ok.sum() < _MIN_POINTS:
            return self.sigma, ok
        sigma, ok = self.sigma.copy(), ok.copy()
        alike, foreign = _shrink_variances(self.noise2[ok], self.freedom[ok])
        sigma[ok] = np.sqrt(alike * self.gain2[ok])
        ok[ok] = ~foreign
        return sigma, ok


def windows(pixels: Pixels, start: Array, reach: float) -> Windows:
    """Cut windows of a radius, px, around start (N, 2), px, out of an image (H, W)."""
    half = int(np.ceil(reach)) + 1
    height, width = pixels.shape
    place = np.round(start).astype(np.int64)
    v, u = np.mgrid[-half : half + 1, -half : half + 1].reshape(2, -1)
    round_ = np.flatnonzero(np.hypot(u, v) <= half + 0.5)  # no corners of the square
    u, v = u[round_], v[round_]
    columns, rows = place[:, :1] + u, place[:, 1:] + v
    inside = (columns >= _RIM) & (columns < width - _RIM) & (rows >= _RIM) & (rows < height - _RIM)
    rows, columns = np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)
    top, bottom = _smoothing_support(rows)
    left, right = _smoothing_support(columns)
    around, at = pixels[top:bottom, left:right], (rows - top, columns - left)
    smooth = cv2.GaussianBlur(around.astype(np.float32), (0, 0), SMOOTHING)
    return Windows(
        smooth[at].astype(float),
        np.stack([u, v]).astype(float),
        place,
        inside,
        inside & _clipped_mask(around)[at],
        2 * half + 1,
        round_,
        _ROUNDING if pixels.dtype.kind == 'u' else 0.0,
    )


def halve_image(pixels: Pixels) -> Pixels:
    """Return an image (H, W) at half its size."""
    height, width = (side // 2 * 2 for side in pixels.shape)
    half = cv2.resize(
        pixels[:height, :width], (width // 2, height // 2), interpolation=cv2.INTER_AREA
    )
    return np.asarray(half)


def _smoothing_support(at: Index) -> tuple[int, int]:
    """Return from where to where smoothing sees pixels at these places along an axis."""
    return max(int(at.min()) - _SIGHT, 0), int(at.max()) + _SIGHT + 1


class WindowProblem(ABC):
    """N windows as N independent systems, see least_squares.Problem; state (N, U).

    A subclass has the model; u, v of the point are the first unknowns.  slack: px that a point may
    be from where it settles.
    """

    step = staticmethod(dense_step)

    slack = 1e-4

    def __init__(self, cut: Windows, weight: Array) -> None:
        """Take the windows, and weights (N, P) of their pixels."""
        self.cut, self.weight = cut, weight
        # The scale of whitened residuals only says when to stop: at steps that change the window
        # by less than a thousandth of its contrast in all.
        self._noise = np.maximum(5e5 * cut.data.std(axis=1), 1e-6)

    @abstractmethod
    def model(self, values: Array, index: Index) -> tuple[Array, Array]:
        """Return what windows (A, P) look like, and derivatives (A, P, U)."""

    @abstractmethod
    def outside_domain(self, values: Array) -> Mask:
        """Return which states (A, U) are outside the domain."""

    def fit_brightness(self, values: Array, at: int) -> Array:
        """Return states (N, U) with what suits a window best at `at`: brightness and contrast."""
        values[:, at + 1] = 1.0
        (shape, _), weight = self.model(values, np.arange(len(values))), self.weight
        total = np.maximum(weight.sum(axis=1), 1e-9)
        mean, level = (weight * shape).sum(1) / total, (weight * self.cut.data).sum(1) / total
        off = weight * (shape - mean[:, None])
        values[:, at + 1] = (off * self.cut.data).sum(1) / np.maximum((off * shape).sum(1), 1e-9)
        values[:, at] = level - values[:, at + 1] * mean
        return values

    def solve(self, values: Array) -> Array:
        """Return the states (N, U) of least squares, from a start."""
        return levenberg_marquardt(self, (values,), _ITERATIONS).state[0]

    def linearize_windows(self, values: Array, index: Index) -> tuple[Array, Array, Array]:
        """Return residuals (A, P), derivatives of the model (A, P, U) and weights (A, P)."""
        image, jacobian = self.model(values, index)
        residual = self.cut.data[index] - image
        # Of light beyond the end of the scale no more is known than that it is there.
        known = ~(self.cut.clipped[index] & (residual < 0))
        return residual * known, jacobian * known[..., None], self.weight[index] * known

    def linearize(self, state: Arrays, index: Index) -> tuple[Array, Arrays]:
        with np.errstate(**IN_SILENCE):
            residual, jacobian, weight = self.linearize_windows(state[0], index)
        weight = weight / self._noise[index, None] ** 2
        transposed = np.swapaxes(jacobian * weight[..., None], -1, -2)
        hessian = transposed @ jacobian
        gradient = -(transposed @ residual[..., None])[..., 0]
        cost = (weight * residual**2).sum(axis=1)
        return np.where(self.outside_domain(state[0]) | ~np.isfinite(cost), np.inf, cost), (
            hessian,
            gradient,
        )

    def retract(self, state: Arrays, step: Arrays) -> Arrays:
        return (state[0] + step[0],)

    def judge(self, values: Array, symmetric: bool) -> WindowFit:
        """Return how sure solutions (N, U) are.

        symmetric: of a window that looks the same from both sides of its point, only what differs
        from one to the other counts; halos of sharpening are the same on both, and move nothing.
        """
        cut = self.cut
        residual, jacobian, weight = self.linearize_windows(values, np.arange(len(values)))
        weighted = np.swapaxes(jacobian * weight[..., None], -1, -2)
        hessian, pull = weighted @ jacobian, (weighted @ residual[..., None])[..., 0]
        scale = np.sqrt(np.maximum(np.einsum('nii->ni', hessian), 1e-30))
        scale = scale[:, :, None] * scale[:, None, :]
        covariance = np.linalg.inv(hessian / scale + 1e-12 * np.eye(values.shape[1])) / scale
        gain = covariance @ weighted
        # What is left of the residuals over what is left of noise of unit size, fitted likewise.
        probes = _unit_noise(cut.side)
        chosen = (np.arange(len(values))[:, None] * _EACH + np.arange(_EACH)) % len(probes)
        noise = probes[chosen][..., cut.round]
        noise -= (noise @ np.swapaxes(gain, -1, -2)) @ np.swapaxes(jacobian, -1, -2)
        whole = np.zeros((len(values), 2 + _EACH, cut.side**2))
        whole[..., cut.round] = np.concatenate([weight[:, None], residual[:, None], noise], axis=1)
        if symmetric:
            share, left = _antisymmetric_residuals(whole, values[:, :2], cut.side)
        else:
            share, left = whole[:, :1], whole[:, 1:]
        products = (share * left) @ np.swapaxes(left, -1, -2)
        squares = np.einsum('nkk->nk', products)
        usual = squares[:, 1:].mean(axis=1)
        # No pixel is surer than its last bit, though drawn boards are without noise, and even.
        noise2 = np.maximum(squares[:, 0] / np.maximum(usual, 1e-9), cut.rounding)
        # Of correlated pixels as many are independent as the squared trace of their covariance
        # over the trace of its square, which is what products of two noises are on average.
        other = products[:, 1:, 1:][:, ~np.eye(_EACH, dtype=bool)]
        freedom = np.maximum(usual**2 / np.maximum((other**2).mean(axis=1), 1e-18), 1.0)
        # Smoothed noise is correlated: what each raw pixel moves the point by, squared and summed.
        moved = np.zeros((len(values), 2, cut.side**2))
        moved[..., cut.round] = gain[:, :2]
        moved = gaussian_filter(
            moved.reshape(-1, 2, cut.side, cut.side), (0, 0, SMOOTHING, SMOOTHING)
        )
        gain2 = (moved**2).sum(axis=(1, 2, 3)) / 2
        sigma = np.sqrt(noise2 * gain2)
        # What the fit would still move the point by; a blur may take longer to settle.
        left = np.linalg.norm((covariance[:, :2] @ pull[..., None])[..., 0], axis=1)
        settled = np.isfinite(values).all(axis=1) & (sigma < 1) & (left < 0.1 * sigma + self.slack)
        settled &= weight.sum(axis=1) > values.shape[1]  # fewer pixels than unknowns fit anything
        return WindowFit(sigma, np.sqrt(_NOISE_RATIO * noise2), settled, noise2, gain2, freedom)


def _clipped_mask(pixels: Pixels) -> Mask:
    """Return which smoothed pixels (H, W) hold some of those at the end of the scale."""
    if pixels.dtype.kind != 'u':
        return np.zeros(pixels.shape, dtype=bool)
    full = np.asarray(pixels == np.iinfo(pixels.dtype).max)
    if not full.any():
        return full
    full = full.astype(np.float32)
    return np.asarray(cv2.GaussianBlur(full, (0, 0), SMOOTHING) > _CLIP_SHARE)


def _shrink_variances(noise2: Array, freedom: Array) -> tuple[Array, Mask]:
    """Return variances (N,), each from so few degrees of freedom, drawn towards their common one.

    By as much as they scatter no more than variances of one noise do (empirical Bayes).  Also
    which (N,) are beyond all others: something else is in their windows, the edge of the field.
    Source: Smyth, Linear models and empirical Bayes methods, Statistical Applications in Genetics
    and Molecular Biology 3 (2004), section 6.2.
    """
    half = freedom / 2
    level = np.log(np.maximum(noise2, 1e-30)) - digamma(half) + np.log(half)
    center = float(np.median(level))
    spread = (1.4826 * np.median(np.abs(level - center))) ** 2 - polygamma(1, half).mean()
    # 1 / (x - 0.5) is near the trigamma of x, from above one on.
    prior = 2 * min(1 / max(float(spread), 1e-6) + 0.5, 1e6)
    common = np.exp(center + digamma(prior / 2) - np.log(prior / 2))
    foreign = fdtrc(freedom, prior, noise2 / (_MUCH * common)) < _CHANCE
    return (prior * common + freedom * noise2) / (prior + freedom), np.asarray(foreign)


@lru_cache(maxsize=8)
def _unit_noise(side: int) -> Array:
    """Return windows (K, side * side) of white noise of unit variance, smoothed as images are."""
    noise = np.random.default_rng(0).standard_normal((_PROBES, side + 8, side + 8))
    smooth = gaussian_filter(noise, (0, SMOOTHING, SMOOTHING))[:, 4:-4, 4:-4]
    return np.asarray(smooth.reshape(_PROBES, -1))


def _antisymmetric_residuals(windows: Array, corner: Array, side: int) -> tuple[Array, Array]:
    """Return weights (N, 1, P), and the parts of residuals (N, K, P) odd about corners (N, 2), px.

    windows (N, 1 + K, P): weights, then residuals.
    """
    # The mirror image of each pixel lies between four others, of which it has its share.
    pixel = np.arange(side)
    opposite = 2 * corner[:, ::-1, None, None] + side - 1 - pixel[:, None]
    share = np.maximum(1 - np.abs(opposite - pixel), 0.0)
    share *= (opposite >= 0) & (opposite < side - 1)
    grid = windows.reshape(*windows.shape[:2], side, side)
    mirrored = share[:, None, 0] @ grid @ np.swapaxes(share[:, None, 1], -1, -2)
    pairs, odd = grid[:, 0] * mirrored[:, 0], (grid - mirrored)[:, 1:] / 2
    return pairs.reshape(len(pairs), 1, -1), odd.reshape(*odd.shape[:2], -1)
