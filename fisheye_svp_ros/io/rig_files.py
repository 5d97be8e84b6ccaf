"""Rig files: the pose of one camera in the other, YAML, and as other tools write it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.documents import dump_yaml, parse_yaml
from fisheye_svp_ros.io.files import read_text, write_text
from fisheye_svp_ros.io.lens_files import LARGEST
from fisheye_svp_ros.io.lens_formats import radial, read_foreign
from fisheye_svp_ros.pose import Pose, quaternion_from_rotation, rotation_from_quaternion
from fisheye_svp_ros.scene.observations import STEREO


def save_rig(rig: Pose, path: str | Path, cameras: Sequence[str] = STEREO) -> None:
    """Write the first camera in the second: position, m, and quaternion x, y, z, w."""
    write_text(path, dump_yaml({'_in_'.join(cameras): {
        'position': rig.position.tolist(),
        'quaternion': quaternion_from_rotation(rig.rotation).tolist(),
    }}))


def load_rig(path: str | Path) -> Pose:
    """Return the first (left) camera in the second one, of a rig file or what another tool wrote.

    Kalibr's camchain, Basalt, OpenCV's R and T, URDF, what `ros2 topic echo /tf_static` prints.
    Raises LensError, naming file and field, where there is none.
    """
    text = read_text(path, LensError, LARGEST)
    foreign = read_foreign(path, text)
    if foreign is not None:
        if not foreign.rigs:
            raise LensError(f'{path}: it holds one camera, or no transform between two')
        return foreign.rigs[0]
    document = parse_yaml(text, path, LensError)
    name = next((name for name in map(str, document) if '_in_' in name), '')
    if not name:
        raise LensError(f'{path}: left_in_right with position and quaternion is needed')
    entry = radial.section(document, name, str(path))
    where = f'{path}: {name}'
    place = radial.numbers(entry, 'position', 3, where)
    turn = radial.numbers(entry, 'quaternion', 4, where)
    if not np.linalg.norm(turn) > 0.5:
        raise LensError(f'{where}: quaternion is {turn}; one of unit length is needed')
    return Pose(rotation_from_quaternion(turn), np.array(place))
