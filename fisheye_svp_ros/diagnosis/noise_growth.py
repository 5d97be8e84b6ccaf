"""Whether the noise grows with the incidence angle: asked last, once static fields are known.

What no static field has taken up is no noise: it errs by the same wherever a point falls on the
same place of the image, and landmarks of another color err in proportion to the image height.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import optimize, special

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.fitted_model import MIN_PAIRS, FittedModel

_LARGEST_SQUARE = 20.0  # of a standardized residual: an outlier counts no more
_LANDMARK_SIGMAS = 2.6  # standard errors of the growth, within landmarks
_ACROSS_SIGMAS, _ACROSS_SHARE = 2.0, 0.5  # of that across the radius; its share of the growth
_CLOSEST_PAIRS = 500
_RING = 10  # points of nearly the same height
_MIN_REST = 0.2  # of a variance, beside the leverage
_PLACE_SIGMAS = 2.0  # and of that between points on the same place


class NoiseGrowth(NamedTuple):
    """Noise that changes: value, standard error, p-value; variance (F, M): over the mean one."""

    value: float
    stderr: float
    p_value: float
    variance: Array


def noise_growth(fitted: FittedModel) -> NoiseGrowth:
    """Fit sigma(theta) = sigma0 exp(growth theta^2) to residuals (likelihood ratio).

    There is none where the same landmarks do not scatter more at larger angles, or points of
    different frames on the same place do not: some landmarks, or places, err more than others.
    Nor where they do so along the radius alone, as ripples of a lens and its colors make them.
    """
    linear = fitted.linear
    used = linear.row_mask
    errors, landmark = _scatter(fitted)
    theta = linear.data.blocks(np.nan_to_num(linear.scene.theta)[..., None] * np.ones(2))
    every = theta**2 - (theta[used] ** 2).mean()
    z, e2 = every[used], np.minimum(errors.ravel() ** 2, _LARGEST_SQUARE)
    value, gain = _fit_growth(e2, z)
    # Heavier tails than the normal distribution's scatter the squares more.
    tails = max(float(e2.var()) / 2, 1.0)
    stderr = float(np.sqrt(tails / 2 / (z**2).sum()))
    sign, pairs = np.sign(value), fitted.point_pairs()
    frame, across = np.nonzero(used)[0], _fit_growth(e2[1::2], z[1::2])[0]
    confirmed = (
        sign * across > _ACROSS_SHARE * abs(value)
        and sign * _growth_within(e2, z, np.repeat(landmark, 2), frame) > _LANDMARK_SIGMAS
        and sign * _growth_within(e2[1::2], z[1::2], landmark, frame[1::2]) > _ACROSS_SIGMAS
        and sign * _growth_on_places(errors, z[::2], *pairs) > _PLACE_SIGMAS)
    p = float(special.chdtrc(1, max(gain / tails, 0.0))) if confirmed else 1.0
    level = float(np.mean(e2 * np.exp(-2 * value * z)))
    return NoiseGrowth(value, stderr, p, level * np.exp(2 * value * every))


def _fit_growth(e2: Array, z: Array) -> tuple[float, float]:
    """Return the likeliest growth of squares (M,) with centered z (M,), and twice its log odds."""

    def deviance(growth: float) -> float:
        # The mean of log sigma does not change: only the scale is profiled out.
        return float(len(z) * np.log(np.mean(e2 * np.exp(-2 * growth * z))))

    best = optimize.minimize_scalar(deviance, bounds=(-3.0, 3.0), method='bounded')
    return float(best.x), deviance(0.0) - float(best.fun)


def _scatter(fitted: FittedModel) -> tuple[Array, Index]:
    """Return standardized residuals (N, 2) along and across the radius, and landmarks (N,).

    What a lens does to each color, a magnification of each landmark's own, and its static radial
    error, however fine, are taken out.
    """
    linear = fitted.linear
    used = linear.row_mask
    errors = fitted.standardized_residuals[used].reshape(-1, 2)
    centers = np.array([[lens.cx, lens.cy] for lens in linear.state.lenses])
    center = centers[np.minimum(linear.data.camera_of, len(centers) - 1)][:, None]
    arm = linear.data.blocks(np.nan_to_num(linear.linear.uv - center))[used].reshape(-1, 2)
    landmark, camera = (
        linear.data.blocks(of[..., None] * np.ones(2))[used][::2].astype(np.int64)
        for of in (linear.data.views.landmark,
                   np.broadcast_to(linear.data.camera_of[:, None], linear.weight.shape)))
    height = np.maximum(np.linalg.norm(arm, axis=1), 1e-9)
    radial = (errors * arm).sum(axis=1) / height
    across = (errors[:, 1] * arm[:, 0] - errors[:, 0] * arm[:, 1]) / height
    return np.stack([_without_profile(_without_colors(radial, height, landmark), height, camera),
                     across], axis=-1), landmark


def _without_colors(radial: Array, height: Array, landmark: Index) -> Array:
    """Return radial residuals (N,) without a part in proportion to the height, by landmark."""
    along, square = (np.bincount(landmark, weights=of) for of in (height * radial, height**2))
    factor = along / np.maximum(square, 1e-300)
    leverage = np.clip(height**2 / np.maximum(square, 1e-300)[landmark], 0.0, 0.8)
    return np.asarray((radial - factor[landmark] * height) / np.sqrt(1 - leverage))


def _without_profile(radial: Array, height: Array, camera: Index) -> Array:
    """Return radial residuals (N,) without a line through those of nearly the same height."""
    order, left = np.lexsort((height, camera)), radial.copy()
    for ring in np.array_split(order, max(len(order) // _RING, 1)):
        line = np.linalg.qr(np.stack([np.ones(len(ring)), height[ring]], axis=1))[0]
        rest = np.maximum(1 - (line**2).sum(axis=1), _MIN_REST)
        left[ring] = (radial[ring] - line @ (line.T @ radial[ring])) / np.sqrt(rest)
    return left


def _growth_within(e2: Array, z: Array, group: Index, frame: Index) -> float:
    """Return how squares e2 (M,) grow with z within groups (M,), in standard errors.

    What one frame (M,) contributes counts as one observation: its points may err together.
    """
    count = np.maximum(np.bincount(group), 1)
    mean, middle = ((np.bincount(group, weights=of) / count)[group] for of in (e2, z))
    products = np.bincount(frame, weights=(e2 / np.maximum(mean, 1e-300) - 1) * (z - middle))
    return float(products.sum() / max(np.sqrt((products**2).sum()), 1e-300))


def _growth_on_places(errors: Array, z: Array, pairs: Index, frame: Index) -> float:
    """Return how the scatter (N, 2) of points on the same place grows with z (N,), as above.

    A static field cancels in their differences.
    """
    if len(pairs) < MIN_PAIRS:
        return 0.0
    one, other = pairs[:_CLOSEST_PAIRS].T
    squares = np.minimum((errors[one] - errors[other]) ** 2 / 2, _LARGEST_SQUARE).mean(axis=1)
    middle = (z[one] + z[other]) / 2
    return _growth_within(squares, middle, np.zeros(len(one), dtype=np.int64), frame[one])
