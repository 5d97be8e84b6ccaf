"""Landmarks, and the table of measured or simulated image points of them, and its batch form.

Landmarks are known 3-D points with ids, in the paper's world frame.  Frames are called by the
photographs that they were read from, else by number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import PurePath
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fisheye_svp_ros.arrays import Array, Batch, Index, Mask
from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.scene.pose_priors import PlanarPrior

if TYPE_CHECKING:
    from pandas import DataFrame

SPREADS = ('whole', 'inner', 'outer')
RADII = (2.0, 0.5, 0.2)
MOST_LANDMARK = 2**32 - 1  # the largest id, as messages hold it


@dataclass(frozen=True)
class Landmarks:
    """ids (N,), unique; points (N, 3), m, in the world (or target) frame."""

    ids: Index
    points: Array

    def lookup(self, ids: Index) -> tuple[Array, Mask]:
        """Return the points (..., 3) of `ids` (...), and which of them are known."""
        slot = np.searchsorted(self.ids, ids, sorter=self._order)
        place = self._order[np.minimum(slot, len(self.ids) - 1)]
        is_listed = np.asarray(self.ids[place] == ids)
        points = self.points.take(place, axis=0)
        points[~is_listed] = np.nan
        return points, is_listed

    @cached_property
    def _order(self) -> Index:
        return np.argsort(self.ids)


def check_landmarks(landmarks: Landmarks, where: str) -> Landmarks:
    """Return the landmarks; raise ObservationError for none, a repeated id or a bad point."""
    if not len(landmarks.ids):
        raise ObservationError(f'{where}: no landmark in it; at least one is needed')
    values, counts = np.unique(landmarks.ids, return_counts=True)
    if np.any(counts > 1):
        raise ObservationError(f'{where}: landmark {values[counts > 1][0]} is listed twice')
    bad = ~np.isfinite(landmarks.points).all(axis=-1)
    if np.any(bad):
        raise ObservationError(
            f'{where}: landmark {landmarks.ids[bad][0]} has a coordinate '
            'that is not a finite number'
        )
    return landmarks


@dataclass(frozen=True, eq=False)
class Observations:
    """One row an image point; every array has N rows, in the order of the source.

    frame, landmark, board: whole numbers; camera: index into `cameras`; uv (N, 2), px;
    xyz (N, 3): the landmark as the user believes it to be, m, in the target frame;
    t: s and sigma: px, NaN where unknown; source names where the rows came from; photographs:
    frame, camera and path of the image file of a view, as far as they are known.
    """

    frame: Index
    landmark: Index
    uv: Array
    xyz: Array
    camera: Index
    board: Index
    t: Array
    sigma: Array
    cameras: tuple[str, ...] = ('',)
    source: str = 'observations'
    photographs: tuple[tuple[int, str, str], ...] = ()

    def __len__(self) -> int:
        return len(self.frame)

    def __repr__(self) -> str:
        cameras = f', cameras {", ".join(self.cameras)}' if self.cameras != ('',) else ''
        return (
            f'Observations({len(self)} points in {len(self.frames)} frames{cameras}, '
            f'of {self.source})'
        )

    def take(self, index: Index | Mask) -> Observations:
        """Return some of the rows."""
        rows = {
            f.name: getattr(self, f.name)[index] for f in fields(self) if f.name not in _HEADER
        }
        return replace(self, **rows)

    def to_dataframe(self) -> DataFrame:
        """Return the rows as a pandas.DataFrame, by the names of the CSV that it can become.

        Without the columns that have no value in any row.  Raises ObservationError where pandas is
        not installed.
        """
        try:
            from pandas import DataFrame
        except ImportError as cause:
            raise ObservationError('to_dataframe needs pandas; pip install pandas') from cause
        names = np.array(self.cameras, dtype=object)
        columns = {
            'frame': self.frame,
            'camera': names[self.camera],
            'landmark': self.landmark,
            **dict(zip('uv', self.uv.T, strict=True)),
            **dict(zip('xyz', self.xyz.T, strict=True)),
            'board': self.board,
            't': self.t,
            'sigma': self.sigma,
        }
        empty = {
            'camera': not any(self.cameras),
            't': np.isnan(self.t).all(),
            'sigma': np.isnan(self.sigma).all(),
        }
        return DataFrame({name: values for name, values in columns.items() if not empty.get(name)})

    @property
    def frames(self) -> Index:
        """The frame numbers, ascending, each once."""
        return np.unique(self.frame)

    def landmarks(self) -> Landmarks:
        """Return each landmark once; raise ObservationError where rows disagree on its place."""
        ids, first, inverse = np.unique(self.landmark, return_index=True, return_inverse=True)
        off = np.abs(self.xyz - self.xyz[first][inverse]).max(axis=-1) > 1e-9
        if np.any(off):
            raise ObservationError(
                f'{self.source}: landmark {self.landmark[off][0]} has two positions; x, y, z '
                'belong to one target frame that does not move'
            )
        return Landmarks(ids, self.xyz[first])


STEREO = ('left', 'right')
_MAX_CAMERA_NAME = 100  # bytes; of files that are named after cameras, file systems allow 255
CAMERA_NAME = f'a printable name of at most {_MAX_CAMERA_NAME} bytes, without / and not .name,'
_MAX_LISTED = 10  # frames in a sentence
_HEADER = ('cameras', 'source', 'photographs')


def is_camera_name(name: str) -> bool:
    """Whether files of results, and lines of a terminal, can hold the name of a camera."""
    return (
        name.isprintable()
        and not {'/', '\\'} & {*name}
        and not name.startswith('.')
        and len(name.encode()) <= _MAX_CAMERA_NAME
    )


def make_observations(
    frame: Index,
    landmark: Index,
    uv: Array,
    xyz: Array,
    *,
    camera: Index | None = None,
    board: Index | None = None,
    t: Array | None = None,
    sigma: Array | None = None,
    cameras: tuple[str, ...] = ('',),
    source: str = 'observations',
) -> Observations:
    """Build a table from its columns, with the optional ones filled in.

    Raises ObservationError for names of cameras that no file can have.
    """
    if bad := [name for name in cameras if not is_camera_name(name)]:
        raise ObservationError(f'{source}: camera is {bad[0]!r:.80}; {CAMERA_NAME} is needed')
    count = len(frame)
    zeros = np.zeros(count, dtype=np.int64)
    unknown = np.full(count, np.nan)
    return Observations(
        np.asarray(frame, dtype=np.int64),
        np.asarray(landmark, dtype=np.int64),
        np.asarray(uv, dtype=float).reshape(count, 2),
        np.asarray(xyz, dtype=float).reshape(count, 3),
        zeros if camera is None else np.asarray(camera, dtype=np.int64),
        zeros if board is None else np.asarray(board, dtype=np.int64),
        unknown if t is None else np.asarray(t, dtype=float),
        unknown if sigma is None else np.asarray(sigma, dtype=float),
        cameras,
        source,
    )


class _Views(NamedTuple):
    points: Array
    uv: Array
    weight: Array
    landmark: Index
    board: Index
    t: Array
    frame: Index
    camera: Index
    row: Index
    landmark_covariance: Array | None = None
    prior: PlanarPrior | None = None


class Views(_Views, Batch):
    """Observations in batch form: S views (one frame of one camera) of up to N points.

    points (S, N, 3), m; uv (S, N, 2), px; weight (S, N): 1 / sigma, 0 for padding; landmark,
    board (S, N); t (S, N), s; frame, camera (S,); row (S, N): row of the table, -1 for padding;
    landmark_covariance (S, N, 3, N, 3), m^2: of the points, None where they are exact; prior (S,):
    of the poses, None where nothing is known of them.
    """

    __slots__ = ()

    @property
    def solver_inputs(self) -> tuple[Array, Array, Array]:
        """What solvers look at: points, image points, weights."""
        return self.points, self.uv, self.weight

    @property
    def used(self) -> Mask:
        """Which entries (S, N) are observations and not padding."""
        return self.row >= 0

    def take_points(self, at: Index) -> Views:
        """Return the same views with some of their N points."""
        covariance = self.landmark_covariance
        if covariance is not None:
            covariance = covariance[:, at][:, :, :, at]
        return self._replace(
            points=self.points[:, at],
            uv=self.uv[:, at],
            weight=self.weight[:, at],
            landmark=self.landmark[:, at],
            board=self.board[:, at],
            t=self.t[:, at],
            row=self.row[:, at],
            landmark_covariance=covariance,
        )


def group_views(observations: Observations) -> Views:
    """Group a table by frame and camera, unknown sigma 1 px; raise ObservationError for none."""
    if not len(observations):
        raise ObservationError(f'{observations.source}: it holds no observation')
    keys = np.stack([observations.frame, observations.camera], axis=-1)
    groups, view, counts = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    view = view.reshape(-1)
    order = np.argsort(view, kind='stable')
    slot = np.empty(len(view), dtype=np.int64)
    slot[order] = np.arange(len(view)) - np.repeat(np.cumsum(counts) - counts, counts)
    shape = (len(groups), int(counts.max()))
    row = np.full(shape, -1, dtype=np.int64)
    row[view, slot] = np.arange(len(view))
    return _make_views(observations, row, groups[:, 0], groups[:, 1], 1.0)


def group_frames(observations: Observations) -> tuple[Views, tuple[int, ...]]:
    """Group a table by frame, and how many columns (C,) of points each camera has in turn."""
    views = group_views(observations)
    frames, frame = np.unique(views.frame, return_inverse=True)
    counts = views.used.sum(axis=1)
    cameras = range(len(observations.cameras))
    widths = [int(counts[views.camera == one].max(initial=0)) for one in cameras]
    ends = np.cumsum([0, *widths])
    row = np.full((len(frames), ends[-1]), -1, dtype=np.int64)
    for camera in cameras:
        mine = views.camera == camera
        row[frame[mine], ends[camera] : ends[camera + 1]] = views.row[mine, : widths[camera]]
    merged = _make_views(observations, row, frames, np.zeros(len(frames), dtype=np.int64), 1.0)
    return merged, tuple(widths)


def select_cameras(table: Observations, cameras: Sequence[str]) -> Observations:
    """Return the rows of some cameras, numbered in their order."""
    number = np.full(len(table.cameras), -1)
    number[[table.cameras.index(name) for name in cameras]] = np.arange(len(cameras))
    rows = table.take(number[table.camera] >= 0)
    return replace(rows, cameras=tuple(cameras), camera=number[rows.camera])


def select_shared(table: Observations) -> Observations:
    """Return the rows of frames that several cameras saw."""
    pairs = np.unique(np.stack([table.frame, table.camera], axis=-1), axis=0)
    frames, counts = np.unique(pairs[:, 0], return_counts=True)
    return table.take(np.isin(table.frame, frames[counts >= 2]))


def join_tables(tables: Sequence[Observations]) -> Observations:
    """Return the rows of several tables of the same cameras."""
    rows: dict[str, Any] = {
        name: np.concatenate([getattr(table, name) for table in tables])
        for name in ('frame', 'landmark', 'uv', 'xyz', 'camera', 'board', 't', 'sigma')
    }
    return replace(tables[0], **rows)


def rig_cameras(cameras: tuple[str, ...]) -> tuple[str, str] | None:
    """Return the names of a rig's cameras: left and right, or the only two there are."""
    names = STEREO if set(STEREO) <= set(cameras) else sorted(cameras)
    return (names[0], names[1]) if len(names) == 2 else None


def stereo_views(observations: Observations, default_sigma: float = 1.0) -> tuple[Views, Views]:
    """Return the views of the two cameras of a rig with the same frames and the same slots.

    Frame s and slot n mean the same frame and landmark in both; what one camera lacks is padding.
    Raises ObservationError for a missing camera or a landmark that stands twice in a view.
    """
    pair_names = rig_cameras(observations.cameras)
    if pair_names is None or not len(observations):
        names = ', '.join(observations.cameras) or 'one camera, without a name'
        held = names if len(observations) else 'no observation'
        raise ObservationError(
            f'{observations.source}: the cameras left and right are needed; it holds {held}'
        )
    frames, frame = np.unique(observations.frame, return_inverse=True)
    landmarks, slot = np.unique(observations.landmark, return_inverse=True)
    pair = []
    for camera in map(observations.cameras.index, pair_names):
        rows = np.flatnonzero(observations.camera == camera)
        row = np.full((len(frames), len(landmarks)), -1, dtype=np.int64)
        row[frame[rows], slot[rows]] = rows
        twice = rows[row[frame[rows], slot[rows]] != rows]
        if twice.size:
            raise ObservationError(
                f'{observations.source}: landmark {observations.landmark[twice[0]]} is listed '
                f'twice in frame {observations.frame[twice[0]]} of one camera'
            )
        cameras = np.full(len(frames), camera)
        pair.append(_make_views(observations, row, frames, cameras, default_sigma))
    return pair[0], pair[1]


def _make_views(
    observations: Observations, row: Index, frame: Index, camera: Index, default_sigma: float
) -> Views:
    used = row >= 0
    sigma = np.where(np.isnan(observations.sigma), default_sigma, observations.sigma)
    return Views(
        points=observations.xyz[row],  # padding repeats a landmark: no point at the camera
        uv=np.where(used[..., None], observations.uv[row], 0.0),
        weight=np.where(used, 1 / sigma[row], 0.0),
        landmark=np.where(used, observations.landmark[row], -1),
        board=np.where(used, observations.board[row], 0),
        t=np.where(used, observations.t[row], np.nan),
        frame=frame,
        camera=camera,
        row=row,
    )


def views_of(points: Array, uv: Array | None = None, weight: Array | None = None) -> Views:
    """Wrap plain arrays as views: points (N, 3) or (S, N, 3), m; uv (S, N, 2), px, NaN = unseen.

    uv: zeros where left out, as of points that are still to be predicted; weight: 1 / sigma
    (S, N), 1/px; 1 where left out.
    """
    if uv is None:
        uv = np.zeros((*points[None].shape[-3:-1], 2))
    shape = uv.shape[:2]
    seen: Mask = np.asarray(np.isfinite(uv).all(axis=-1))
    unit = np.ones(shape) if weight is None else weight
    flat = np.arange(seen.size, dtype=np.int64).reshape(shape)
    zeros = np.zeros(shape, dtype=np.int64)
    return Views(
        points=np.broadcast_to(points, (*shape, 3)),
        uv=np.where(seen[..., None], uv, 0.0),
        weight=np.where(seen, unit, 0.0),
        landmark=np.broadcast_to(np.arange(shape[1]), shape),
        board=zeros,
        t=np.full(shape, np.nan),
        frame=np.arange(shape[0]),
        camera=np.zeros(shape[0], dtype=np.int64),
        row=np.where(seen, flat, -1),
    )


def photograph_names(table: Observations) -> dict[tuple[int, str], str]:
    """Return the file name of each photograph by frame and camera, unique among them.

    All keep their folder where photographs in several folders have one file name.
    """
    paths = {(frame, camera): PurePath(path) for frame, camera, path in table.photographs}
    parts = 1 if len({path.name for path in paths.values()}) == len(paths) else 2
    return {key: '/'.join(path.parts[-parts:]) for key, path in paths.items()}


def photograph_column(
    table: Observations, frames: Index, cameras: Sequence[str] | None = None
) -> dict[str, NDArray[np.str_]]:
    """Return the column of a table that has rows of frames (N,), and of cameras (N,) if given.

    The photographs of each row; no column where none is known.
    """
    if not table.photographs:
        return {}
    views: list[tuple[int, str | None]] = [(frame, None) for frame in frames.tolist()]
    if cameras is not None:
        views = list(zip(frames.tolist(), cameras, strict=True))
    names = {
        view: photograph_entry(table, *view).get('photograph', '') for view in dict.fromkeys(views)
    }
    return {'photograph': np.array([names[view] for view in views])}


def frame_names(table: Observations, frame: int, camera: str | None = None) -> list[str]:
    """Return what a frame is called: its photographs, of one camera or of all that took it.

    Without photographs: `frame 3`, or `frame 3 of left`.
    """
    names = photograph_names(table)
    here = (table.cameras[i] for i in np.unique(table.camera))
    cameras = here if camera is None else (camera,)
    listed = [names[frame, camera] for camera in cameras if (frame, camera) in names]
    return listed or [f'frame {frame}' + (f' of {camera}' if camera else '')]


def frame_name(table: Observations, frame: int, camera: str | None = None) -> str:
    """Return what a frame is called in one word or two."""
    return ' and '.join(frame_names(table, frame, camera))


def list_frames(table: Observations, frames: Sequence[int]) -> str:
    """Return frames as one enumerates them: the first ten, and the count of the others.

    Photographs by name; `frames 1, 2 and 3` where no photograph is known.
    """
    names_by_frame = [dict.fromkeys(frame_names(table, frame)) for frame in dict.fromkeys(frames)]
    names = list(dict.fromkeys(name for group in names_by_frame for name in group))
    head = ''
    if names and all(name.startswith('frame ') for name in names):
        head = 'frames ' if len(names) > 1 else 'frame '
        names = [name.removeprefix('frame ') for name in names]
    if len(names) > _MAX_LISTED:
        return f'{head}{", ".join(names[:_MAX_LISTED])} and {len(names) - _MAX_LISTED} more'
    return head + ' and '.join(filter(None, (', '.join(names[:-1]), *names[-1:])))


def photograph_entry(table: Observations, frame: int, camera: str | None = None) -> dict[str, str]:
    """Return what JSON holds beside a frame's number: its photograph, where it is known."""
    name = frame_name(table, frame, camera)
    return {} if name.startswith('frame ') else {'photograph': name}
