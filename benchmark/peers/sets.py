"""The sets of a comparison, boards as regular grids, and how held-out points are scored."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.detect.detection import detect
from fisheye_svp_ros.detect.patterns import parse_pattern
from fisheye_svp_ros.detect.photographs import find_photographs
from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.io.readers import read_observations
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Observations

BOARDS = 1000  # more than boards in a frame
_ROUGHNESS = 0.02  # of the spacing: how far a point of a grid may be from its place
_HELD_OUT = 3  # of so many photographs one is held out
_LOST = 1e3  # px: what a point counts that a model cannot project
Project = Callable[[Array], Array]


@dataclass(frozen=True)
class Set:
    """What one camera saw; test: each board in each frame is a frame of its own."""

    name: str
    train: Observations
    test: Observations
    size: tuple[int, int]


@dataclass(frozen=True)
class Grid:
    """The boards of a set as one regular grid: landmark -> row and column, spacing, m."""

    places: dict[int, tuple[int, int]]
    spacing: float

    @property
    def width(self) -> int:
        """How many points the largest board has along a side."""
        return 1 + max(max(place) for place in self.places.values())


def table_set(folder: Path, size: tuple[int, int]) -> Set:
    """Return a set whose held-out frames have a file of their own."""
    train, test = (read_observations(folder / f'{part}.csv') for part in ('train', 'test'))
    return Set(folder.name, train, one_board_a_frame(test), size)


def photograph_set(folder: Path, board: str) -> Set:
    """Return a set of photographs, every third held out."""
    seen = detect(find_photographs([str(folder)]), parse_pattern(board), source=folder.name)
    held_out = np.isin(seen.observations.frame, seen.observations.frames[::_HELD_OUT])
    train, test = seen.observations.take(~held_out), seen.observations.take(held_out)
    assert seen.image_size is not None
    return Set(f'photos, {folder.name}', train, one_board_a_frame(test), seen.image_size)


def one_board_a_frame(table: Observations) -> Observations:
    """Return a table in which each board of a frame has a frame, and all points count alike."""
    return replace(
        table, frame=BOARDS * table.frame + table.board, sigma=np.full(len(table), np.nan)
    )


def grid_of(data: Set) -> Grid:
    """Find columns and rows of the landmarks of each board, right-handed as the camera sees them.

    Raises ObservationError where they lie on no regular grid.
    """
    parts = data.train, data.test
    landmark, board, xyz = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ('landmark', 'board', 'xyz')
    )
    places: dict[int, tuple[int, int]] = {}
    spacings = []
    for number in np.unique(board):
        ids, first = np.unique(np.where(board == number, landmark, -1), return_index=True)
        ids, first = ids[ids >= 0], first[ids >= 0]
        steps, spacing = _steps(xyz[first], data.name)
        own = dict(zip(ids.tolist(), map(tuple, steps.tolist()), strict=True))
        if _mirrored(data.train, number, own):
            own = {one: place[::-1] for one, place in own.items()}
        places |= own
        spacings.append(spacing)
    if np.ptp(spacings) > _ROUGHNESS * spacings[0]:
        raise ObservationError(f'{data.name}: its boards have other squares each')
    return Grid(places, float(np.mean(spacings)))


def _mirrored(table: Observations, board: int, places: dict[int, tuple[int, int]]) -> bool:
    """Whether columns and rows turn the other way in the image than u and v."""
    turn = 0.0
    for frame in np.unique(table.frame[table.board == board]):
        mine = (table.board == board) & (table.frame == frame)
        steps = np.array([places[one] for one in table.landmark[mine].tolist()])
        ones = np.column_stack([steps, np.ones(len(steps))])
        turn += np.linalg.det(np.linalg.lstsq(ones, table.uv[mine])[0][:2])
    return turn < 0


def _steps(points: Array, source: str) -> tuple[Index, float]:
    apart = np.linalg.norm(points[:, None] - points, axis=-1)
    np.fill_diagonal(apart, np.inf)
    spacing = float(np.median(apart.min(axis=0)))
    # Two neighbors in the middle: nominal places are rounded.
    corner = int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmin())
    other = int(apart[corner].argmin())
    along = (points[other] - points[corner]) / spacing
    near = (points - points[corner]) / spacing
    level = np.abs(near @ along) < _ROUGHNESS * np.maximum(np.linalg.norm(near, axis=1), 1)
    across = near[level][np.linalg.norm(near[level], axis=1).argsort()[1]]
    across /= np.linalg.norm(across)
    steps = np.rint(near @ np.stack([along, across], axis=-1)).astype(int)
    ones = np.column_stack([steps, np.ones(len(steps))])
    left = points - ones @ np.linalg.lstsq(ones, points)[0]
    if np.abs(left).max() > _ROUGHNESS * spacing or len(np.unique(steps, axis=0)) < len(steps):
        raise ObservationError(f'{source}: the landmarks of a board are no regular grid')
    axes = np.linalg.lstsq(ones, points)[0][:2]
    return steps - steps.min(axis=0), float(np.linalg.norm(axes, axis=1).mean())


def residuals(project: Project, frame: Index, xyz: Array, uv: Array, pose: Pose) -> Array:
    """Return distances (N,), px, of held-out points, once a pose is fitted to each view.

    All else is as it was fitted before.
    project: points (M, 3), m, in the camera to image points (M, 2), px; xyz (N, 3): the target as
    the model has it; pose: of the camera, one a frame in ascending order, to start from.
    """
    apart = np.empty(len(frame))
    for i, number in enumerate(np.unique(frame)):
        mine = frame == number
        apart[mine] = np.linalg.norm(_fitted(project, xyz[mine], uv[mine], pose.take(i)), axis=1)
    return apart


def _fitted(project: Project, xyz: Array, uv: Array, pose: Pose) -> Array:
    size = np.repeat([np.median(np.linalg.norm(pose.into_body(xyz), axis=1)), 1.0], 3)

    def misfit(change: Array) -> Array:
        seen = project(pose.retract(size * change).into_body(xyz))
        return np.nan_to_num(uv - seen, nan=_LOST, posinf=_LOST, neginf=-_LOST).ravel()

    found = least_squares(misfit, np.zeros(6), method='lm', x_scale=1e-2)
    return np.asarray(found.fun).reshape(-1, 2)


def rms(apart: Array) -> float:
    """Return the root mean square of distances (N,)."""
    return float(np.sqrt((apart**2).mean()))
