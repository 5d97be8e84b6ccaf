"""Standard errors of the parameters of effects."""

from __future__ import annotations

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.criticism.correlation import Correlation
from fisheye_svp_ros.criticism.model import Linearised, is_shared
from fisheye_svp_ros.criticism.projection import Nuisance


def standard_errors(
    linear: Linearised, nuisance: Nuisance, correlation: Correlation
) -> list[Array]:
    """Return the standard errors of each effect's parameters, in the order of the terms.

    From the information matrix with poses (and free landmarks) projected out.  Where neighbours'
    residuals agree, sums over frames and over landmarks take the place of independent rows
    (two-way clusters), never below the independent figure.
    """
    width = linear.shared_columns.shape[-1]
    columns = nuisance.outside_blocks(linear.shared_columns).reshape(linear.residual.size, width)
    scale = np.maximum(np.sqrt((linear.shared_columns**2).sum(axis=(0, 1))), 1e-300)
    columns = columns / scale
    variance = nuisance.misfit / max(nuisance.freedom, 1)
    inverse = np.linalg.pinv(columns.T @ columns, rcond=1e-14, hermitian=True)
    errors = np.sqrt(variance * np.diag(inverse))
    if correlation.dependent:
        errors = np.maximum(errors, _clustered(linear, nuisance, columns @ inverse))
    errors = errors / scale
    result, at = [], width - _count(linear)
    for effect, values in linear.state.terms:
        if is_shared(effect):
            result.append(errors[at : at + len(values)])
            at += len(values)
        else:
            result.append(np.full(len(values), np.nan))
    return result


def _clustered(linear: Linearised, nuisance: Nuisance, influence: Array) -> Array:
    moves = influence * nuisance.residual.ravel()[:, None]
    frames = nuisance.shape[0]
    by_frame = moves.reshape(*nuisance.shape, moves.shape[-1]).sum(axis=1)
    label = np.unique(linear.rows.landmark, return_inverse=True)[1].ravel()
    by_landmark = np.zeros((label.max() + 1, moves.shape[-1]))
    np.add.at(by_landmark, label, moves)
    squares = (by_frame**2).sum(axis=0) * frames / max(frames - 1, 1)
    both = squares + (by_landmark**2).sum(axis=0) - (moves**2).sum(axis=0)
    return np.asarray(np.sqrt(np.maximum(both, squares)))


def _count(linear: Linearised) -> int:
    return sum(len(values) for effect, values in linear.state.terms if is_shared(effect))
