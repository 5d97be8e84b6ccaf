"""Localization of one view by other packages: each returns the camera in the world."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from benchmark.speed.adjustment import fast_view, scipy_pose
from benchmark.speed.harness import NotHereError
from benchmark.speed.scenes import Scene
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import (
    Pose,
    quaternion_from_rotation,
    rotation_from_vector,
    vector_from_rotation,
)

TOLERANCE = 1e-10
# view number -> position (3,) and rotation (3, 3) of the camera in the world
Solve = Callable[[int], Pose]


def scipy(scene: Scene) -> Solve:
    """scipy.optimize.least_squares with the hand-written kernel."""
    views = [fast_view(scene.lens, scene.landmarks, uv) for uv in scene.views.uv]
    return lambda i: scipy_pose(views[i], scene.start.take(i), TOLERANCE)


def poselib(scene: Scene) -> Solve:
    """poselib.refine_absolute_pose."""
    import poselib

    camera = {**_size(scene.lens), 'model': 'OPENCV_FISHEYE', 'params': _opencv(scene.lens)}
    options = {'loss_type': 'TRIVIAL', 'gradient_tol': TOLERANCE, 'step_tol': TOLERANCE}
    starts = []
    for i in range(len(scene.views.uv)):
        inverse = scene.start.take(i).inverse()
        start = poselib.CameraPose()
        start.q = np.roll(quaternion_from_rotation(inverse.rotation), 1)
        start.t = inverse.position
        starts.append(start)

    def solve(i: int) -> Pose:
        pose, _ = poselib.refine_absolute_pose(
            scene.views.uv[i], scene.landmarks, starts[i], camera, options
        )
        return Pose(np.array(pose.R), np.array(pose.t)).inverse()

    return solve


def pycolmap(scene: Scene) -> Solve:
    """pycolmap.refine_absolute_pose; its robust loss is wide enough to be quadratic."""
    import pycolmap

    camera = pycolmap.Camera(
        **_size(scene.lens), model='OPENCV_FISHEYE', params=_opencv(scene.lens)
    )
    options = pycolmap.AbsolutePoseRefinementOptions()
    options.gradient_tolerance, options.loss_function_scale = TOLERANCE, 1e7
    every = np.ones(len(scene.landmarks), dtype=bool)
    inverse = scene.start.inverse()
    starts = [
        pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), position)
        for rotation, position in zip(*inverse, strict=True)
    ]

    def solve(i: int) -> Pose:
        found = pycolmap.refine_absolute_pose(
            starts[i], scene.views.uv[i], scene.landmarks, every, camera, options
        )
        matrix = found['cam_from_world'].matrix()
        return Pose(matrix[:, :3], matrix[:, 3]).inverse()

    return solve


def opencv(scene: Scene) -> Solve:
    """cv2.fisheye.solvePnP: least squares in the undistorted plane."""
    import cv2

    if not hasattr(cv2.fisheye, 'solvePnP'):
        raise NotHereError(f'OpenCV {cv2.__version__} has no cv2.fisheye.solvePnP')
    matrix, k = camera_matrix(scene.lens)
    inverse = scene.start.inverse()
    turns = vector_from_rotation(inverse.rotation)
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, TOLERANCE)

    def solve(i: int) -> Pose:
        _, turn, place = cv2.fisheye.solvePnP(
            scene.landmarks,
            scene.views.uv[i][:, None],
            matrix,
            k,
            turns[i].copy(),
            inverse.position[i].copy(),
            True,
            cv2.SOLVEPNP_ITERATIVE,
            criteria,
        )
        return Pose(rotation_from_vector(turn.ravel()), place.ravel()).inverse()

    return solve


def gtsam(scene: Scene) -> Solve:
    """Levenberg-Marquardt as GTSAM has it; one custom factor a view, with the kernel in C."""
    import gtsam

    views = [fast_view(scene.lens, scene.landmarks, uv) for uv in scene.views.uv]
    noise = gtsam.noiseModel.Unit.Create(2 * len(scene.landmarks))
    parameters = gtsam_parameters()

    def solve(i: int) -> Pose:
        def error(_: Any, values: Any, jacobians: Any) -> Array:
            pose = values.atPose3(0)
            rotation = pose.rotation().matrix()
            residuals, columns = views[i](rotation, pose.translation())
            if jacobians is not None:
                jacobians[0] = by_body(columns, rotation)
            return residuals

        graph = gtsam.NonlinearFactorGraph()
        graph.add(gtsam.CustomFactor(noise, [0], error))
        start = gtsam.Values()
        start.insert(0, gtsam_pose(scene.start.take(i)))
        found = gtsam.LevenbergMarquardtOptimizer(graph, start, parameters).optimize().atPose3(0)
        return Pose(found.rotation().matrix(), found.translation())

    return solve


def gtsam_parameters() -> Any:
    """Return parameters of GTSAM's optimizer with the common tolerance."""
    import gtsam

    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-14)
    parameters.setAbsoluteErrorTol(TOLERANCE)
    return parameters


def gtsam_pose(pose: Pose) -> Any:
    """Return gtsam.Pose3 of one pose."""
    import gtsam

    return gtsam.Pose3(gtsam.Rot3(pose.rotation), pose.position)


def by_body(columns: Array, rotation: Array) -> Array:
    """Turn derivatives (M, 6) by place and turn in the world into GTSAM's, in the body."""
    return np.asfortranarray(np.hstack([columns[:, 3:] @ rotation, columns[:, :3] @ rotation]))


def camera_matrix(lens: Lens) -> tuple[Array, Array]:
    """Return OpenCV's camera matrix (3, 3) and k1..k4 (4,) of a Kannala-Brandt lens."""
    matrix = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1.0]])
    return matrix, np.array(lens.image_height.coefficients)


def _opencv(lens: Lens) -> list[float]:
    return [lens.fx, lens.fy, lens.cx, lens.cy, *lens.image_height.coefficients]


def _size(lens: Lens) -> dict[str, int]:
    return {'width': lens.width, 'height': lens.height}


# name -> its module, and what prepares it
LOCALIZERS: dict[str, tuple[str, Callable[[Scene], Solve]]] = {
    'poselib': ('poselib', poselib),
    'pycolmap': ('pycolmap', pycolmap),
    'cv2.fisheye.solvePnP': ('cv2', opencv),
    'GTSAM': ('gtsam', gtsam),
    'SciPy': ('scipy', scipy),
}
