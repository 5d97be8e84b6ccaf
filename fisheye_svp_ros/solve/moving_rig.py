"""Rigs whose cameras see boards of their own: the motion of the rig relates them.

Each board stands still.  The poses A of one camera before its board and those B of another before
its own, of the same moments, are those of a robot: A = Y B X^-1, with the camera X in the other
and the board Y in the other's frame (`solve.hand_eye`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.errors import GeometryError, ObservationError
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, identity
from fisheye_svp_ros.scene.observations import Observations, select_cameras, select_shared
from fisheye_svp_ros.solve.hand_eye import MIN_FRAMES, Transforms, solve_hand_eye
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.rig_checks import contradicted_views, is_unrelated
from fisheye_svp_ros.solve.rig_state import RigState, RigViews, group_by_frame

_MIN_TIED_FRAMES = 3  # of two cameras that see one board: any relative pose explains one frame
_MIN_TURN = np.radians(3.0)  # rms, about the second axis; poses of a view are off by less
_MAX_DISTANCE_RATIO = 5.0  # times the median: frames of other moments
_ROUNDS = 3


class PlacedBoards(NamedTuple):
    """A rig's rows with the boards in one frame, and where its bundle adjustment starts.

    boards: of each camera; empty where all cameras see one.
    """

    rows: Observations
    data: RigViews
    state: RigState
    boards: tuple[int, ...]


def place_boards(rows: Observations, lenses: Sequence[Lens]) -> PlacedBoards:
    """Return the rows with the boards of all cameras in the frame of the first camera's board.

    rows: of frames that several cameras share.  Cameras that no relative pose relates, as seeing
    one target, see boards of their own.
    Raises ObservationError where neither explains most frames.
    """
    data, state = _start(rows, lenses)
    if not _contradicts(data, state):
        return PlacedBoards(rows, data, state, ())
    boards = _boards_of_cameras(rows, lenses)
    try:
        placed = _in_first_board(rows, boards, _board_poses(rows, lenses, boards))
        data, state = _start(placed, lenses)
        if _contradicts(data, state):
            raise GeometryError('no motion of a rig explains these frames')
    except GeometryError as cause:
        raise ObservationError(
            f'{rows.source}: no relative pose of {" and ".join(rows.cameras)} explains most '
            'frames; give simultaneous photographs the same frame number, others different ones, '
            'and number points from the same end; if the cameras see boards of their own, '
            f'{cause}') from cause
    return PlacedBoards(placed, data, state, boards)


def _start(rows: Observations, lenses: Sequence[Lens]) -> tuple[RigViews, RigState]:
    data = group_by_frame(rows)
    return data, initial_state(data, lenses[0], lenses[1:])


def _contradicts(data: RigViews, state: RigState) -> bool:
    """Whether a rig does not explain most shared views, of all cameras or of one."""
    several, contradicted = contradicted_views(data, state)
    shared, apart = (np.bincount(data.camera_of, mask) for mask in (several, contradicted))
    return bool(apart.any() and (2 * apart.sum() >= shared.sum() or (2 * apart > shared).any()))


def _boards_of_cameras(rows: Observations, lenses: Sequence[Lens]) -> tuple[int, ...]:
    """Return the board of each camera, the same for cameras that a relative pose relates."""
    board = np.arange(len(lenses))
    for one in range(len(lenses)):
        for other in range(one):
            pair = select_shared(
                select_cameras(rows, (rows.cameras[other], rows.cameras[one])))
            if len(pair.frames) >= _MIN_TIED_FRAMES and not is_unrelated(
                    *_start(pair, (lenses[other], lenses[one]))):
                board[board == board[one]] = board[other]
    return tuple(np.unique(board, return_inverse=True)[1].tolist())


def _board_poses(
    rows: Observations, lenses: Sequence[Lens], boards: tuple[int, ...]
) -> Pose:
    """Return the poses (B,) of the boards in the frame of the first; raise GeometryError."""
    views = []
    for board in range(max(boards) + 1):
        mine = [camera for camera, its in enumerate(boards) if its == board]
        own = select_cameras(rows, [rows.cameras[camera] for camera in mine])
        _, state = _start(own, [lenses[camera] for camera in mine])
        views.append(dict(zip(own.frames.tolist(), map(state.pose.take, range(len(own.frames))),
                              strict=True)))
    placed, left = identity(len(views)), set(range(1, len(views)))
    body = dict(views[0])
    while left:
        board = max(left, key=lambda one: len(body.keys() & views[one].keys()))
        left.remove(board)
        shared = sorted(body.keys() & views[board].keys())
        _check_motion([body[frame] for frame in shared])
        found = _solve_robustly(Pose.stack([views[board][frame] for frame in shared]),
                                Pose.stack([body[frame] for frame in shared]))
        placed.put(board, found.target)
        moved = found.flange(Pose.stack(list(views[board].values())))
        for number, frame in enumerate(views[board]):
            body.setdefault(frame, moved.take(number))
    return placed


def _check_motion(poses: Sequence[Pose]) -> None:
    """Raise GeometryError where the motion of the rig does not relate its cameras."""
    if len(poses) < MIN_FRAMES:
        raise GeometryError(f'{len(poses)} frames show two of them; take {MIN_FRAMES} or more')
    turns = Pose.stack(list(poses)).difference(poses[0].broadcast_to(len(poses)))[:, 3:]
    sizes = np.linalg.svd(turns, compute_uv=False) / np.sqrt(len(poses))
    if sizes[1] < _MIN_TURN:
        motion = 'does not turn' if sizes[0] < _MIN_TURN else 'turns about one axis only'
        raise GeometryError(f'the rig {motion}; turn it about two axes or more, by 20 degrees or '
                            'more')


def _solve_robustly(camera: Pose, flange: Pose) -> Transforms:
    """Solve both transforms of poses (F,), without frames that contradict the others."""
    kept = np.ones(len(camera.position), dtype=bool)
    size = float(np.median(np.linalg.norm(camera.position, axis=1)))
    for _ in range(_ROUNDS):
        found = solve_hand_eye(camera.take(kept), flange.take(kept), 1.0)
        off = found.flange(camera).difference(flange) / np.repeat([size, 1.0], 3)
        distance = np.linalg.norm(off, axis=1)
        kept = np.asarray(distance <= _MAX_DISTANCE_RATIO * np.median(distance))
    return found


def _in_first_board(
    rows: Observations, boards: tuple[int, ...], placed: Pose
) -> Observations:
    """Return rows with their landmarks in the frame of the first board, numbered by board."""
    board = np.array(boards)[rows.camera]
    return replace(rows, board=board, xyz=placed.take(board).transform(rows.xyz),
                   landmark=rows.landmark + board * (int(rows.landmark.max()) + 1))
