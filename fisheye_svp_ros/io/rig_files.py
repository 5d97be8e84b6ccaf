"""Rig files: the pose of the left camera in the right one, YAML."""

from __future__ import annotations

from pathlib import Path

import yaml

from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.pose import Pose, quaternion_from_rotation


def save_rig(rig: Pose, path: str | Path) -> None:
    """Write the left camera in the right one: position, m, and quaternion x, y, z, w."""
    write_text(path, yaml.safe_dump({'left_in_right': {
        'position': rig.position.tolist(),
        'quaternion': quaternion_from_rotation(rig.rotation).tolist(),
    }}, sort_keys=False))
