"""Chessboard corners in BabelCalib's ORPC form, with the target's .dsc and .tp files.

A folder of .orpc files, one an image (board, corner, 1, u, v; 0-based), is a table; the target
stands beside it or up to two folders above: .dsc the boards' corners, cm; .tp the boards' poses in
the target frame, mm.  Source: github.com/ylochman/babelcalib, core/feature/parse.
"""

from __future__ import annotations

import re
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.io.files import parse_number, read_text
from fisheye_svp_ros.io.paths import visible_paths
from fisheye_svp_ros.scene.observations import MOST_LANDMARK, Observations, make_observations

_CM, _MM = 0.01, 0.001
_MAX_BYTES = 1 << 24  # bytes
_SQUARE = 1e-3  # digits of a printed rotation are forgiven
_TIME = re.compile(r'\d{4}(-\d{2}){5}$')


class BoardCorners(NamedTuple):
    """One board of a target: its first landmark's id and its corners (N, 3), m, target frame."""

    first: int
    corners: Array


def read(path: str | Path) -> Observations:
    """Read a folder of .orpc files (or one of them); frames are the files in order of name.

    t is counted from the earliest image below the target's folder, s, where the names carry the
    time.  Raises ObservationError, naming file, line and field.
    """
    location = Path(path)
    files = visible_paths(location.glob('*.orpc')) if location.is_dir() else [location]
    folder = location if location.is_dir() else location.parent
    description = _description(folder)
    boards = _read_boards(description)
    corners = [_read_corners(file, boards) for file in files]
    counts = [len(rows) for rows in corners]
    rows = np.concatenate(corners)
    if not len(rows):
        raise ObservationError(f'{path}: its .orpc files hold no corner')
    board, corner = rows[:, 0].astype(np.int64), rows[:, 1].astype(np.int64)
    return make_observations(
        np.repeat(np.arange(len(files)), counts),
        np.array([boards[b].first for b in board]) + corner,
        rows[:, 3:],
        np.stack([boards[b].corners[c] for b, c in zip(board, corner, strict=True)]),
        board=board,
        t=np.repeat(_image_times(files, description.parent), counts),
        source=str(path),
    )


def _description(folder: Path) -> Path:
    for place in (folder, *list(folder.resolve().parents)[:2]):
        descriptions = visible_paths(place.glob('*.dsc'))
        if len(descriptions) > 1:
            raise ObservationError(f'{place}: several .dsc files; keep the one of this target')
        if descriptions:
            return descriptions[0]
    raise ObservationError(f'{folder}: no .dsc file of the target, here or two folders above')


def _read_boards(path: Path) -> dict[int, BoardCorners]:
    """Read a .dsc and the .tp of the same name, which a single board can do without."""
    corners: dict[int, list[list[float]]] = {}
    number, places = -1, set()
    for line, fields in _numbered_lines(path):
        if len(fields) == 4:
            number = _parse_int(path, line, fields[0])
            if number in corners:
                raise ObservationError(f'{path}, line {line}: board {number} is listed twice')
            corners[number] = []
        elif len(fields) == 6 and corners:
            values = _field_numbers(path, line, fields)
            if (corner := (number, *values[:3])) in places:
                raise ObservationError(f'{path}, line {line}: this corner is listed twice')
            places.add(corner)
            corners[number].append(values[3:])
        elif len(fields) != 2:
            raise ObservationError(f'{path}, line {line}: not a board, a tag family or a corner')
    if not any(corners.values()):
        raise ObservationError(f'{path}: no board in it')
    poses = _read_board_poses(path.with_suffix('.tp'), single=len(corners) == 1)
    boards, first = {}, 0
    for number, points in corners.items():
        if number in poses and points:
            turn, place = poses[number][:, :3], poses[number][:, 3] * _MM
            boards[number] = BoardCorners(first, np.array(points) * _CM @ turn.T + place)
        first += len(points)
    return boards


def _read_board_poses(path: Path, single: bool) -> dict[float, Array]:
    if single and not path.exists():
        return {0: np.eye(3, 4)}
    numbers: list[float] = []
    for line, fields in _numbered_lines(path, separator=None):
        numbers += _field_numbers(path, line, fields)
    if not numbers or len(numbers) % 13:
        raise ObservationError(f'{path}: a board number and 3 x 4 numbers are needed for each')
    poses = {row[0]: row[1:].reshape(3, 4) for row in np.reshape(numbers, (-1, 13))}
    for number, pose in poses.items():
        turn = pose[:, :3]
        if not np.allclose(turn @ turn.T, np.eye(3), atol=_SQUARE) or np.linalg.det(turn) < 0:
            raise ObservationError(f'{path}: the pose of board {number:g} holds no rotation')
    if 13 * len(poses) < len(numbers):
        raise ObservationError(f'{path}: a board is listed twice')
    return poses


def _read_corners(path: Path, boards: dict[int, BoardCorners]) -> Array:
    """Return the rows (N, 5) of one .orpc file: board, corner, 1, u, v."""
    rows, promised = [], None
    for line, fields in _numbered_lines(path):
        if len(fields) == 1 and ':' in fields[0]:
            name, value = fields[0].split(':', 1)
            if name == 'num_corners':
                promised = _parse_int(path, line, value)
            continue
        row = _field_numbers(path, line, fields)
        if len(row) != 5:
            raise ObservationError(f'{path}, line {line}: board, corner, 1, u, v are needed')
        board = boards.get(_parse_int(path, line, fields[0]))
        if board is None or _parse_int(path, line, fields[1]) >= len(board.corners):
            raise ObservationError(
                f'{path}, line {line}: board {row[0]:g}, corner {row[1]:g} is not on the target'
            )
        rows.append(row)
    if promised != len(rows):
        raise ObservationError(
            f'{path}: num_corners is {promised}, but {len(rows)} corners are '
            'in it; the file is damaged'
        )
    places = [tuple(row[:2]) for row in rows]
    if len(set(places)) < len(places):
        raise ObservationError(f'{path}: it has a corner twice')
    return np.array(rows).reshape(-1, 5)


def _image_times(files: list[Path], dataset: Path) -> Array:
    """Return the seconds (F,) from the earliest image of the data set; NaN without times."""
    times = [_time(file) for file in files]
    everywhere = [_time(file) for file in visible_paths(dataset.rglob('*.orpc'))]
    instants = [time for time in (*times, *everywhere) if time is not None]
    return np.array(
        [
            np.nan if time is None or None in times else (time - min(instants)).total_seconds()
            for time in times
        ]
    )


def _time(file: Path) -> datetime | None:
    stamp = _TIME.search(file.stem)
    try:
        return datetime.strptime(stamp.group(), '%Y-%m-%d-%H-%M-%S') if stamp else None
    except ValueError:
        return None


def _numbered_lines(path: Path, separator: str | None = ',') -> list[tuple[int, list[str]]]:
    """Return line numbers and fields of the lines that are neither empty nor a comment."""
    text = read_text(path, ObservationError, _MAX_BYTES)
    return [
        (i, line.split(separator))
        for i, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.startswith('#')
    ]


def _parse_int(path: Path, line: int, field: str) -> int:
    value = _field_numbers(path, line, [field])[0]
    if not (value.is_integer() and 0 <= value <= MOST_LANDMARK):
        raise ObservationError(
            f'{path}, line {line}: {field.strip()!r} is not a whole number '
            f'from 0 to {MOST_LANDMARK}'
        )
    return int(value)


def _field_numbers(path: Path, line: int, fields: list[str]) -> list[float]:
    try:
        values = [parse_number(field) for field in fields]
    except ValueError as cause:
        raise ObservationError(f'{path}, line {line}: {cause}') from cause
    if not np.isfinite(values).all():
        raise ObservationError(f'{path}, line {line}: finite numbers are needed')
    return values
