"""Observations and poses as CSV.

Observations: frame,landmark,u,v,x,y,z and, optional, camera,board,t,sigma; poses:
frame,x,y,z,qx,qy,qz,qw, the camera in the world (or target) frame.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.errors import ObservationError, ParameterError
from fisheye_svp_ros.io.csv_table import CsvTable, write_table
from fisheye_svp_ros.io.files import path_of
from fisheye_svp_ros.pose import Pose, quaternion_from_rotation, rotation_from_quaternion
from fisheye_svp_ros.scene.landmarks import MOST_LANDMARK
from fisheye_svp_ros.scene.observations import Observations, make_observations

_MIN_UNSEEN_ROWS = 5

REQUIRED_COLUMNS = ('frame', 'landmark', 'u', 'v', 'x', 'y', 'z')
COLUMNS = ('frame', 'x', 'y', 'z', 'qx', 'qy', 'qz', 'qw')
_NORM_SLACK = 1e-3  # printed digits are forgiven, another convention is not


def read(path: str | Path) -> Observations:
    """Read a table of observations; columns in any order, further columns ignored.

    Raises ObservationError, naming file, line and column.
    """
    table = CsvTable(Path(path), REQUIRED_COLUMNS)
    frame, landmark = table.integers('frame'), table.integers('landmark', MOST_LANDMARK)
    names = table.text('camera') if 'camera' in table else ('',) * len(frame)
    cameras = tuple(dict.fromkeys(names))
    # Results of a camera go to a folder of its name, in that of all.
    table.refuse([name.startswith('/') or '..' in name.split('/') for name in names], 'camera',
                 'a name without .. that does not begin with /')
    if len(cameras) > 1:
        named = next(filter(None, cameras))
        table.refuse([not name for name in names], 'camera', f'a name, as {named!r} elsewhere,')
    camera = np.array([cameras.index(name) for name in names], dtype=np.int64)
    table.refuse_repeats(
        np.stack([frame, camera, landmark], axis=-1), 'frame, camera and landmark'
    )
    uv = table.numbers('u', 'v')
    _refuse_unseen(table, np.stack([frame, camera], axis=-1), uv)
    sigma = table.numbers('sigma')[:, 0] if 'sigma' in table else None
    if sigma is not None:
        table.refuse(sigma <= 0, 'sigma', 'a number above 0')
    return make_observations(
        frame,
        landmark,
        uv,
        table.numbers('x', 'y', 'z'),
        camera=camera,
        board=table.integers('board') if 'board' in table else None,
        t=table.numbers('t')[:, 0] if 't' in table else None,
        sigma=sigma,
        cameras=cameras,
        source=str(path),
    )


def _refuse_unseen(table: CsvTable, view: Index, uv: Array) -> None:
    """Refuse what stands for points that were not seen, -1 -1 say; view (N, 2), uv (N, 2), px.

    It is one place of the image for several landmarks of a view, and for one row of a hundred.
    """
    place, where, count = np.unique(uv, axis=0, return_inverse=True, return_counts=True)
    most = int(count.argmax())
    rows = np.flatnonzero(where.reshape(-1) == most)
    if len(rows) < max(_MIN_UNSEEN_ROWS, len(uv) / 100):
        return
    if np.unique(view[rows], axis=0, return_counts=True)[1].max() > 2:
        u, v = place[most]
        raise ObservationError(
            f'{table.path}, line {table.line(rows[0])}: u, v are {u:g}, {v:g} here and in '
            f'{len(rows) - 1} more rows; leave out the rows of points that were not seen'
        )


def write_observations(path: str | Path, observations: Observations) -> None:
    """Write observations so that `read` gives the same table; optional columns where known.

    Raises ObservationError where t or sigma is known for some rows only, OutputError where the
    file cannot be written.
    """
    if not isinstance(observations, Observations):
        raise ParameterError(f'observations are of type {type(observations).__name__}; a table is '
                             'needed, after the path')
    table = observations
    columns: dict[str, NDArray[Any]] = {
        'frame': table.frame, 'landmark': table.landmark, 'u': table.uv[:, 0], 'v': table.uv[:, 1],
        'x': table.xyz[:, 0], 'y': table.xyz[:, 1], 'z': table.xyz[:, 2],
    }
    if table.cameras != ('',):
        columns['camera'] = np.array(table.cameras)[table.camera]
    if table.board.any():
        columns['board'] = table.board
    for name, values in (('t', table.t), ('sigma', table.sigma)):
        known = np.isfinite(values)
        if known.any() and not known.all():
            raise ObservationError(f'{table.source}: {name} is known for some rows only')
        if known.any():
            columns[name] = values
    write_table(path, columns)


class FramePoses(NamedTuple):
    """Frames (F,), ascending, and the camera's poses (F,) in them."""

    frame: Index
    pose: Pose

    def by_frame(self) -> dict[int, Pose]:
        """Return the pose of each frame."""
        return {number: self.pose.take(i) for i, number in enumerate(self.frame.tolist())}


def read_poses(path: str | Path) -> FramePoses:
    """Read poses: m, unit quaternions; raise ObservationError, naming file, line and column."""
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
