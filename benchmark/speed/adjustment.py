"""What SciPy and GTSAM know of a camera: residuals of one view and their derivatives."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import least_squares

from benchmark.speed.compiled import Kernel
from benchmark.speed.harness import NotHereError
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, cross_matrix
from fisheye_svp_ros.scene.observations import views_of

# rotation (3, 3) and position (3) of the camera -> residuals (2N) and derivatives (2N, 6)
View = Callable[[Array, Array], tuple[Array, Array]]


def exact_view(lens: Lens, points: Array, uv: Array) -> View:
    """Return the residuals of a view as the package's own reference has them."""
    model, views = ForwardModel(lens), views_of(points, uv[None])

    def residuals(rotation: Array, position: Array) -> tuple[Array, Array]:
        linear = model.linearize(Pose(rotation[None], position[None]), views)
        return (linear.uv[0] - uv).ravel(), linear.d_pose[0].reshape(-1, 6)

    return residuals


def fast_view(lens: Lens, points: Array, uv: Array) -> View:
    """Return the residuals of a view through the hand-written kernel, if there is a compiler."""
    try:
        kernel = Kernel(lens)
    except NotHereError:
        return exact_view(lens, points, uv)
    points = np.ascontiguousarray(points)

    def residuals(rotation: Array, position: Array) -> tuple[Array, Array]:
        predicted, jacobian = kernel.linearize(points, rotation, position)
        return (predicted - uv).ravel(), jacobian.reshape(-1, 6)

    return residuals


def turn_derivative(turn: Array) -> Array:
    """Return the derivative (3, 3) of a small turn by its rotation vector (left Jacobian)."""
    angle = np.linalg.norm(turn)
    if angle < 1e-8:
        return np.eye(3) + cross_matrix(turn) / 2
    k = cross_matrix(turn) / angle
    derivative: Array = (
        np.eye(3) + (1 - np.cos(angle)) / angle * k + (1 - np.sin(angle) / angle) * (k @ k)
    )
    return derivative


def moved(pose: Pose, change: Array) -> tuple[Pose, Array]:
    """Return a pose changed by (6,), and the derivative (6, 6) of its further change by that."""
    derivative = np.eye(6)
    derivative[3:, 3:] = turn_derivative(change[3:])
    return pose.retract(change), derivative


def minimize(
    residuals: Callable[[Array], Array],
    jacobian: Callable[[Array], Array],
    size: int,
    tolerance: float,
    exact: bool = False,
) -> Array:
    """Return the solution (size,) of scipy.optimize.least_squares (MINPACK's lm) from 0.

    exact: with a last Gauss-Newton step, because comparing sums of squares, as SciPy does, cannot
    tell poses less than some 1e-10 m apart.
    """
    x: Array = least_squares(
        residuals,
        np.zeros(size),
        jacobian,
        method='lm',
        xtol=tolerance,
        ftol=tolerance,
        gtol=tolerance,
    ).x
    return x - np.linalg.lstsq(jacobian(x), residuals(x), rcond=None)[0] if exact else x


def scipy_pose(view: View, start: Pose, tolerance: float, exact: bool = False) -> Pose:
    """Return one pose by `minimize`."""

    def residuals(x: Array) -> Array:
        return view(*start.retract(x))[0]

    def jacobian(x: Array) -> Array:
        pose, derivative = moved(start, x)
        columns: Array = view(*pose)[1] @ derivative
        return columns

    return start.retract(minimize(residuals, jacobian, 6, tolerance, exact))
