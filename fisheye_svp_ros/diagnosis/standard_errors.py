"""Standard errors of the parameters of effects."""

from __future__ import annotations

import numpy as np

from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.diagnosis.correlation import Correlation
from fisheye_svp_ros.diagnosis.model import (
    Linearised,
    gather,
    is_shared,
    landmark_groups,
    on_target,
    survey_of,
)
from fisheye_svp_ros.diagnosis.projection import (
    Nuisance,
    basis,
    block_basis,
    landmark_information,
)


def standard_errors(
    linear: Linearised, nuisance: Nuisance, correlation: Correlation
) -> list[Array]:
    """Return the standard errors of each effect's parameters, in the order of the terms.

    From the information matrix with poses (and free landmarks) projected out.  Where neighbours'
    residuals agree, sums over frames and over landmarks take the place of independent rows
    (two-way clusters), never below the independent figure.  NaN: not determined, or of the noise.
    """
    variance = nuisance.misfit / max(nuisance.freedom, 1)
    width = linear.shared_columns.shape[-1]
    columns = nuisance.outside_blocks(linear.shared_columns).reshape(linear.residual.size, width)
    scale = np.sqrt((linear.shared_columns**2).sum(axis=(0, 1)))
    columns = columns / np.maximum(scale, 1e-300)
    inverse, open_ = _inverse(columns.T @ columns)
    errors = np.sqrt(variance * np.diag(inverse))
    if correlation.dependent:
        errors = np.maximum(errors, _clustered(linear, nuisance, columns @ inverse))
    errors = np.where(open_, np.nan, errors / np.maximum(scale, 1e-300))
    result, at = [], width - _count(linear)
    for effect, values in linear.state.terms:
        if is_shared(effect):
            result.append(errors[at : at + len(values)])
            at += len(values)
        elif effect is survey_of(linear.state.terms):
            result.append(_survey_errors(linear, variance, len(values) // 3))
        else:
            result.append(np.full(len(values), np.nan))
    return result


def _inverse(gram: Array) -> tuple[Array, Mask]:
    """Return the pseudoinverse (P, P) and which parameters (P,) it leaves open."""
    values, vectors = np.linalg.eigh(gram)
    kept = values > 1e-14 * values.max(initial=0.0)
    inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
    return inverse, np.asarray((vectors[:, ~kept] ** 2).sum(axis=1) > 1e-6)


def _survey_errors(linear: Linearised, variance: float, landmarks: int) -> Array:
    """Return the standard errors (3 L,) of all landmarks, with their common motion held at zero.

    The free landmarks leave the place, and in part the size and shape, of the target open; the
    pseudoinverse settles that (free network adjustment).
    """
    rows, poses = linear.rows, block_basis(linear.frame_columns)
    shared = linear.shared_columns[..., ~on_target(linear)]
    outside = shared - poses @ (np.swapaxes(poses, -1, -2) @ shared)
    norms = np.sqrt((shared**2).sum(axis=(0, 1)))
    group = landmark_groups(rows.landmark, rows.survey >= 0)
    place = gather(linear.whitened(linear.linear.d_target), group)
    information = landmark_information(
        place, group, poses, basis(outside, norms).reshape(*poses.shape[:2], -1)
    )
    covariance = np.linalg.pinv(information, rcond=1e-9, hermitian=True)
    errors = np.full((landmarks, 3), np.nan)
    slot = rows.survey.ravel()[group[:, 0]]
    errors[slot] = np.sqrt(variance * np.maximum(np.diag(covariance), 0.0)).reshape(-1, 3)
    return errors.ravel()


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
