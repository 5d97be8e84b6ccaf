"""Rigs calibrated by multical and by pycolmap: run by benchmark.peers.rigs in a venv of these.

Reads problems, a path of an .npz file a line: uv (C, F, N, 2), px, NaN unseen; board (N, 3), m;
size (2,), px; lenses (C, 8): fx, fy, cx, cy, k1 to k4; body (F, 4, 4), rig (C, 4, 4): a start, the
first camera in the target and the cameras in the first one.  Writes a line of JSON for each: by
peer the cameras in the first one, (C, 4, 4), and its processor time, s, or why there is none.
"""

from __future__ import annotations

import importlib.util
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np


def by_pycolmap(problem: dict[str, Any]) -> Any:
    """Return the rig (C, 4, 4) of COLMAP's bundle adjustment, OPENCV_FISHEYE, points known."""
    import pycolmap

    scene, uv = pycolmap.Reconstruction(), problem['uv']
    rig = pycolmap.Rig(rig_id=1)
    for i, lens in enumerate(problem['lenses'], 1):
        camera = pycolmap.Camera(
            camera_id=i,
            model='OPENCV_FISHEYE',
            params=lens,
            width=problem['size'][0],
            height=problem['size'][1],
        )
        scene.add_camera(camera)
        if i == 1:
            rig.add_ref_sensor(camera.sensor_id)
        else:
            rig.add_sensor(camera.sensor_id, rigid(np.linalg.inv(problem['rig'][i - 1])))
    scene.add_rig(rig)
    points = [scene.add_point3D(xyz, pycolmap.Track()) for xyz in problem['board']]
    config = pycolmap.BundleAdjustmentConfig()
    for number, body in enumerate(problem['body'], 1):
        frame = pycolmap.Frame(frame_id=number, rig_id=1)
        seen = [i for i in range(len(uv)) if np.isfinite(uv[i, number - 1]).all()]
        images = [(number * len(uv) + i, i) for i in seen]
        for image, i in images:
            frame.add_data_id(pycolmap.data_t(scene.camera(i + 1).sensor_id, image))
        frame.rig_from_world = rigid(np.linalg.inv(body))
        scene.add_frame(frame)
        for image, i in images:
            shown = pycolmap.Image(str(image), uv[i, number - 1], i + 1, image)
            shown.frame_id = number
            scene.add_image(shown)
        scene.register_frame(number)
        for image, _ in images:
            config.add_image(image)
            for i, point in enumerate(points):
                scene.add_observation(point, pycolmap.TrackElement(image, i))
    for point in points:
        config.add_constant_point(point)
    options = pycolmap.BundleAdjustmentOptions(refine_principal_point=True, print_summary=False)
    options.ceres.solver_options.num_threads = 1
    pycolmap.create_default_bundle_adjuster(options, config, scene).solve()
    found = [np.eye(4)]
    for i in range(2, len(uv) + 1):
        found.append(
            np.linalg.inv(square(scene.rig(1).sensor_from_rig(scene.camera(i).sensor_id).matrix()))
        )
    return np.array(found)


def rigid(matrix: Any) -> Any:
    """Return a pose (4, 4) as pycolmap has it."""
    import pycolmap

    return pycolmap.Rigid3d(matrix[:3])


def square(matrix: Any) -> Any:
    """Return (3, 4) as (4, 4)."""
    return np.concatenate([matrix, [[0.0, 0.0, 0.0, 1.0]]])


def by_multical(problem: dict[str, Any]) -> Any:
    """Return the rig (C, 4, 4) of multical's own start and bundle adjustment, lenses too."""
    load_multical()
    from multical.optimization.calibration import Calibration, select_threshold  # isort: skip
    from multical import tables
    from multical.camera_fisheye import CameraFisheye
    from multical.motion.static_frames import StaticFrames
    from multical.optimization.parameters import ParamList
    from multical.optimization.pose_set import PoseSet
    from structs.numpy import Table

    uv = problem['uv']
    cameras = []
    for fx, fy, cx, cy, *k in problem['lenses']:
        cameras.append(
            CameraFisheye(
                tuple(problem['size'].tolist()),
                np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]),
                np.array(k).reshape(4, 1),
            )
        )
    valid = np.isfinite(uv).all(axis=-1)[:, :, None]
    points = Table.create(points=np.nan_to_num(uv)[:, :, None], valid=valid)
    board = known_board(problem['board'])
    pose_table = tables.make_pose_table(points, [board], cameras, True, 1.0)
    start = tables.initialize_poses(pose_table)
    names = [str(i) for i in range(len(uv))]
    calibration = Calibration(
        ParamList(cameras, names),
        ParamList([board], ['board']),
        points,
        PoseSet(start.camera, names),
        PoseSet(start.board, ['board']),
        StaticFrames.init(start.times, [str(i) for i in range(uv.shape[1])]),
    )
    calibration = calibration.enable(cameras=True, boards=False).adjust_outliers(
        num_adjustments=3, select_outliers=select_threshold(0.75, 5.0)
    )
    poses = calibration.with_master(0).camera_poses.poses
    return np.linalg.inv(poses)


def load_multical() -> None:
    """Import multical without its command, which Python from 3.11 on refuses to load."""
    np.bool = bool  # type: ignore[misc,assignment,unused-ignore]  # which NumPy had at its time
    if 'multical' not in sys.modules:
        spec = importlib.util.find_spec('multical')
        if spec is None or spec.origin is None:
            raise ImportError('multical is not installed')
        package = ModuleType('multical')
        package.__path__ = [str(Path(spec.origin).parent)]
        sys.modules['multical'] = package


def known_board(points: Any) -> Any:
    """Return a board as multical asks of it: of points in place of a printed pattern."""
    from multical.board.common import estimate_pose_points

    board = SimpleNamespace(
        points=points,
        adjusted_points=points,
        num_points=len(points),
        param_vec=points.ravel(),
        has_min_detections=lambda found: len(found.ids) > 8,
    )
    board.estimate_pose_points = lambda camera, found: estimate_pose_points(board, camera, found)
    return board


PEERS: dict[str, Callable[[dict[str, Any]], Any]] = {
    'multical': by_multical,
    'pycolmap': by_pycolmap,
}


def main() -> None:
    """Answer one problem a line."""
    out = os.fdopen(os.dup(1), 'w')
    os.dup2(2, 1)  # what the peers print is no answer
    for line in sys.stdin:
        with np.load(line.strip()) as file:
            problem = dict(file)
        answers = {}
        for name, solve in PEERS.items():
            start = time.process_time()
            try:
                rig = np.asarray(solve(problem)).tolist()
                answers[name] = {'rig': rig, 'seconds': time.process_time() - start}
            except Exception as cause:  # whatever a peer fails with is its answer
                answers[name] = {'why': f'{type(cause).__name__}: {cause}'}
        print(json.dumps(answers), file=out, flush=True)


if __name__ == '__main__':
    main()
