"""Rig files: the pose of one camera in the other, YAML, and as other tools write it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.documents import dump_yaml
from fisheye_svp_ros.io.files import read_text, write_text
from fisheye_svp_ros.io.lens_files import LARGEST, read_lens_file
from fisheye_svp_ros.io.lens_formats import read_foreign
from fisheye_svp_ros.pose import Pose, quaternion_from_rotation
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
    foreign = read_foreign(path, read_text(path, LensError, LARGEST))
    if foreign is None:
        raise LensError(f'{path}: left_in_right with position and quaternion is needed')
    if not foreign.rigs:
        raise LensError(f'{path}: it holds one camera, or no transform between two')
    return foreign.rigs[0]


def rig_of_lenses(path: str | Path) -> Pose | None:
    """Return the rig that a file or folder of two lenses holds, None where it holds none.

    The first camera in the second one.  Raises LensError for a file that cannot be read.
    """
    if Path(path).is_dir():
        file = Path(path) / 'rig.yaml'
        return load_rig(file) if file.exists() else None
    foreign = read_lens_file(path)
    return foreign.rigs[0] if foreign and len(foreign.rigs) == 1 else None
