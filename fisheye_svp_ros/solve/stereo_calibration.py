"""Stereo calibration: a rig and the poses of its views together, intrinsics known."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.optics import engines
from fisheye_svp_ros.pose import Pose, cross_matrix, identity
from fisheye_svp_ros.scene.observations import Views
from fisheye_svp_ros.solve.least_squares import (
    Arrays,
    Minimum,
    arrow_covariance,
    arrow_of_views,
    arrow_step,
    levenberg_marquardt,
)
from fisheye_svp_ros.solve.localization import (
    MIN_POINTS,
    nearly_localize,
    pose_equations,
    residuals,
)

_MEAN_ROUNDS = 6


class StereoCalibration(NamedTuple):
    """Minimum rigs of S systems with V views each.

    rig (S,): left camera in the right one; pose (S, V): right camera in the world; their
    covariances (S, 6, 6) and (S, V, 6, 6), m and rad, of the change in `Pose.retract`, NaN where
    not converged; left_residual, right_residual (S, V, N, 2), px, measured minus predicted, NaN
    for padding; cost (S,): whitened sum of squares; converged, iterations (S,).
    """

    rig: Pose
    rig_covariance: Array
    pose: Pose
    pose_covariance: Array
    left_residual: Array
    right_residual: Array
    cost: Array
    converged: Mask
    iterations: Index


def calibrate_stereo(
    left: ForwardModel,
    right: ForwardModel,
    left_views: Views,
    right_views: Views,
    systems: int = 1,
    start: tuple[Pose, Pose] | None = None,
) -> StereoCalibration:
    """Return the maximum-likelihood rig; no start value is needed.

    left_views, right_views: S * V views, system by system, of the same frames in the same order
    (`observations.stereo_views`); points may be missing in either camera.  start: poses (S, V) of
    the right camera and rigs (S,) that are nearly right, where they are known, to save the search.
    Kita, section 4, after OpenCV's stereoCalibrate: the rig is shared, each view has a pose of its
    own.
    Raises GeometryError, naming the frame, where a view has too few points in both cameras, and
    where no view of a system can be posed in both.
    """
    left, right = left.seeing(left_views), right.seeing(right_views)
    pose, rig = start or _starts(left, right, left_views, right_views, systems)
    solved = _solve_rigs((left, right), (left_views, right_views), (*pose, *rig))
    pose, rig = Pose(*solved.state[:2]), Pose(*solved.state[2:])
    of_poses, of_rig = arrow_covariance(solved.normal)
    lost = ~solved.converged
    shape = (*pose.shape, -1, 2)
    of_rig[lost] = of_poses[lost] = np.nan
    return StereoCalibration(
        rig,
        of_rig,
        pose,
        of_poses,
        residuals(left, _left_pose(pose, rig).reshape(-1), left_views).reshape(shape),
        residuals(right, pose.reshape(-1), right_views).reshape(shape),
        solved.cost,
        solved.converged,
        solved.iterations,
    )


def _solve_rigs(
    models: tuple[ForwardModel, ForwardModel], views: tuple[Views, Views], start: Arrays
) -> Minimum:
    left, right = models
    quick = None
    if left.is_lens_only and right.is_lens_only:
        quick = engines.adjust_rigs(
            (left.lens, right.lens), (views[0].solver_inputs, views[1].solver_inputs), start
        )
    if quick is None:
        return levenberg_marquardt(_Rigs(models, views, len(start[-1])), start)
    everyone = np.ones(len(start[-1]), dtype=bool)
    return Minimum(quick.state, quick.cost, everyone, quick.iterations, quick.normal)


class _Rigs:
    """S systems of one rig and V poses each, see least_squares.LeastSquares.

    The state is (rotation, position) of the right camera (S, V) and of the rig (S,).
    """

    step = staticmethod(arrow_step)

    def __init__(
        self, models: tuple[ForwardModel, ForwardModel], views: tuple[Views, Views], systems: int
    ) -> None:
        self._models = models
        self._views = views
        self._rows = np.arange(len(views[0].frame)).reshape(systems, -1)

    def linearize(self, state: Arrays, index: Index) -> tuple[Array, Arrays]:
        right, rig = Pose(*state[:2]), Pose(*state[2:])
        (left_cost, *left_normal), (cost, *normal) = (
            self._equations(side, pose, index)
            for side, pose in enumerate((_left_pose(right, rig), right))
        )
        change = _left_change(right, rig)
        transposed = np.swapaxes(change, -1, -2)
        hessian = transposed @ left_normal[0] @ change
        gradient = (transposed @ left_normal[1][..., None])[..., 0]
        hessian[..., :6, :6] += normal[0]
        gradient[..., :6] += normal[1]
        return arrow_of_views(left_cost + cost, hessian, gradient, block=6)

    def _equations(self, side: int, pose: Pose, index: Index) -> tuple[Array, Array, Array]:
        """Return costs (S, V), H (S, V, 6, 6) and g (S, V, 6) of one camera's poses (S, V)."""
        views, shape = self._views[side], pose.shape
        if len(index) < len(self._rows):
            views = views.take(self._rows[index].ravel())
        cost, (hessian, gradient) = pose_equations(self._models[side], pose.reshape(-1), views)
        return cost.reshape(shape), hessian.reshape(*shape, 6, 6), gradient.reshape(*shape, 6)

    def retract(self, state: Arrays, step: Arrays) -> Arrays:
        return (*Pose(*state[:2]).retract(step[0]), *Pose(*state[2:]).retract(step[1]))


def _left_pose(right: Pose, rig: Pose) -> Pose:
    """Return the left cameras (S, V) in the world from right ones (S, V) and rigs (S,)."""
    return right.compose(rig.take(np.s_[:, None]))


def _left_change(right: Pose, rig: Pose) -> Array:
    """Derivative (S, V, 6, 12) of the left camera's change by those of the right one and rig."""
    change = np.zeros((*right.shape, 6, 12))
    change[..., range(6), range(6)] = 1.0
    arm = (right.rotation @ rig.position[:, None, :, None])[..., 0]
    change[..., :3, 3:6] = -cross_matrix(arm)
    change[..., :3, 6:9] = change[..., 3:, 9:] = right.rotation
    return change


def _starts(
    left: ForwardModel, right: ForwardModel, left_views: Views, right_views: Views, systems: int
) -> tuple[Pose, Pose]:
    """Return poses (S, V) of the right camera and rigs (S,) from views localized one by one."""
    (left_pose, left_posed), (right_pose, right_posed) = _localize_sides(
        (left, right), (left_views, right_views)
    )
    lost = np.flatnonzero(~(left_posed | right_posed))
    if lost.size:
        raise GeometryError(
            f'frame {left_views.frame[lost[0]]} cannot be posed in either camera; each view needs '
            f'{MIN_POINTS} points that are not on one line'
        )
    posed = (left_posed & right_posed).reshape(systems, -1)
    if not posed.any(axis=1).all():
        raise GeometryError(
            f'no view can be posed in both cameras; one with {MIN_POINTS} points in each is needed'
        )
    rigs = right_pose.inverse().compose(left_pose)
    rig = _robust_mean(rigs.reshape(systems, -1), posed)
    from_left = left_pose.reshape(systems, -1).compose(rig.inverse().take(np.s_[:, None]))
    from_right = right_pose.reshape(systems, -1)
    return from_right.where(right_posed.reshape(systems, -1), from_left), rig


def _localize_sides(
    models: tuple[ForwardModel, ForwardModel], sides: tuple[Views, Views]
) -> list[tuple[Pose, Mask]]:
    """Nearly localize the views of both cameras, together where these have one lens."""
    left, right = models
    if left is not right and not (
        left.is_lens_only and right.is_lens_only and left.lens == right.lens
    ):
        return [_localize_posable(*side) for side in zip(models, sides, strict=True)]
    pose, posed = _localize_posable(left, Views.concatenate(sides))
    count = len(sides[0].frame)
    return [(pose.take(part), posed[part]) for part in (slice(count), slice(count, None))]


def _localize_posable(model: ForwardModel, views: Views) -> tuple[Pose, Mask]:
    """Nearly localize views (S,) that have enough points; return also which have a pose."""
    inside = model.back_project(views.uv).valid & (views.weight > 0)
    posed: Mask = inside.sum(axis=1) >= MIN_POINTS
    pose = identity(len(views.frame))
    if posed.any():
        near, determined = nearly_localize(model, views.take(posed))
        pose.put(posed, near)
        posed[posed] = determined
    return pose, posed


def _robust_mean(poses: Pose, known: Mask) -> Pose:
    """Return the geometric median (S,) of the known ones of poses (S, V) (Weiszfeld)."""
    first = np.arange(len(known)), np.argmax(known, axis=1)
    mean = poses.take(first)
    for _ in range(_MEAN_ROUNDS):
        off = poses.difference(mean.take(np.s_[:, None]))
        weight = np.where(known, 1 / (np.linalg.norm(off, axis=-1) + 1e-9), 0.0)
        mean = mean.retract(np.einsum('sv,svi->si', weight, off) / weight.sum(axis=1)[:, None])
    return mean
