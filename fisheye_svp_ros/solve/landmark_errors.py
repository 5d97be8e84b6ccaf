"""Landmarks that are known with errors: what those do to image points, and to a pose.

With errors of landmarks eliminated (Schur complement), the noise of image points is W + D C DT:
W of the points themselves, C the covariance of the landmarks, D what they move in the image.  Its
inverse weighs them (generalized least squares, the maximum-likelihood estimate).  A motion that
all landmarks share is one of the pose, too: its variance goes into the covariance of the pose and
leaves no residual.
"""

from __future__ import annotations

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Views
from fisheye_svp_ros.solve.least_squares import never_singular, with_unit_diagonal


def generalized_equations(
    uv: Array, jacobian: Array, views: Views
) -> tuple[Array, tuple[Array, Array]]:
    """Return cost (S,) and (H (S, 6, 6), g (S, 6)) of poses, errors of landmarks eliminated.

    uv (S, N, 2), px: predicted, jacobian (S, N, 2, 6): their derivatives by the pose, of views
    that have a landmark_covariance.
    """
    j, noise = whiten(jacobian, views)
    with np.errstate(invalid='ignore'):
        off = np.where(views.weight[..., None] > 0, (uv - views.uv) * views.weight[..., None], 0.0)
    r = off.reshape(*j.shape[:2], 1)
    outside = ~np.isfinite(r).all(axis=(1, 2))
    r[outside] = 0.0
    solved = np.linalg.solve(noise, np.concatenate([j, r], axis=-1))
    transposed = np.swapaxes(j, -1, -2)
    hessian, gradient = transposed @ solved[..., :-1], (transposed @ solved[..., -1:])[..., 0]
    hessian[outside], gradient[outside] = np.eye(hessian.shape[-1]), 0.0
    cost = (r * solved[..., -1:]).sum(axis=(1, 2))
    return np.where(outside, np.inf, cost), (hessian, gradient)


def with_own_errors(model: ForwardModel, views: Views, pose: Pose) -> Views:
    """Return views (S,) whose weights hold the errors of landmarks, as if these were independent.

    What all landmarks of a view share, as far as its pose (S,) takes it up, is none of them.
    """
    if views.landmark_covariance is None:
        return views
    j, noise = _whiten_at(model, views, pose)
    solved = np.asarray(np.linalg.solve(noise, j), dtype=float)
    transposed = np.swapaxes(j, -1, -2)
    relative, scale = with_unit_diagonal(transposed @ solved, 0.0)
    inverse = never_singular(np.linalg.inv, relative) / (scale[:, :, None] * scale[:, None, :])
    shared = j @ _pulled_noise(inverse, solved, noise) @ transposed
    variance = np.diagonal(noise - shared, axis1=-2, axis2=-1)
    variance = variance.reshape(*views.weight.shape, 2).mean(axis=-1)
    weight = views.weight / np.sqrt(np.maximum(variance, 1.0))
    return views._replace(weight=weight, landmark_covariance=None)


def covariance_by_landmarks(
    model: ForwardModel, views: Views, pose: Pose, covariance: Array
) -> Array:
    """Return the part (S, 6, 6) that landmarks have in the covariance (S, 6, 6) of poses (S,)."""
    j, noise = _whiten_at(model, views, pose)
    solved = np.asarray(np.linalg.solve(noise, j), dtype=float)
    return _pulled_noise(covariance, solved, noise)


def _pulled_noise(covariance: Array, solved: Array, noise: Array) -> Array:
    """Return the covariance of poses by noise that is correlated; solved: noise^-1 J."""
    pull = covariance @ np.swapaxes(solved, -1, -2)
    return np.asarray(pull @ (noise - np.eye(noise.shape[-1])) @ np.swapaxes(pull, -1, -2))


def _whiten_at(model: ForwardModel, views: Views, pose: Pose) -> tuple[Array, Array]:
    linear = model.linearize(pose, views)
    return whiten(model.d_pose(linear, views), views)


def whiten(jacobian: Array, views: Views) -> tuple[Array, Array]:
    """Return the Jacobian (S, 2N, 6) and the noise (S, 2N, 2N) in units of 1 / weight."""
    systems, points = views.weight.shape
    weight = views.weight[..., None, None]
    j = np.where((weight > 0) & np.isfinite(jacobian), jacobian * weight, 0.0)
    if views.landmark_covariance is None:
        noise = np.broadcast_to(np.eye(2 * points), (systems, 2 * points, 2 * points))
        return j.reshape(systems, 2 * points, -1), noise
    by_landmark = -j[..., :3]  # a point moves the image as the camera moves it the other way
    covariance = views.landmark_covariance.reshape(systems, points, 3, 3 * points)
    moved = (by_landmark @ covariance).reshape(systems, 2 * points, points, 3)
    noise = np.swapaxes(moved, 1, 2) @ np.swapaxes(by_landmark, -1, -2)  # (S, N, 2N, 2)
    noise = np.swapaxes(noise, 1, 2).reshape(systems, 2 * points, 2 * points)
    return j.reshape(systems, 2 * points, -1), noise + np.eye(2 * points)
