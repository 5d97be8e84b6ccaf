"""Rigs of any number of cameras: their poses in the first one, from what they saw together.

Cameras that see boards of their own are related by the motion of the rig.  Each board stands
still.  The poses A of one camera before its board and those B of another before its own, of the
same moments, are those of a robot: A = Y B X^-1, with the camera X in the other and the board Y in
the other's frame (`solve.hand_eye`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.errors import GeometryError, ObservationError
from fisheye_svp_ros.optics.lens import Lens, monotone_limit, parameter_values
from fisheye_svp_ros.pose import Pose, identity
from fisheye_svp_ros.scene.observations import (
    Observations,
    join_tables,
    select_cameras,
    select_shared,
)
from fisheye_svp_ros.solve.bundle_adjustment import Prior, adjust, rig_covariance
from fisheye_svp_ros.solve.hand_eye import MIN_FRAMES, Transforms, solve_hand_eye, turn_sizes
from fisheye_svp_ros.solve.initial_rig import initial_state, localize_frames
from fisheye_svp_ros.solve.least_squares import misfit_fails
from fisheye_svp_ros.solve.measured_poses import sigma_known
from fisheye_svp_ros.solve.outliers import FRAME, find_outliers
from fisheye_svp_ros.solve.reliability import misfit_reason
from fisheye_svp_ros.solve.rig_checks import contradicted_views, is_unrelated
from fisheye_svp_ros.solve.rig_state import (
    Linearization,
    RigState,
    RigViews,
    group_by_frame,
)

_MIN_TIED_FRAMES = 3  # of two cameras that see one board: any relative pose explains one frame
_MIN_TURN = np.radians(3.0)  # rms, about the second axis; poses of a view are off by less
_MAX_DISTANCE_RATIO = 5.0  # times the median: frames of other moments
_ROUNDS = 3


class PlacedBoards(NamedTuple):
    """A rig's rows with the boards in one frame, and where its bundle adjustment starts.

    boards: of each camera; empty where all cameras see one; poses (B,): of the boards in the
    frame of the first one.
    """

    rows: Observations
    data: RigViews
    state: RigState
    boards: tuple[int, ...] = ()
    poses: Pose | None = None

    def place(self, rows: Observations, last: int) -> Observations:
        """Return other rows of the cameras with their landmarks in the frame of the first board.

        last: the largest number of a landmark.
        """
        return rows if self.poses is None else _in_first_board(rows, self.boards, self.poses, last)


def place_boards(
    rows: Observations, lenses: Sequence[Lens], last: int | None = None
) -> PlacedBoards:
    """Return the rows with the boards of all cameras in the frame of the first camera's board.

    rows: of frames that several cameras share; last: the largest number of a landmark, None for
    that of these rows.  Cameras that no relative pose relates, as seeing
    one target, see boards of their own.
    Raises ObservationError where neither explains most frames.
    """
    last = int(rows.landmark.max()) if last is None else last
    data, state = _start_rig(rows, lenses)
    if not _contradicts(data, state):
        return PlacedBoards(rows, data, state)
    boards = _boards_of_cameras(rows, lenses)
    try:
        poses = _board_poses(rows, lenses, boards)
        placed = _in_first_board(rows, boards, poses, last)
        data, state = _start_rig(placed, lenses)
        if _contradicts(data, state):
            raise GeometryError('no motion of a rig explains these frames')
    except GeometryError as cause:
        raise ObservationError(
            f'{rows.source}: no relative pose of {" and ".join(rows.cameras)} explains most '
            'frames. Give simultaneous photographs the same frame number and others different '
            'ones. Number points from the same end. If the cameras see boards of their own, '
            f'{cause}'
        ) from cause
    return PlacedBoards(placed, data, state, boards, poses)


def _start_rig(rows: Observations, lenses: Sequence[Lens]) -> tuple[RigViews, RigState]:
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
    for first in range(len(lenses)):
        for second in range(first):
            pair = select_shared(select_cameras(rows, (rows.cameras[second], rows.cameras[first])))
            if len(pair.frames) >= _MIN_TIED_FRAMES and not is_unrelated(
                *_start_rig(pair, (lenses[second], lenses[first]))
            ):
                board[board == board[first]] = board[second]
    return tuple(np.unique(board, return_inverse=True)[1].tolist())


def _board_poses(rows: Observations, lenses: Sequence[Lens], boards: tuple[int, ...]) -> Pose:
    """Return the poses (B,) of the boards in the frame of the first; raise GeometryError."""
    views = []
    for board in range(max(boards) + 1):
        cameras_of_board = [camera for camera, its in enumerate(boards) if its == board]
        board_rows = select_cameras(rows, [rows.cameras[camera] for camera in cameras_of_board])
        _, state = _start_rig(board_rows, [lenses[camera] for camera in cameras_of_board])
        views.append(
            dict(
                zip(
                    board_rows.frames.tolist(),
                    map(state.pose.take, range(len(board_rows.frames))),
                    strict=True,
                )
            )
        )
    placed, left = identity(len(views)), set(range(1, len(views)))
    body = dict(views[0])
    while left:
        board = max(left, key=lambda one: len(body.keys() & views[one].keys()))
        left.remove(board)
        shared = sorted(body.keys() & views[board].keys())
        _check_motion([body[frame] for frame in shared])
        solution = _solve_robustly(
            Pose.stack([views[board][frame] for frame in shared]),
            Pose.stack([body[frame] for frame in shared]),
        )
        placed.put(board, solution.target)
        moved = solution.flange(Pose.stack(list(views[board].values())))
        for number, frame in enumerate(views[board]):
            body.setdefault(frame, moved.take(number))
    return placed


def _check_motion(poses: Sequence[Pose]) -> None:
    """Raise GeometryError where the motion of the rig does not relate its cameras."""
    if len(poses) < MIN_FRAMES:
        raise GeometryError(f'{len(poses)} frames show two of them; take {MIN_FRAMES} or more')
    sizes = turn_sizes(Pose.stack(poses)) / np.sqrt(len(poses))
    if sizes[1] < _MIN_TURN:
        motion = 'does not turn' if sizes[0] < _MIN_TURN else 'turns about one axis only'
        raise GeometryError(
            f'the rig {motion}; turn it about two axes or more, by 20 degrees or more'
        )


def _solve_robustly(camera: Pose, flange: Pose) -> Transforms:
    """Solve both transforms of poses (F,), without frames that contradict the others."""
    kept = np.ones(len(camera.position), dtype=bool)
    size = float(np.median(np.linalg.norm(camera.position, axis=1)))
    for _ in range(_ROUNDS):
        hand_eye = solve_hand_eye(camera.take(kept), flange.take(kept), 1.0)
        off = hand_eye.flange(camera).difference(flange) / np.repeat([size, 1.0], 3)
        distance = np.linalg.norm(off, axis=1)
        kept = np.asarray(distance <= _MAX_DISTANCE_RATIO * np.median(distance))
    return hand_eye


def _in_first_board(
    rows: Observations, boards: tuple[int, ...], placed: Pose, last: int
) -> Observations:
    """Return rows with their landmarks in the frame of the first board, numbered by board."""
    board = np.array(boards)[rows.camera]
    return replace(
        rows,
        board=board,
        xyz=placed.take(board).transform(rows.xyz),
        landmark=rows.landmark + board * (last + 1),
    )


class RigCalibration(NamedTuple):
    """A rig of C cameras: rig (C,) in the first of them, m.

    covariance (C - 1, 6, 6), m and rad, of the change in `Pose.retract`, of each camera but the
    first; frame (F,); pose (F,) of the first camera in its target; rms_px (C,), and over all:
    total_rms_px; sigma_px: noise of u and v, estimated, None where the observations bring their
    own; shared (C,): frames that a camera shares with others; left_out: frames that no rig
    explains; reason: why it should not be relied on, '' for a reliable one; lenses (C,): fitted
    with the rig; boards (C,): which board each camera sees, where these stand apart and only the
    motion of the rig relates them; empty where all see one.
    """

    cameras: tuple[str, ...]
    rig: Pose
    covariance: Array
    frame: Index
    pose: Pose
    rms_px: Array
    total_rms_px: float
    sigma_px: float | None
    shared: Index
    left_out: tuple[int, ...]
    reason: str
    lenses: tuple[Lens, ...]
    boards: tuple[int, ...] = ()

    def steps(self) -> tuple[Pose, ...]:
        """Return each camera in the next one (C - 1 poses), as rig files have them."""
        return tuple(
            self.rig.take(i + 1).inverse().compose(self.rig.take(i))
            for i in range(len(self.cameras) - 1)
        )


def connected_cameras(table: Observations) -> list[tuple[str, ...]]:
    """Return groups of cameras that frames hold together, each in an order in which they do.

    A camera in no group with others never saw the target in the same frame as they did.
    """
    seen = np.zeros((len(table.cameras), len(table.frames)), dtype=bool)
    seen[table.camera, np.searchsorted(table.frames, table.frame)] = True
    shared = seen.astype(int) @ seen.T.astype(int)
    left, groups = list(range(len(table.cameras))), []
    while left:
        group, frames = [left.pop(0)], shared[:, :]
        while near := [camera for camera in left if frames[camera, group].any()]:
            group.append(max(near, key=lambda camera: int(frames[camera, group].max())))
            left.remove(group[-1])
        groups.append(tuple(table.cameras[camera] for camera in group))
    return groups


class RigStart(NamedTuple):
    """A rig of C cameras fitted to the frames that several of them share, the lenses known.

    cameras: in the order in which frames hold them together, as data and state have them; wanted:
    in that in which they were asked for; torn: frames that no rig explains.
    """

    cameras: tuple[str, ...]
    wanted: tuple[str, ...]
    placed: PlacedBoards
    data: RigViews
    state: RigState
    torn: tuple[int, ...]

    def add_frames_of_one(self, table: Observations) -> tuple[RigViews, RigState]:
        """Return data and state with the frames that one camera alone shows, too.

        table: that of the start.
        """
        whole = select_cameras(table, self.cameras)
        alone = whole.take(~np.isin(whole.frame, select_shared(whole).frames))
        alone = self.placed.place(alone, int(whole.landmark.max()))
        data = group_by_frame(join_tables([self.data.observations, alone]))
        return data, localize_frames(data, self.state)

    def summarize(
        self, data: RigViews, state: RigState, covariance: Callable[[float], Array]
    ) -> RigCalibration:
        """Return the rig of a state that was fitted to these data, or more.

        covariance: returns that of the cameras but the first (C - 1, 6, 6), in the order of the
        state, for the noise of the shared frames.
        """
        several = (np.bincount(data.frame_of) > 1)[data.frame_of]
        frames = np.unique(data.frame_of[several])
        data, state = data.select(several), replace(state, pose=state.pose.take(frames))
        linear, place = Linearization(data, state, ()), self._places()
        squared, freedom = linear.sum_of_squares, _freedom(linear)
        sigma_stated = sigma_known(data.observations)
        fails = sigma_stated and bool(misfit_fails(np.array(squared), np.array(freedom)))
        sigma = None if sigma_stated else float(np.sqrt(squared / freedom))
        squares = (linear.residual_px**2).sum(axis=-1)
        return RigCalibration(
            tuple(self.cameras[i] for i in place),
            state.rig.take(place),
            covariance(sigma or 1.0)[[i - 1 for i in place[1:]]],
            data.frame_numbers,
            state.pose,
            np.array([np.sqrt(np.nanmean(squares[data.camera_of == i])) for i in place]),
            float(np.sqrt(np.nanmean(squares))),
            sigma,
            np.bincount(data.camera_of, minlength=len(self.cameras))[place],
            self.torn,
            misfit_reason(squared / freedom, freedom) if fails else '',
            tuple(
                replace(lens, max_incidence=min(lens.max_incidence, monotone_limit(lens)))
                for lens in (state.lenses[i] for i in place)
            ),  # as far as their curves still allow
            tuple(self.placed.boards[i] for i in place if self.placed.boards),
        )

    def _places(self) -> list[int]:
        # The first camera stays the first.
        return [self.cameras.index(name) for name in self.wanted if name in self.cameras]


def start_rig(table: Observations, lenses: Mapping[str, Lens], cameras: Sequence[str]) -> RigStart:
    """Fit the rig and the poses of its frames to what the cameras saw, the lenses known.

    Arguments and errors are those of `calibrate_rig`.
    """
    order = connected_cameras(select_cameras(table, cameras))[0]
    ordered = [lenses[name] for name in order]
    rows = select_cameras(table, order)
    placed = place_boards(select_shared(rows), ordered, int(rows.landmark.max()))
    rows, torn = _reject_outliers(placed)
    data, state = _fit_rig(rows, ordered, placed.boards)
    if _freedom(Linearization(data, state, ())) < 1:
        raise GeometryError(f'{rows.source}: too few points for a rig of {len(order)} cameras')
    return RigStart(order, tuple(cameras), placed, data, state, torn)


def calibrate_rig(
    table: Observations, lenses: Mapping[str, Lens], cameras: Sequence[str]
) -> RigCalibration:
    """Fit the rig and the poses of its frames to what the cameras saw, and their lenses.

    What a lens states of its errors is its prior; one that states none stays as it is.
    cameras: connected ones, in the order in which they are wanted; the first is the frame of all.
    Outliers are rejected, and frames in which the cameras contradict each other.
    Cameras that see boards of their own are related by the motion of the rig.
    Raises ObservationError where no rig explains most frames; GeometryError, naming the frame, for
    a view that does not fix a pose, and where the rig is not determined.
    """
    start = start_rig(table, lenses, cameras)
    data, state = start.data, start.state
    free, mean, information = _stated_errors(
        start.cameras, [lenses[name] for name in start.cameras]
    )
    if free:
        linear = Linearization(data, state, ())
        sigma_stated = sigma_known(data.observations)
        noise = 1.0 if sigma_stated else np.sqrt(linear.sum_of_squares / _freedom(linear))
        values, vectors = np.linalg.eigh(information)
        root = noise * np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
        state = adjust(data, state, free, Prior(mean, root))
    linear = Linearization(data, state, free)
    return start.summarize(data, state, lambda sigma: rig_covariance(linear, sigma, information))


def _freedom(linear: Linearization) -> int:
    """Return how many numbers are left beside poses, rig and boards."""
    unknown = 6 * (linear.data.frames + len(linear.state.rig.position) - 1)
    return int(linear.row_mask.sum()) - unknown


def _reject_outliers(placed: PlacedBoards) -> tuple[Observations, tuple[int, ...]]:
    """Return the rows without outliers, and the frames that no rig explains."""
    rows = placed.rows
    _, outliers = find_outliers(placed.data, placed.state)
    torn = {
        int(rows.frame[row])
        for row, why in zip(outliers.rows, outliers.why, strict=True)
        if why == FRAME
    }
    kept = ~np.isin(np.arange(len(rows)), outliers.rows) & ~np.isin(rows.frame, sorted(torn))
    return select_shared(rows.take(kept)), tuple(sorted(torn))


def _fit_rig(
    rows: Observations, lenses: Sequence[Lens], boards: tuple[int, ...]
) -> tuple[RigViews, RigState]:
    """Return rig, boards of the cameras' own and poses of the frames, fitted, the lenses known."""
    data, start = _start_rig(rows, lenses)
    rig = Pose.concatenate([start.rig, identity(max(boards, default=0))])
    state = replace(
        start,
        rig=rig,
        lens=lenses[0],
        others=tuple(lenses[1:]),
        terms=(),
        corrected=True,
        boards=boards,
    )
    return data, adjust(data, state, ())


def _stated_errors(
    cameras: Sequence[str], lenses: Sequence[Lens]
) -> tuple[list[str], Array, Array]:
    """Return what the lenses state of their errors: names, values (K,) and information (K, K)."""
    from scipy.linalg import block_diag  # not while --help waits

    free: list[str] = []
    mean: list[float] = []
    parts = [np.zeros((0, 0))]
    for name, lens in zip(cameras, lenses, strict=True):
        stated = lens.calibration or {}
        if 'covariance' in stated and 'stderr' in stated:
            free += [f'{name}.{parameter}' for parameter in stated['stderr']]
            mean += parameter_values(lens, list(stated['stderr']))
            parts.append(
                np.linalg.pinv(np.array(stated['covariance'], dtype=float), hermitian=True)
            )
    return free, np.array(mean), block_diag(*parts)
