"""CSV tables with a header, whose errors name file, line and column; observations and poses.

Cells are separated by commas, or by semicolons or tabs, as spreadsheets write them.  Comments may
stand above the header, and the header in the last of them, as numpy.savetxt writes it.
Observations: frame,landmark,u,v,x,y,z and, optional, camera,board,t,sigma; poses:
frame,x,y,z,qx,qy,qz,qw, the camera in the world (or target) frame.
"""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.errors import ObservationError, ParameterError
from fisheye_svp_ros.io.files import parse_number, read_text, write_text
from fisheye_svp_ros.io.paths import path_of
from fisheye_svp_ros.pose import Pose, quaternion_from_rotation, rotation_from_quaternion
from fisheye_svp_ros.scene.observations import (
    CAMERA_NAME,
    MOST_LANDMARK,
    Observations,
    is_camera_name,
    make_observations,
)
from fisheye_svp_ros.scene.table_checks import SIGMA_BOUND, implausible_sigma

_MAX_HEADER = 60  # characters of a header
_RECENT = 1e9  # s since 1970, in 2001
_PER_SECOND = {'nanoseconds': 1e9, 'microseconds': 1e6, 'milliseconds': 1e3}
_MAX_VALUE = 1e12  # m, px or s; squares and products of anything larger are soon no numbers
_MAX_PIXEL = 1e6  # px; no image reaches so far
_MAX_PLACE = 1e8  # m; the farthest places on Earth are 2e7 apart
_MIN_UNSEEN_ROWS = 5

REQUIRED_COLUMNS = ('frame', 'landmark', 'u', 'v', 'x', 'y', 'z')
COLUMNS = ('frame', 'x', 'y', 'z', 'qx', 'qy', 'qz', 'qw')
_NORM_SLACK = 1e-3  # printed digits are forgiven, another convention is not


class CsvTable:
    """The cells of a CSV file by column, in any column order."""

    def __init__(self, path: Path, required: Sequence[str]) -> None:
        """Read the file; raises ObservationError unless all required columns are there."""
        self.path = path
        self._lines: list[int] = []
        rows = []
        try:
            lines = io.StringIO(read_text(path, ObservationError), newline='').readlines()
            place = _uncomment(lines, required)
            reader = csv.reader(lines, delimiter=_separator(lines[place:]))
            self._header = [name.strip() for name in next(filter(None, reader), [])]
            self._check_header(required)
            for row in reader:
                if not row:
                    continue
                if len(row) != len(self._header):
                    raise ObservationError(
                        f'{path}, line {reader.line_num}: {len(row)} fields where the header '
                        f'has {len(self._header)}'
                    )
                rows.append(row)
                self._lines.append(reader.line_num)
        except csv.Error as cause:
            raise ObservationError(f'{path}: not a CSV file ({cause})') from cause
        if not rows:
            raise ObservationError(f'{path}: no row below the header; at least one is needed')
        self._columns = dict(zip(self._header, zip(*rows, strict=True), strict=True))

    def __contains__(self, name: str) -> bool:
        return name in self._header

    def items(self) -> Iterable[tuple[str, tuple[str, ...]]]:
        """Return the names and cells of all columns."""
        return self._columns.items()

    def text(self, name: str) -> tuple[str, ...]:
        """Return the cells of a column."""
        return self._columns[name]

    def numbers(self, *names: str) -> Array:
        """Return columns as finite numbers (N, len(names)) of at most 1e12."""
        values = np.stack([self._numbers(name) for name in names], axis=-1)
        for name, column in zip(names, values.T, strict=True):
            needed = f'a number of at most {_MAX_VALUE:g}'
            if name == 't':
                unit = _stamp_unit(column)
                needed = 'a time in seconds' + (
                    f' (these are {unit}: divide by {_PER_SECOND[unit]:g})' if unit else ''
                )
            self.refuse(np.abs(column) > _MAX_VALUE, name, needed)
        return values

    def known_numbers(self, name: str) -> Array:
        """Return a column of numbers (N,), NaN for empty cells."""
        cells = self._columns[name]
        empty = np.array([not cell.strip() for cell in cells])
        # Any number stands in for what is empty, so that errors name the line of the others.
        self._columns[name] = tuple(cell if cell.strip() else '1' for cell in cells)
        return np.where(empty, np.nan, self.numbers(name)[:, 0])

    def integers(self, name: str, most: int = 2**53) -> Index:
        """Return a column of whole numbers (N,) from 0 to `most`."""
        values = self._numbers(name)
        bad = (values != np.floor(values)) | (values < 0) | (values > most)
        unit = _stamp_unit(values)
        hint = f' (stamps in {unit} belong in t, in seconds)' if unit and name == 'frame' else ''
        self.refuse(bad, name, f'a whole number from 0 to {most}{hint}')
        return values.astype(np.int64)

    def refuse(self, bad: Sequence[bool] | Mask, name: str, needed: str) -> None:
        """Raise ObservationError for the first row that is bad: what the column needs there."""
        rows = np.flatnonzero(bad)
        if rows.size:
            cell = self._columns[name][rows[0]]
            raise ObservationError(
                f'{self.path}, line {self.line(rows[0])}: {name} is {cell!r:.80}; '
                f'{needed} is needed'
            )

    def line(self, row: int) -> int:
        """Return the line of the file on which a row ends."""
        return self._lines[row]

    def refuse_repeats(self, keys: Array | Index, what: str) -> None:
        """Raise ObservationError where two rows have the same key (N, K)."""
        _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        again = np.flatnonzero(first[inverse.reshape(-1)] != np.arange(len(keys)))
        if again.size:
            before = self.line(first[inverse.reshape(-1)[again[0]]])
            raise ObservationError(
                f'{self.path}, line {self.line(again[0])}: the same {what} as in line {before}; '
                'remove one of them'
            )

    def _check_header(self, required: Sequence[str]) -> None:
        wanted, columns = ','.join(required), ','.join(self._header)
        if not any(self._header):
            raise ObservationError(
                f'{self.path}: it is empty; a header with {wanted or "names"} is needed'
            )
        missing = [name for name in required if name not in self._header]
        if missing and all(map(_is_number, self._header)):
            raise ObservationError(
                f'{self.path}: its first line holds numbers; a header with {wanted} is needed'
            )
        if missing:
            names = ', '.join(map(repr, missing))
            which = f'column {names} is' if len(missing) == 1 else f'columns {names} are'
            raise ObservationError(
                f'{self.path}: {which} missing from its header, '
                f'{columns[:_MAX_HEADER]!r}; needed are {wanted}'
            )
        twice = [name for name, count in Counter(self._header).items() if name and count > 1]
        if twice:
            raise ObservationError(f'{self.path}: its header has {twice[0]!r} twice')

    def _numbers(self, name: str) -> Array:
        cells = self._columns[name]
        try:
            # Python reads 1_00 as 100, and digits of all scripts.
            if any('_' in cell or not cell.isascii() for cell in cells):
                raise ValueError
            values = np.array(cells, dtype=float)
        except ValueError:
            comma = ', with a decimal point,' if any(',' in cell for cell in cells) else ''
            self.refuse([not _is_number(cell) for cell in cells], name, f'a number{comma}')
            raise
        self.refuse(~np.isfinite(values), name, 'a finite number')
        return values


def _stamp_unit(values: Array) -> str:
    """Return the unit that stamps since 1970 must be in, '' for seconds and small numbers."""
    largest = np.abs(values).max(initial=0.0)
    return next((unit for unit, scale in _PER_SECOND.items() if largest > _RECENT * scale), '')


def _uncomment(lines: list[str], required: Sequence[str]) -> int:
    """Empty the comments above the header, but for the header; return the place of that."""
    for place, line in enumerate(lines):
        bare = line.lstrip('#')
        header = {name.strip() for name in bare.split(_separator([bare]))}
        if bare.strip() and (bare == line or header.issuperset(required)):
            lines[place] = bare
            return place
        lines[place] = '\n'
    return len(lines)


def _separator(lines: Sequence[str]) -> str:
    """Return what separates the cells: a semicolon or tab where the header has no comma."""
    header = lines[0] if lines else ''
    return next(
        (separator for separator in ';\t' if separator in header and ',' not in header), ','
    )


def _is_number(cell: str) -> bool:
    try:
        parse_number(cell)
    except ValueError:
        return False
    return True


def write_columns(path: str | Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write columns (N,) as CSV, which reads back to the same bits; raise OutputError."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator='\n')
    writer.writerow(columns)
    writer.writerows(zip(*(values.tolist() for values in columns.values()), strict=True))
    write_text(path, text.getvalue())


def read(path: str | Path) -> Observations:
    """Read a table of observations; columns in any order, further columns ignored.

    Raises ObservationError, naming file, line and column.
    """
    table = CsvTable(Path(path), REQUIRED_COLUMNS)
    frame, landmark = table.integers('frame'), table.integers('landmark', MOST_LANDMARK)
    names = table.text('camera') if 'camera' in table else ('',) * len(frame)
    cameras = tuple(dict.fromkeys(names))
    table.refuse([not is_camera_name(name) for name in names], 'camera', CAMERA_NAME)
    if len(cameras) > 1:
        named = next(filter(None, cameras))
        table.refuse([not name for name in names], 'camera', f'a name, as {named!r} elsewhere,')
    camera = np.array([cameras.index(name) for name in names], dtype=np.int64)
    table.refuse_repeats(
        np.stack([frame, camera, landmark], axis=-1), 'frame, camera and landmark'
    )
    uv = table.numbers('u', 'v')
    for name, column in zip('uv', uv.T, strict=True):
        table.refuse(
            np.abs(column) > _MAX_PIXEL, name, f'a place in an image, up to {_MAX_PIXEL:g} px,'
        )
    xyz = table.numbers('x', 'y', 'z')
    for name, column in zip('xyz', xyz.T, strict=True):
        table.refuse(
            np.abs(column) > _MAX_PLACE, name, f'a place in meters, up to {_MAX_PLACE:g},'
        )
    _refuse_unseen(table, np.stack([frame, camera], axis=-1), uv)
    sigma = table.known_numbers('sigma') if 'sigma' in table else None
    if sigma is not None:
        table.refuse(sigma <= 0, 'sigma', 'a number above 0')
        table.refuse(implausible_sigma(sigma), 'sigma', SIGMA_BOUND)
    return make_observations(
        frame,
        landmark,
        uv,
        xyz,
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

    An unknown sigma is an empty cell.  Raises ObservationError where t is known for some rows
    only, OutputError where the file cannot be written.
    """
    if not isinstance(observations, Observations):
        raise ParameterError(
            f'observations are of type {type(observations).__name__}; a table is '
            'needed, after the path'
        )
    table = observations
    columns: dict[str, NDArray[Any]] = {
        'frame': table.frame,
        'landmark': table.landmark,
        'u': table.uv[:, 0],
        'v': table.uv[:, 1],
        'x': table.xyz[:, 0],
        'y': table.xyz[:, 1],
        'z': table.xyz[:, 2],
    }
    if table.cameras != ('',):
        columns['camera'] = np.array(table.cameras)[table.camera]
    if table.board.any():
        columns['board'] = table.board
    timed, weighted = np.isfinite(table.t), np.isfinite(table.sigma)
    if timed.any() and not timed.all():
        raise ObservationError(f'{table.source}: t is known for some rows only')
    if timed.any():
        columns['t'] = table.t
    if weighted.any():
        columns['sigma'] = np.where(weighted, table.sigma.astype(object), '')
    write_columns(path, columns)


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


def write_poses(
    path: str | Path,
    frame: Index,
    pose: Pose,
    more: Mapping[str, NDArray[Any]] = MappingProxyType({}),
) -> None:
    """Write frames (F,) and poses (F,); more: columns (F,), which no reader asks for.

    Raises OutputError where the file cannot be written.
    """
    write_columns(path, pose_columns(frame, pose) | dict(more))


def pose_columns(frame: Index, pose: Pose) -> dict[str, NDArray[Any]]:
    """Return frames (F,) and poses (F,) as COLUMNS."""
    numbers = np.concatenate([pose.position, quaternion_from_rotation(pose.rotation)], axis=-1)
    return dict(zip(COLUMNS, (frame, *numbers.T), strict=True))
