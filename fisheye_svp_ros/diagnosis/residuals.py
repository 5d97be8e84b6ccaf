"""What the null model leaves: residuals with everything predicted, and their leverages."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.diagnosis.model import Linearised, flat_rows
from fisheye_svp_ros.diagnosis.products import moves_of
from fisheye_svp_ros.diagnosis.refit import Fitted

_PROBES = 24
_FINEST = 80  # of the image: how near to each other points have the same place
_FEWEST_PAIRS = 100


def rms_px(linear: Linearised, whitened: Array | None = None) -> float:
    """Return the root mean square of the 2-D norm, px, of whitened residuals (F, M).

    Without any: of those of the fit itself.
    """
    weight, used = linear.row_weight, linear.used
    rows = linear.residual if whitened is None else whitened
    return float(np.sqrt(2 * np.mean((rows[used] / weight[used]) ** 2)))


def conditional_residuals(fitted: Fitted) -> Array:
    """Return whitened residuals (F, M), every random part at its prediction."""
    solution = fitted.solution
    remaining = fitted.linear.residual - _rows(
        fitted, solution.e[..., None], solution.r[:, None], solution.values[:, None]
    )[..., 0]
    return np.asarray(remaining * fitted.linear.used)


def leverages(fitted: Fitted) -> Array:
    """Return the diagonal (F, M) of the hat matrix, from random signs.

    Source: Hutchinson, A stochastic estimator of the trace of the influence matrix,
    Communications in Statistics 19 (1990).
    """
    shape = fitted.linear.residual.shape
    rng = np.random.default_rng(0)
    signs = rng.choice([-1.0, 1.0], (*shape, _PROBES)) * fitted.linear.used[..., None]
    hat = _rows(fitted, *fitted.factored.solved(*_products(fitted, signs)))
    return np.asarray(np.clip((signs * hat).mean(axis=-1), 0.0, 0.8))


def standardised_squares(fitted: Fitted) -> Array:
    """Return squared residuals (F, M) over their expected squares: each about 1 on average."""
    remaining = conditional_residuals(fitted)
    return np.asarray(remaining**2 / (1 - leverages(fitted)) / fitted.solution.variance)


def ripples(fitted: Fitted) -> float:
    """Return how alike points of different frames err on the same place, in standard errors.

    Residuals with everything predicted that are finer than the image fields have room for.
    """
    linear = fitted.linear
    remaining = conditional_residuals(fitted).reshape(*linear.residual.shape[:1], -1, 2)
    uv = linear.data.blocks(np.nan_to_num(linear.linear.uv)[..., None, :])
    used = linear.used[:, ::2]
    frame = np.broadcast_to(np.arange(len(used))[:, None], used.shape)[used]
    places, errors = uv[used], remaining[used]
    reach = float(np.ptp(places, axis=0).max()) / _FINEST
    pairs = cKDTree(places).query_pairs(reach, output_type='ndarray')
    pairs = pairs[frame[pairs[:, 0]] != frame[pairs[:, 1]]]
    if len(pairs) < _FEWEST_PAIRS:
        return 0.0
    products = (errors[pairs[:, 0]] * errors[pairs[:, 1]]).sum(axis=1)
    typical = np.clip(products, *np.quantile(products, (0.005, 0.995)))
    return float(typical.mean() / max(typical.std(), 1e-300) * np.sqrt(len(pairs)))


def _own(fitted: Fitted) -> Array:
    scale = fitted.factored.equations.pose_scale
    return np.concatenate(
        [fitted.linear.frame_columns / scale[:, None], fitted.design.frame], axis=-1
    )


def _rows(fitted: Fitted, e: Array, r: Array, values: Array) -> Array:
    """Return what coefficients (E, k, C), (R, C) and fixed values (K, C) do to the rows."""
    eq = fitted.factored.equations
    pose = fitted.linear.frame_columns / eq.pose_scale[:, None]
    rows = moves_of(fitted.design, pose, *eq.sorted(e, r), eq.landmarks)
    return np.asarray(rows + fitted.linear.shared_columns @ (values / fitted.scale[:, None]))


def _products(fitted: Fitted, rows: Array) -> tuple[Array, Array, Array]:
    """Return the products (E, k, C), (R, C), (K, C) of all columns with rows (F, M, C)."""
    eq, random = fitted.factored.equations, fitted.design
    count = rows.shape[-1]
    flat = rows.reshape(-1, count)
    by_frame = np.swapaxes(_own(fitted), -1, -2) @ rows
    landmark = (random.offsets.T @ flat).reshape(-1, 3, count)[eq.landmarks]
    shared = random.shared.T @ flat
    x = flat_rows(fitted.linear.shared_columns / fitted.scale).T @ flat
    if eq.by_frame:
        return by_frame, np.concatenate([shared, landmark.reshape(-1, count)]), x
    return landmark, np.concatenate([by_frame.reshape(-1, count), shared]), x
