"""Rig files: the pose of one camera in the other, YAML."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fisheye_svp_ros.io.documents import dump_yaml
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.pose import Pose, quaternion_from_rotation
from fisheye_svp_ros.scene.observations import STEREO


def save_rig(rig: Pose, path: str | Path, cameras: Sequence[str] = STEREO) -> None:
    """Write the first camera in the second: position, m, and quaternion x, y, z, w."""
    write_text(path, dump_yaml({'_in_'.join(cameras): {
        'position': rig.position.tolist(),
        'quaternion': quaternion_from_rotation(rig.rotation).tolist(),
    }}))
