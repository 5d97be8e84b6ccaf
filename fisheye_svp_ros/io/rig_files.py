"""Rig files: the pose of one camera in the other, YAML, and as other tools write it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.files import dump_yaml, read_text, write_text
from fisheye_svp_ros.io.lens_files import (
    FILES_OF_RIG,
    MAX_LENS_BYTES,
    cameras_in,
    read_lens_file,
)
from fisheye_svp_ros.io.lens_formats import Foreign, fields, read_foreign
from fisheye_svp_ros.io.lens_formats.rig import SEPARATOR, cameras_of, pose_keys
from fisheye_svp_ros.io.paths import path_of
from fisheye_svp_ros.pose import Pose, identity, quaternion_from_rotation
from fisheye_svp_ros.scene.observations import STEREO


def save_rig(
    rig: Pose | Sequence[Pose], path: str | Path, cameras: Sequence[str] = STEREO
) -> None:
    """Write each camera in the next one: position, m, and quaternion x, y, z, w.

    rig: the first camera in the second, or so many as there are cameras after the first.
    """
    steps = [rig] if isinstance(rig, Pose) else rig
    write_text(
        path,
        dump_yaml(
            {
                key: {
                    'position': step.position.tolist(),
                    'quaternion': quaternion_from_rotation(step.rotation).tolist(),
                }
                for key, step in zip(pose_keys(cameras), steps, strict=True)
            }
        ),
    )


def check_camera_names(cameras: Sequence[str], chain: Sequence[str], where: str) -> None:
    """Raise LensError for cameras, or a chain of some of them, that rig files cannot hold."""
    if taken := [name for name in cameras if name in FILES_OF_RIG]:
        raise LensError(
            f'{where}: camera {taken[0]!r} has the name of a file of the rig, '
            f'{taken[0]}.yaml; rename the camera, for example {taken[0]}0'
        )
    if len(chain) > 1 and cameras_of(pose_keys(chain)) != tuple(chain):
        named = ', '.join(name for name in chain if SEPARATOR in name)
        raise LensError(
            f'{where}: camera {named}: with {SEPARATOR} in its name, rig.yaml does '
            'not say which camera is in which; rename it'
        )


def load_rigs(path: str | Path) -> tuple[Pose, ...]:
    """Return each camera in the next one, of a file or folder that `load_rig` reads."""
    return _read_rig(path).rigs


def cameras_in_first(steps: Sequence[Pose]) -> Pose:
    """Return the cameras (C,) of a rig in its first one, of each camera in the next one."""
    poses = [identity()]
    for step in steps:
        poses.append(poses[-1].compose(step.inverse()))
    return Pose.stack(poses)


def load_cameras(path: str | Path) -> tuple[tuple[str, ...], Pose]:
    """Return the cameras of a rig by name, and where they stand in the first one (C,).

    path: of a rig file, or of a file or folder that holds lenses and rig.
    Raises LensError where there is none.
    """
    names, steps = _read_chain(path)
    return names, cameras_in_first(steps)


def load_rig(path: str | Path) -> Pose:
    """Return the first (left) camera in the second one, of a rig file or what another tool wrote.

    Kalibr's camchain, Basalt, OpenCV's R and T, URDF, what `ros2 topic echo /tf_static` prints; of
    a folder its rig.yaml, or R and P of its two camera_info files.
    Raises LensError, naming file and field, where there is none.
    """
    return load_rigs(path)[0]


def load_pair(path: str | Path, cameras: Sequence[str]) -> Pose:
    """Return the first of two cameras in the second one, of a file or folder as `load_cameras`.

    By name or, of a rig of two that are called otherwise, by order.
    Raises LensError for a rig of more cameras that are called otherwise.
    """
    names, steps = _read_chain(path)
    if len(names) == 2 and tuple(cameras) != names[::-1]:
        return steps[0]
    if unknown := [name for name in cameras if name not in names]:
        raise LensError(
            f'{path}: a rig of {", ".join(names)}, without {unknown[0]}; give the '
            'lenses of two of these, by their names'
        )
    places = cameras_in_first(steps)
    first, second = (places.take(names.index(name)) for name in cameras)
    return second.inverse().compose(first)


def pair_of_lenses(path: str | Path, cameras: Sequence[str]) -> Pose | None:
    """Return what `load_pair` does, of a file or folder of lenses; None where it holds no rig."""
    return load_pair(path, cameras) if rigs_of_lenses(path) else None


def pair_of_camera_infos(paths: Sequence[str | Path]) -> Pose | None:
    """Return the first of two cameras in the second one, of R and P of their camera_info.

    R turns points of a camera to the rectified frame, and P = K (I | t) shifts them there.
    None for other files, and for cameras that were calibrated by themselves.
    """
    foreign = [read_lens_file(path) for path in paths]
    sides = [file.rectified for file in foreign if file is not None and file.rectified is not None]
    if len(sides) != 2 or len(paths) != 2 or not all(np.linalg.det(p[:, :3]) for _, p in sides):
        return None
    left, right = (
        # The frame of both rectified images in the camera
        turned.compose(Pose(np.eye(3), np.linalg.solve(p[:, :3], p[:, 3])))
        for turned, p in (
            (fields.pose(np.zeros(3), turn.T, f'{path}: R'), p)
            for path, (turn, p) in zip(paths, sides, strict=True)
        )
    )
    rig = right.compose(left.inverse())
    return rig if rig.position.any() else None


def rigs_of_lenses(path: str | Path) -> tuple[Pose, ...]:
    """Return each camera in the next one, as a file or folder of lenses holds them, if it does."""
    if Path(path).is_dir():
        held = _read_rig(path) if _rig_path(path).exists() else _pair_in_folder(path)
        return held.rigs if held else ()
    foreign = read_lens_file(path)
    return foreign.rigs if foreign else ()


def _rig_path(path: str | Path) -> Path:
    location = path_of(path)
    return location / 'rig.yaml' if location.is_dir() else location


def _read_chain(path: str | Path) -> tuple[tuple[str, ...], tuple[Pose, ...]]:
    held = _read_rig(path)
    names = held.cameras or tuple(held.lenses) or STEREO
    if len(names) != len(held.rigs) + 1:
        raise LensError(
            f'{path}: {len(names)} cameras, and {len(held.rigs)} transforms between '
            'them; each camera in the next one is needed'
        )
    return names, held.rigs


def _pair_in_folder(folder: str | Path) -> Foreign | None:
    """Return the rig of a folder that holds two camera_info files, None of another."""
    names = cameras_in(folder)
    rig = pair_of_camera_infos([f'{folder}#{name}' for name in names])
    return rig and Foreign('ROS', {}, (rig,), {}, names)


def _read_rig(path: str | Path) -> Foreign:
    file = _rig_path(path)
    if path_of(path).is_dir() and not file.exists() and (pair := _pair_in_folder(path)):
        return pair
    foreign = read_foreign(file, read_text(file, LensError, MAX_LENS_BYTES))
    if foreign is None:
        raise LensError(f'{file}: left_in_right with position and quaternion is needed')
    if not foreign.rigs:
        remedy = '; give the folder with both camera_info files' if foreign.rectified else ''
        raise LensError(f'{file}: it holds one camera, or no transform between two{remedy}')
    return foreign
