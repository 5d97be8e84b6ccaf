"""Bundle adjustment of a lens: its parameters and the poses of its views, from start values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.optics.camera import lens_columns
from fisheye_svp_ros.optics.lens import INTRINSICS, Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Views
from fisheye_svp_ros.solve.arrow import (
    ArrowEquations,
    arrow_covariance,
    arrow_information,
    arrow_of_views,
    arrow_step,
)
from fisheye_svp_ros.solve.least_squares import Arrays, Solved, levenberg_marquardt
from fisheye_svp_ros.solve.localization import normal_equations

MAX_ITERATIONS = 200
_UNDETERMINED = 1e-13  # relative eigenvalue of the information; rounding leaves about 1e-15


class Adjusted(NamedTuple):
    """A lens and its V views after adjustment.

    covariance (K, K) of the parameters `names`; pose: camera in the target frame (V,), with
    pose_covariance (V, 6, 6) of the change in `Pose.retract`; both for noise of 1 / weight;
    residual (V, N, 2), px, measured minus predicted, NaN for padding; cost (V,): whitened sums of
    squares; converged.
    """

    lens: Lens
    names: tuple[str, ...]
    covariance: Array
    pose: Pose
    pose_covariance: Array
    residual: Array
    cost: Array
    converged: bool


def adjust(lens: Lens, views: Views, pose: Pose, names: Sequence[str]) -> Adjusted:
    """Adjust named lens parameters and the poses (V,) of the views together, from these starts.

    Raises GeometryError where a start lies outside the domain of the lens or the views do not
    determine the parameters.
    """
    start = np.array([parameter_values(lens, names)])
    solved = adjust_batch(lens, views, pose.take(None), start, names)
    if not np.isfinite(solved.cost[0]):
        raise GeometryError(
            f'lens {lens.name!r} cannot image all landmarks from the start poses; check that '
            'landmarks, image points and image size belong together'
        )
    rotation, position, values = (array[0] for array in solved.state)
    fitted, pose = lens.with_parameters(names, values.tolist()), Pose(rotation, position)
    predicted, cost, (hessian, gradient) = _linearised(fitted, views, pose, names)
    _, arrow = arrow_of_views(cost[None], hessian[None], gradient[None], block=6)
    _check_determined(arrow, names)
    covariance = arrow_covariance(arrow)
    residual = np.where(views.used[..., None], views.uv - predicted, np.nan)
    return Adjusted(
        fitted, tuple(names), covariance.shared[0], pose, covariance.blocks[0], residual, cost,
        bool(solved.converged[0]),
    )


def adjust_batch(
    lens: Lens, views: Views, pose: Pose, values: Array, names: Sequence[str],
    max_iterations: int = MAX_ITERATIONS,
) -> Solved:
    """Adjust from S starts at once: pose (S, V), values (S, K) of the named parameters.

    The state is (rotation, position, values); a start outside the lens's domain costs inf.
    """
    return levenberg_marquardt(_Adjustment(lens, views, names), (*pose, values), max_iterations)


def parameter_values(lens: Lens, names: Sequence[str]) -> list[float]:
    """Return the values of named parameters; `f` is that of fx."""
    return [lens.fx if name == 'f' else lens.parameters[name] for name in names]


class _Adjustment:
    """S adjustments to the same views, see least_squares.Problem."""

    step = staticmethod(arrow_step)

    def __init__(self, lens: Lens, views: Views, names: Sequence[str]) -> None:
        self._lens = lens
        self._views = views
        self._names = names

    def linearise(self, state: Arrays, index: Index) -> tuple[Array, Arrays]:
        systems = [self._system(Pose(r, p), values) for r, p, values in zip(*state, strict=True)]
        cost, hessian, gradient = (np.stack(part) for part in zip(*systems, strict=True))
        return arrow_of_views(cost, hessian, gradient, block=6)

    def retract(self, state: Arrays, step: Arrays) -> Arrays:
        rotation, position, values = state
        return (*Pose(rotation, position).retract(step[0]), values + step[1])

    def _system(self, pose: Pose, values: Array) -> tuple[Array, Array, Array]:
        """Return the cost (V,), H (V, 6 + K, 6 + K) and g (V, 6 + K) of one adjustment."""
        lens = self._lens.with_parameters(self._names, values.tolist())
        if lens.check():
            count, columns = len(pose.position), 6 + len(values)
            hessian = np.broadcast_to(np.eye(columns), (count, columns, columns))
            return np.full(count, np.inf), hessian, np.zeros((count, columns))
        _, cost, (hessian, gradient) = _linearised(lens, self._views, pose, self._names)
        return cost, hessian, gradient


def _linearised(
    lens: Lens, views: Views, pose: Pose, names: Sequence[str]
) -> tuple[Array, Array, Arrays]:
    """Return predictions (V, N, 2), costs (V,) and normal equations of poses and lens by view."""
    model = ForwardModel(lens)
    linear = model.linearise(pose, views)
    columns = lens_columns(lens, linear.image, names)
    # Corrections of the image plane go with its centre and focal lengths.
    inner = [name not in ('f', *INTRINSICS) for name in names]
    columns[..., inner] = model.through(linear, views, columns[..., inner])
    jacobian = np.concatenate([model.d_pose(linear, views), columns], axis=-1)
    return linear.uv, *normal_equations(linear.uv, jacobian, views)


def _check_determined(normal: Arrays, names: Sequence[str]) -> None:
    diagonal = np.diagonal(ArrowEquations(*normal).shared[0])
    scale = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    relative = arrow_information(normal)[0] / (scale[:, None] * scale)
    values, vectors = np.linalg.eigh(relative - np.diag(diagonal == 0))
    if len(names) and values[0] < _UNDETERMINED:
        name = names[int(np.argmax(np.abs(vectors[:, 0])))]
        raise GeometryError(
            f'{name} cannot be told from the poses in these views; fix it, or add views in which '
            'the target is tilted and covers the image'
        )
