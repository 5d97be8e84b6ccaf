"""Poses as CSV: frame,x,y,z,qx,qy,qz,qw, the camera in the world (or target) frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fisheye_svp_ros.arrays import Index
from fisheye_svp_ros.io.csv_table import CsvTable, write_table
from fisheye_svp_ros.io.files import path_of
from fisheye_svp_ros.pose import Pose, quaternion_from_rotation, rotation_from_quaternion

COLUMNS = ('frame', 'x', 'y', 'z', 'qx', 'qy', 'qz', 'qw')
_NORM_SLACK = 1e-3  # printed digits are forgiven, another convention is not


class FramePoses(NamedTuple):
    """Frames (F,), ascending, and the camera's poses (F,) in them."""

    frame: Index
    pose: Pose

    def by_frame(self) -> dict[int, Pose]:
        """Return the pose of each frame."""
        return {number: self.pose.take(i) for i, number in enumerate(self.frame.tolist())}


def read_poses(path: str | Path) -> FramePoses:
    """Read poses: m and unit quaternions.

    Raises ObservationError, naming file, line and column.
    """
    table = CsvTable(path_of(path), COLUMNS)
    frame = table.integers('frame')
    table.refuse_repeats(frame[:, None], 'frame')
    quaternion = table.numbers('qx', 'qy', 'qz', 'qw')
    norm = np.linalg.norm(quaternion, axis=-1)
    table.refuse(np.abs(norm - 1) > _NORM_SLACK, 'qw', 'a quaternion of norm 1')
    order = np.argsort(frame)
    pose = Pose(rotation_from_quaternion(quaternion), table.numbers('x', 'y', 'z'))
    return FramePoses(frame[order], pose.take(order))


def write_poses(path: str | Path, frame: Index, pose: Pose) -> None:
    """Write frames (F,) and poses (F,).  Raises OutputError where the file cannot be written."""
    write_table(path, pose_columns(frame, pose))


def pose_columns(frame: Index, pose: Pose) -> dict[str, NDArray[Any]]:
    """Return frames (F,) and poses (F,) as COLUMNS."""
    numbers = np.concatenate([pose.position, quaternion_from_rotation(pose.rotation)], axis=-1)
    return dict(zip(COLUMNS, (frame, *numbers.T), strict=True))
