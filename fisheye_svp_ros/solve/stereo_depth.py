"""Epipolar curves and stereo depth of matched image points, through any lens with effects.

Points and rays are in the right camera's frame, as is the rig (left camera in the right one).
Any leading shape: left and right image points (..., 2) and rigs (...) broadcast together.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask, scatter
from fisheye_svp_ros.effects.forward import ForwardModel, LinearViews
from fisheye_svp_ros.pose import Pose, identity
from fisheye_svp_ros.scene.observations import Views, views_of
from fisheye_svp_ros.solve.least_squares import Arrays, dense_step, levenberg_marquardt
from fisheye_svp_ros.solve.localization import normal_equations

_FARTHEST, _NEAREST = 1e-6, 200.0  # 1/m: the ends of a ray, as inverse distances
_STARTS = np.concatenate([[_FARTHEST], np.geomspace(1e-2, 50.0, 48)])
_SAME_COLUMN = 1e-6  # px


class EpipolarOffset(NamedTuple):
    """How far left image points lie from their epipolar curves.

    distance (...), px: to the nearest point of the curve, `foot` (..., 2), px; vertical (...),
    px: v of the point minus v of the curve in the point's own column u; NaN where the curve, or
    the column on it, lies outside the field of view.
    """

    distance: Array
    vertical: Array
    foot: Array


class StereoPoints(NamedTuple):
    """Points (..., 3), m, halfway between two rays; gap (...): distance of the rays, m.

    NaN and valid (...) False where an image point has no ray or the rays do not meet ahead.
    """

    points: Array
    gap: Array
    valid: Mask


class OptimalPoints(NamedTuple):
    """Points (..., 3), m, of least reprojection error; covariance (..., 3, 3), m^2.

    left_residual, right_residual (..., 2), px: measured minus predicted.  NaN and valid (...)
    False where `StereoPoints` has no point or the iteration does not converge.
    """

    points: Array
    covariance: Array
    left_residual: Array
    right_residual: Array
    valid: Mask


def epipolar_curves(
    left: ForwardModel,
    right: ForwardModel,
    rig: Pose,
    uv_right: Array,
    count: int = 200,
    nearest: float = 0.05,
) -> Array:
    """Return the epipolar curves (..., count, 2), px, in the left image of right image points.

    Each runs from infinity to `nearest` m along the ray in even steps of inverse distance; NaN
    outside the field of view.  Kita, section 5.
    """
    pairs = _Pairs(rig, uv_right, uv_right)
    origin, direction = pairs.ray_in_left(right)
    inverse = np.maximum(np.linspace(0.0, 1 / nearest, count), _FARTHEST)
    points = origin[:, None] + direction[:, None] / inverse[:, None]
    return left.project(points).uv.reshape(*pairs.shape, count, 2)


def epipolar_offset(
    left: ForwardModel, right: ForwardModel, rig: Pose, uv_left: Array, uv_right: Array
) -> EpipolarOffset:
    """Return how far left image points are from the epipolar curves of the right ones.

    Kita's Error2 (section 5) is the mean of these; it reads as either of the two distances.
    """
    pairs = _Pairs(rig, uv_left, uv_right)
    origin, direction = pairs.ray_in_left(right)
    samples = origin[:, None] + direction[:, None] / _STARTS[:, None]
    seen = _linearize_points(left, samples.reshape(-1, 3)).uv.reshape(*samples.shape[:2], 2)
    off = np.nan_to_num(np.linalg.norm(seen - pairs.left[:, None], axis=-1), nan=np.inf)
    start = (_STARTS[np.argmin(off, axis=1)][:, None],)
    curve = _Curve(left, origin, direction, pairs.left, column_only=False)
    nearest = levenberg_marquardt(curve, start)
    foot = np.where(nearest.converged[:, None], curve.image(*nearest.state), np.nan)
    column = _Curve(left, origin, direction, pairs.left, column_only=True)
    same = levenberg_marquardt(column, nearest.state)
    off_v = pairs.left[:, 1] - column.image(*same.state)[:, 1]
    vertical = np.where(np.sqrt(same.cost) < _SAME_COLUMN, off_v, np.nan)
    distance = np.linalg.norm(pairs.left - foot, axis=-1)
    shape = pairs.shape
    return EpipolarOffset(
        distance.reshape(shape), vertical.reshape(shape), foot.reshape(*shape, 2)
    )


def triangulate(
    left: ForwardModel, right: ForwardModel, rig: Pose, uv_left: Array, uv_right: Array
) -> StereoPoints:
    """Return the points halfway between the rays of matched image points, where these are nearest.

    Source: Hartley and Sturm, Triangulation, CVIU 68(2), 1997, section 4.4 (midpoint).
    """
    pairs = _Pairs(rig, uv_left, uv_right)
    rays = left.back_project(pairs.left[None])
    first = pairs.rig.transform(rays.origin[0])
    along_first = (pairs.rig.rotation @ rays.direction[0][..., None])[..., 0]
    right_rays = right.back_project(pairs.right[None])
    second, along_second = right_rays.origin[0], right_rays.direction[0]
    normal = np.cross(along_first, along_second)
    between = second - first
    with np.errstate(divide='ignore', invalid='ignore'):
        size2 = (normal**2).sum(axis=-1)
        to_first = (np.cross(between, along_second) * normal).sum(axis=-1) / size2
        to_second = (np.cross(between, along_first) * normal).sum(axis=-1) / size2
        valid = (to_first > 0) & (to_second > 0)
        foot = first + to_first[:, None] * along_first
        two = second + to_second[:, None] * along_second
    points = np.where(valid[:, None], (foot + two) / 2, np.nan)
    gap = np.where(valid, np.linalg.norm(foot - two, axis=-1), np.nan)
    shape = pairs.shape
    return StereoPoints(points.reshape(*shape, 3), gap.reshape(shape), valid.reshape(shape))


def triangulate_optimally(
    left: ForwardModel,
    right: ForwardModel,
    rig: Pose,
    uv_left: Array,
    uv_right: Array,
    sigma: float = 1.0,
) -> OptimalPoints:
    """Return the points of least reprojection error in both images, from those of `triangulate`.

    sigma: noise of u and of v, px, which the covariance is for.
    """
    pairs = _Pairs(rig, uv_left, uv_right)
    start = triangulate(left, right, pairs.rig, pairs.left, pairs.right)
    valid = start.valid.copy()
    solved_pairs = pairs.take(valid)
    problem = _Depth(left, right, solved_pairs, sigma)
    solved = levenberg_marquardt(problem, (start.points[valid],))
    _, (hessian, _) = problem.linearize(solved.state, np.arange(len(solved.cost)))
    uv, _ = problem.image(solved.state[0], np.arange(len(solved.cost)))
    # Rays that are parallel to the last digit say nothing of the depth.
    fixed = solved.converged & np.isfinite(hessian).all(axis=(-2, -1))
    hessian = np.where(fixed[:, None, None], hessian, np.eye(3))
    fixed &= np.linalg.matrix_rank(hessian, hermitian=True) == 3
    hessian[~fixed] = np.eye(3)
    valid[valid] = fixed

    def place_valid(field: Array) -> Array:
        return scatter(valid.reshape(pairs.shape), field[fixed])

    return OptimalPoints(
        place_valid(solved.state[0]),
        place_valid(np.asarray(np.linalg.inv(hessian), dtype=float)),
        place_valid(solved_pairs.left - uv[:, 0]),
        place_valid(solved_pairs.right - uv[:, 1]),
        valid.reshape(pairs.shape),
    )


class _Pairs:
    """Matched image points and their rigs, flattened to M pairs from any leading shape."""

    def __init__(self, rig: Pose, uv_left: Array, uv_right: Array) -> None:
        self.shape = np.broadcast_shapes(uv_left.shape[:-1], uv_right.shape[:-1], rig.shape)
        self.left = np.broadcast_to(uv_left, (*self.shape, 2)).reshape(-1, 2)
        self.right = np.broadcast_to(uv_right, (*self.shape, 2)).reshape(-1, 2)
        self.rig = rig.broadcast_to(*self.shape).reshape(-1)

    def take(self, index: Index | Mask) -> _Pairs:
        """Return some of the M pairs."""
        return _Pairs(self.rig.take(index), self.left[index], self.right[index])

    def ray_in_left(self, right: ForwardModel) -> tuple[Array, Array]:
        """Return origin and direction (M, 3) of the right image points' rays in the left frame."""
        rays = right.back_project(self.right[None])
        right_in_left = self.rig.inverse()
        direction = (right_in_left.rotation @ rays.direction[0][..., None])[..., 0]
        return right_in_left.transform(rays.origin[0]), direction


class _Curve:
    """M searches along rays for the inverse distance seen nearest to an image point.

    The state is the inverse distance (M, 1), 1/m; see least_squares.LeastSquares.  column_only:
    the distance in u alone counts.
    """

    step = staticmethod(dense_step)

    def __init__(
        self, model: ForwardModel, origin: Array, direction: Array, uv: Array, column_only: bool
    ) -> None:
        self._model = model
        self._origin, self._direction = origin, direction
        self._views = views_of(np.zeros(3), uv[:, None])
        self._rows = [0] if column_only else [0, 1]

    def image(self, inverse: Array) -> Array:
        """Return the image points (M, 2) of all rays at inverse distances (M, 1)."""
        points = self._origin + self._direction / inverse
        return np.asarray(_linearize_points(self._model, points).uv[0])

    def linearize(self, state: Arrays, index: Index) -> tuple[Array, Arrays]:
        direction, inverse = self._direction[index], state[0]
        linear = _linearize_points(self._model, self._origin[index] + direction / inverse)
        views = self._views.take(index)
        uv, jacobian = views.uv.copy(), np.zeros((len(index), 1, 2, 1))
        slope = -(linear.d_target[0] @ direction[..., None])[..., 0] / inverse**2
        uv[:, 0, self._rows] = linear.uv[0][:, self._rows]
        jacobian[:, 0, self._rows, 0] = slope[:, self._rows]
        cost, (hessian, gradient) = normal_equations(uv, jacobian, views)
        # At its ends a curve can only be left inwards.
        outward = (inverse <= _FARTHEST) & (gradient > 0) | (inverse >= _NEAREST) & (gradient < 0)
        gradient[outward] = 0.0
        return cost, (hessian, gradient)

    def retract(self, state: Arrays, step: Arrays) -> Arrays:
        return (np.clip(state[0] + step[0], _FARTHEST, _NEAREST),)


class _Depth:
    """M points seen by both cameras, see least_squares.LeastSquares; the state: (M, 3)."""

    step = staticmethod(dense_step)

    def __init__(
        self, left: ForwardModel, right: ForwardModel, pairs: _Pairs, sigma: float
    ) -> None:
        self._models = left, right
        self._left_in_right = pairs.rig
        uv = np.stack([pairs.left, pairs.right], axis=1)
        self._views: Views = views_of(np.zeros(3), uv, np.full(uv.shape[:2], 1 / sigma))

    def image(self, points: Array, index: Index) -> tuple[Array, Array]:
        """Return image points (A, 2, 2), left and right, and their derivatives (A, 2, 2, 3)."""
        rig = self._left_in_right.take(index)
        left = _linearize_points(self._models[0], rig.into_body(points[:, None])[:, 0])
        right = _linearize_points(self._models[1], points)
        turned = left.d_target[0] @ np.swapaxes(rig.rotation, -1, -2)
        uv = np.stack([left.uv[0], right.uv[0]], axis=1)
        return uv, np.stack([turned, right.d_target[0]], axis=1)

    def linearize(self, state: Arrays, index: Index) -> tuple[Array, Arrays]:
        return normal_equations(*self.image(state[0], index), self._views.take(index))

    def retract(self, state: Arrays, step: Arrays) -> Arrays:
        return (state[0] + step[0],)


def _linearize_points(model: ForwardModel, points: Array) -> LinearViews:
    """Linearize image points of points (M, 3) in the camera's own frame, as one view."""
    views = views_of(points)
    linear = model.linearize(identity(1), views)
    return replace(linear, d_pose=model.d_pose(linear, views))
