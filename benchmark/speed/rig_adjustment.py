"""Stereo calibration by other packages: each returns the left camera in the right one."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from benchmark.speed.adjustment import View, exact_view, fast_view, minimize, moved
from benchmark.speed.harness import NotHereError
from benchmark.speed.peers import (
    TOLERANCE,
    by_body,
    camera_matrix,
    gtsam_parameters,
    gtsam_pose,
)
from benchmark.speed.scenes import StereoScene
from benchmark.speed.worker import worker
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.pose import Pose, cross_matrix, rotation_from_vector, vector_from_rotation

# mrcal's wheel, or what belongs to the system's own Python: Debian's and Ubuntu's python3-mrcal.
_PYTHONS = (sys.executable, '/usr/bin/python3')
_WORKER = Path(__file__).with_name('mrcal_worker.py')


def scipy_rig(scene: StereoScene, tolerance: float, exact: bool = False) -> Pose:
    """Return the rig by `minimize`, dense; exact: as the package's own reference projects."""
    make = exact_view if exact else fast_view
    left, right = (
        [make(scene.lens, scene.board, uv) for uv in views.uv]
        for views in (scene.left, scene.right)
    )

    def residuals(x: Array) -> Array:
        return _residuals(scene, left, right, x.reshape(-1, 6))[0]

    def jacobian(x: Array) -> Array:
        return _residuals(scene, left, right, x.reshape(-1, 6))[1]

    x = minimize(residuals, jacobian, 6 * (len(left) + 1), tolerance, exact)
    return scene.rig.retract(x[-6:])


def gtsam_rig(scene: StereoScene) -> Pose:
    """Return the rig by GTSAM: two custom factors a view, with the hand-written kernel."""
    import gtsam

    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Unit.Create(2 * len(scene.board))
    last = len(scene.left.uv)
    start.insert(last, gtsam_pose(scene.rig))
    for i in range(last):
        start.insert(i, gtsam_pose(scene.pose.take(i)))
        for keys, views in (([i], scene.right), ([i, last], scene.left)):
            view = fast_view(scene.lens, scene.board, views.uv[i])
            graph.add(gtsam.CustomFactor(noise, keys, _factor(view, keys)))
    found = gtsam.LevenbergMarquardtOptimizer(graph, start, gtsam_parameters()).optimize()
    rig = found.atPose3(last)
    return Pose(rig.rotation().matrix(), rig.translation())


def opencv_rig(scene: StereoScene) -> Pose:
    """Return the rig by cv2.fisheye.stereoCalibrate with fixed intrinsics; it starts by itself."""
    import cv2

    matrix, k = camera_matrix(scene.lens)
    fixed = getattr(cv2, 'CALIB_FIX_INTRINSIC', None) or cv2.fisheye.CALIB_FIX_INTRINSIC
    board = [scene.board[:, None]] * len(scene.left.uv)
    seen = [[uv[:, None] for uv in views.uv] for views in (scene.left, scene.right)]
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, TOLERANCE)
    found = cv2.fisheye.stereoCalibrate(
        board,
        *seen,
        matrix.copy(),
        k.copy(),
        matrix.copy(),
        k.copy(),
        (scene.lens.width, scene.lens.height),
        flags=fixed,
        criteria=criteria,
    )
    return Pose(found[5], found[6].ravel())


@contextmanager
def mrcal_rig(scene: StereoScene) -> Iterator[Callable[[], dict[str, Any]]]:
    """Yield a function that runs mrcal.optimize once, in a process of its own.

    It returns {seconds, rig: rotation vector and place (6,) of the right camera in the left one}.
    Raises NotHereError where there is no mrcal, and where it ends by itself.
    """
    python = _python_with_mrcal()
    lens = scene.lens
    with tempfile.TemporaryDirectory() as folder:
        problem = Path(folder) / 'problem.npz'
        np.savez(
            problem,
            intrinsics=[lens.fx, lens.fy, lens.cx, lens.cy],
            grid=scene.grid,
            size=[lens.width, lens.height],
            spacing=scene.spacing,
            left=scene.left.uv,
            right=scene.right.uv,
            frames=_rt(scene.pose.inverse()),
            extrinsics=_rt(scene.rig.inverse())[None],
        )
        with worker([python, '-E', str(_WORKER), str(problem)]) as run:
            yield run


def _python_with_mrcal() -> str:
    for python in _PYTHONS:
        with suppress(OSError):
            if not subprocess.run(
                [python, '-E', '-c', 'import mrcal'], capture_output=True, check=False
            ).returncode:
                return python
    raise NotHereError('no mrcal; `pip install mrcal` or `apt install python3-mrcal`')


def mrcal_pose(answer: dict[str, Any]) -> Pose:
    """Return the left camera in the right one from what mrcal answered."""
    rt = np.array(answer['rig'])
    return Pose(rotation_from_vector(rt[:3]), rt[3:]).inverse()


def _residuals(
    scene: StereoScene, left: list[View], right: list[View], changes: Array
) -> tuple[Array, Array]:
    rig, by_rig = moved(scene.rig, changes[-1])
    rows = 2 * len(scene.board)
    values = np.empty((len(left), 2, rows))
    columns = np.zeros((len(left), 2, rows, len(changes), 6))
    for i in range(len(left)):
        pose, by_change = moved(scene.pose.take(i), changes[i])
        values[i, 0], own = right[i](*pose)
        columns[i, 0, :, i] = own @ by_change
        values[i, 1], own = left[i](*pose.compose(rig))
        by_pose = np.eye(6)
        by_pose[:3, 3:] = -cross_matrix(pose.rotation @ rig.position)
        columns[i, 1, :, i] = own @ by_pose @ by_change
        columns[i, 1, :, -1] = own @ np.kron(np.eye(2), pose.rotation) @ by_rig
    return values.ravel(), columns.reshape(-1, changes.size)


def _factor(view: View, keys: list[int]) -> Callable[[Any, Any, Any], Array]:
    def error(_: Any, values: Any, jacobians: Any) -> Array:
        pose = values.atPose3(keys[0])
        rig = values.atPose3(keys[1]) if len(keys) > 1 else None
        camera = pose if rig is None else pose.compose(rig)
        rotation = camera.rotation().matrix()
        residuals, columns = view(rotation, camera.translation())
        if jacobians is not None:
            own = by_body(columns, rotation)
            jacobians[0] = own if rig is None else own @ rig.inverse().AdjointMap()
            if rig is not None:
                jacobians[1] = own
        return residuals

    return error


def _rt(pose: Pose) -> Array:
    return np.concatenate([vector_from_rotation(pose.rotation), pose.position], axis=-1)
