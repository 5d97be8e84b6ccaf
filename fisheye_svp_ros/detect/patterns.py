"""Patterns: what is printed on a board, given by one line of text such as chessboard:9x6:24mm."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.detect.tag_grids import GridReading, TagLayout
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.io.files import read_yaml

LENGTH_UNITS = {'mm': 1e-3, 'cm': 1e-2, 'm': 1.0}
_LENGTH = re.compile(r'([0-9.]+(?:e-?[0-9]+)?) *(mm|cm|m)', re.IGNORECASE)
_SIZE = re.compile(r'([0-9]{1,9})x([0-9]{1,9})', re.IGNORECASE)
_MAX_POINTS = 10_000  # points
LOOSE_TAGS = 'tags'  # the kind of tags that hang where a map says
_APRILTAGS = 'DICT_APRILTAG_36H11'
# Markers of OpenCV's dictionaries, whose names are as good in capitals
_MARKERS = {
    **{
        f'DICT_{bits}X{bits}_{count}': count
        for bits in (4, 5, 6, 7)
        for count in (50, 100, 250, 1000)
    },
    'DICT_ARUCO_ORIGINAL': 1024,
    'DICT_ARUCO_MIP_36H12': 250,
    'DICT_APRILTAG_16H5': 30,
    'DICT_APRILTAG_25H9': 35,
    'DICT_APRILTAG_36H10': 2320,
    _APRILTAGS: 587,
}
_TAGS = _MARKERS[_APRILTAGS]
_NEIGHBORS = 6
_CORNERS = np.array([[0.0, 0.0], [1, 0], [1, 1], [0, 1]])  # of a square, sides of one
_MAX_SPACING = 10.0  # m; a larger spacing is a slip of the unit


class Turn(NamedTuple):
    """A turn of a board: source (N,), the point that lands on each; matrix (2, 2); same print."""

    source: Index
    matrix: Array
    same: bool


class LocatedPoints(NamedTuple):
    """Which points (M,) of a pattern are in an image, and where, (M, 2), px, roughly.

    grid: what tags say about an AprilGrid.
    """

    ids: Index
    uv: Array
    grid: GridReading | None = None


@dataclass(frozen=True, eq=False)
class Pattern:
    """The points of a flat board, and what a detector must know of them.

    points (N, 3), m, z = 0; columns, rows: as written in `spec`; clearance: how far around a
    point, m, nothing but its own edges is printed; inward (N, 2): towards the dark corner of a
    square grid, along the board's axes; tint (N,): 1 where the square towards +x, +y is bright,
    -1 where it is dark, 0 where there is none; marker: side of a tag, m; dictionary: of tags;
    gap: between the tags of an AprilGrid, over their side; layout: of its tags, None unknown;
    first: id of the first tag of a ChArUco board; note: what was assumed, '' for nothing.
    """

    kind: str
    spec: str
    columns: int
    rows: int
    points: Array
    clearance: float
    inward: Array
    tint: Array
    size: float
    marker: float = 0.0
    dictionary: str = ''
    gap: float = 0.0
    layout: TagLayout | None = None
    first: int = 0
    note: str = ''

    @property
    def tag_count(self) -> int:
        """How many tags it has."""
        return {
            'aprilgrid': self.columns * self.rows,
            'charuco': self.columns * self.rows // 2,
        }.get(self.kind, 0)

    def with_layout(self, layout: TagLayout) -> Pattern:
        """Return the AprilGrid with its tags printed so."""
        # A corner of a cell is nearest: the code has six cells, the border stands around it.
        border = layout.border / (6 + 2 * layout.border)
        clearance = self.marker * min(self.gap, border * float(np.sqrt(2)))
        return replace(self, layout=layout, clearance=clearance)

    def without_squares(self) -> Pattern:
        """Return the AprilGrid with tags alone, whose corners are those of dark squares."""
        inward = np.tile(1 - 2 * _CORNERS, (self.tag_count, 1))
        return replace(self, inward=inward, tint=np.ones(len(self.points)))

    @cached_property
    def turns(self) -> tuple[Turn, ...]:
        """The quarter turns that put every point on a point; the first is none."""
        if self.marker:
            return (Turn(np.arange(len(self.points)), np.eye(2), True),)
        low, high = self.points[:, :2].min(axis=0), self.points[:, :2].max(axis=0)
        xy = self.points[:, :2] - (low + high) / 2
        found = []
        for quarter, (cos, sin) in enumerate(((1, 0), (0, 1), (-1, 0), (0, -1))):
            turn = np.array([[cos, -sin], [sin, cos]], dtype=float)
            distance = np.abs((xy @ turn.T)[None] - xy[:, None]).max(axis=-1)
            source = np.argmin(distance, axis=1)
            if distance[np.arange(len(xy)), source].max() > 1e-6 * self.size:
                continue
            # A quarter turn carries the square towards +x, +y to the one towards -x, +y.
            same = np.array_equal(self.tint[source] * (-1) ** quarter, self.tint)
            if np.allclose(self.inward[source] @ turn.T, self.inward):
                found.append(Turn(source, turn, same))
        return tuple(found)

    @property
    def symmetries(self) -> tuple[Turn, ...]:
        """The turns that nothing in the print tells apart."""
        return tuple(turn for turn in self.turns if turn.same)


def parse_pattern(spec: str) -> Pattern:
    """Return the pattern that a line of text names.

    chessboard:9x6:24mm (inner corners, spacing); charuco:7x5:30mm:22mm:DICT_5X5_100 (squares, side
    of a square and of a marker, ArUco dictionary; where it is not 0, the id of the first marker);
    aprilgrid:target.yaml (Kalibr's target file); tags:tags.yaml (loose tags 36h11 of a map; before
    its file their side, as tags:160mm:tags.yaml);
    circles:7x5:20mm and circles:4x11:20mm:asymmetric (spacing as OpenCV counts it: half of that
    within a row of the asymmetric grid); squares:3x4:30mm:30mm (separate squares, side and gap).
    Raises ParameterError, with what is expected, for anything else.
    """
    kind, _, rest = spec.partition(':')
    if kind not in PATTERNS:
        raise ParameterError(
            f'board {spec!r}: known kinds are {", ".join(PATTERNS)}; for example '
            'chessboard:9x6:24mm, which counts inner corners'
        )
    return PATTERNS[kind](spec, rest.split(':') if rest else [])


def local_axes(points: Array, uv: Array) -> Array:
    """Return derivatives (M, 2, 2), px/m, of uv (M, 2) by points (M, 2): rows are the axes."""
    distance = np.linalg.norm(points[:, None] - points, axis=-1)
    nearest = np.argsort(distance, axis=1, kind='stable')[:, 1 : _NEIGHBORS + 1]
    here, there = points[nearest] - points[:, None], uv[nearest] - uv[:, None]
    weight = 1 / (here**2).sum(axis=-1, keepdims=True)
    transposed = np.swapaxes(here * weight, -1, -2)
    # A little towards the isotropic: neighbors may lie on one line.
    ridge = 1e-6 * np.eye(2)
    return np.asarray(np.linalg.solve(transposed @ here + ridge, transposed @ there))


def _chessboard(spec: str, words: list[str]) -> Pattern:
    (columns, rows), (size,) = _numbers(spec, words, 1, least=3)
    points = _grid(columns, rows, size)
    return Pattern(
        'chessboard',
        spec,
        columns,
        rows,
        points,
        size,
        np.zeros((len(points), 2)),
        _checks(columns, rows),
        size,
    )


def _charuco(spec: str, words: list[str]) -> Pattern:
    first = int(words.pop(4)) if len(words) > 4 and words[4].isdecimal() else 0
    dictionary = words.pop(3).upper() if len(words) > 3 else 'DICT_5X5_100'
    (columns, rows), (size, marker) = _numbers(spec, words, 2, least=3)
    if marker >= size:
        raise ParameterError(f'board {spec!r}: the marker must be smaller than its square')
    if dictionary not in _MARKERS:
        raise ParameterError(
            f'board {spec!r}: OpenCV has no dictionary {dictionary}; choose from '
            f'{", ".join(_MARKERS)}'
        )
    needed, there = first + columns * rows // 2, _MARKERS[dictionary]
    if needed > there:
        raise ParameterError(
            f'board {spec!r}: it needs {needed} markers, and {dictionary} has '
            f'{there}; choose a larger dictionary'
        )
    points = _grid(columns - 1, rows - 1, size)
    clearance = (size - marker) / np.sqrt(2)  # the corner of a marker is the nearest of it
    return Pattern(
        'charuco',
        spec,
        columns,
        rows,
        points,
        clearance,
        np.zeros((len(points), 2)),
        _checks(columns - 1, rows - 1),
        size,
        marker,
        dictionary,
        first=first,
    )


def _circles(spec: str, words: list[str]) -> Pattern:
    asymmetric = words[-1:] == ['asymmetric']
    (columns, rows), (size,) = _numbers(spec, words[:-1] if asymmetric else words, 1, least=3)
    points = _grid(columns, rows, size)
    if asymmetric:
        row = np.repeat(np.arange(rows), columns)
        points[:, 0] = 2 * points[:, 0] + (row % 2) * size
    kind = 'asymmetric_circles' if asymmetric else 'circles'
    return Pattern(
        kind,
        spec,
        columns,
        rows,
        points,
        0.5 * size,
        np.zeros((len(points), 2)),
        np.zeros(len(points)),
        size,
    )


def _squares(spec: str, words: list[str]) -> Pattern:
    (columns, rows), (side, gap) = _numbers(spec, words, 2, least=1)
    points = _tiles(columns, rows, side + gap, side)
    inward = np.tile(1 - 2 * _CORNERS, (columns * rows, 1))
    return Pattern(
        'squares', spec, columns, rows, points, min(side, gap), inward, np.zeros(len(points)), side
    )


def _aprilgrid(spec: str, words: list[str]) -> Pattern:
    path = Path(':'.join(words))
    if path == Path():
        raise ParameterError(
            f'board {spec!r}: the file of a Kalibr target is needed, as in aprilgrid:target.yaml'
        )
    document = read_yaml(path, ParameterError)
    if document.get('target_type') != 'aprilgrid':
        raise ParameterError(
            f'{path}: target_type is {document.get("target_type")!r}; the YAML '
            'of a Kalibr aprilgrid is needed'
        )
    sides = [_positive(document, name, path, _TAGS) for name in ('tagCols', 'tagRows')]
    columns, rows = map(int, sides)
    if sides != [columns, rows] or columns * rows > _TAGS:
        raise ParameterError(
            f'{path}: tagCols x tagRows is {sides[0]:g} x {sides[1]:g}; whole '
            f'numbers, and at most {_TAGS} tags, are needed'
        )
    tag = _positive(document, 'tagSize', path, _MAX_SPACING)
    ratio = _positive(document, 'tagSpacing', path, _MAX_SPACING)
    # As Kalibr has it: x right, y up, tags and the corners of each from the lower left.
    points = _tiles(columns, rows, tag * (1 + ratio), tag)
    # The border of a tag is two of its ten cells: a corner of a cell is nearest.
    clearance = tag * min(ratio, 0.2 * np.sqrt(2))
    return Pattern(
        'aprilgrid',
        spec,
        columns,
        rows,
        points,
        clearance,
        np.zeros((len(points), 2)),
        np.tile([-1.0, 1, -1, 1], columns * rows),
        tag,
        tag,
        _APRILTAGS,
        ratio,
    )


def _loose_tags(spec: str, words: list[str]) -> Pattern:
    from fisheye_svp_ros.detect.tags import read_tag_pattern  # which needs this module

    return read_tag_pattern(spec, words)


PATTERNS: dict[str, Callable[[str, list[str]], Pattern]] = {
    'chessboard': _chessboard,
    'charuco': _charuco,
    'aprilgrid': _aprilgrid,
    'circles': _circles,
    'squares': _squares,
    LOOSE_TAGS: _loose_tags,
}


_EXAMPLES = {
    'chessboard': 'chessboard:9x6:24mm',
    'charuco': 'charuco:7x5:30mm:22mm',
    'circles': 'circles:7x5:20mm',
    'squares': 'squares:3x4:30mm:30mm',
}
_MAY_FOLLOW = {
    'charuco': ', then the dictionary, as in DICT_5X5_100',
    'circles': ', after which only `asymmetric` may follow',
}


def _numbers(
    spec: str, words: list[str], lengths: int, least: int
) -> tuple[tuple[int, int], list[float]]:
    size = _SIZE.fullmatch(words[0]) if words else None
    kind = spec.partition(':')[0]
    if size is None or len(words) < 1 + lengths:
        raise ParameterError(
            f'board {spec!r}: columns x rows and {lengths} '
            f'length{"s"[: lengths - 1]} are needed, as in {_EXAMPLES[kind]}'
        )
    if excess := words[1 + lengths :]:
        raise ParameterError(
            f'board {spec!r}: {excess[-1]!r} is too much; the form is {_EXAMPLES[kind]}'
            + _MAY_FOLLOW.get(kind, '')
        )
    columns, rows = int(size[1]), int(size[2])
    if min(columns, rows) < least or columns * rows > _MAX_POINTS:
        raise ParameterError(
            f'board {spec!r}: {words[0]} points; at least {least} each way, and at most '
            f'{_MAX_POINTS} in all, are needed'
        )
    return (columns, rows), [_length(spec, word) for word in words[1:]]


def _length(spec: str, word: str) -> float:
    match = _LENGTH.fullmatch(word)
    try:
        value = float(match[1]) * LENGTH_UNITS[match[2].lower()] if match else 0.0
    except ValueError:
        value = 0.0
    if not 0 < value < _MAX_SPACING:
        raise ParameterError(
            f'board {spec!r}: {word!r} is not a length above 0 and below '
            f'{_MAX_SPACING:g} m with its unit, as in 24.23mm'
        )
    return value


def _positive(document: dict[str, Any], name: str, path: Path, most: float) -> float:
    value = document.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value <= most:
        raise ParameterError(
            f'{path}: {name} is {value!r}; a number above 0 and up to {most:g} is needed'
        )
    return float(value)


def _grid(columns: int, rows: int, size: float) -> Array:
    """Return points (columns * rows, 3), m, row by row: x right, y down, z into the board."""
    y, x = np.mgrid[:rows, :columns]
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1) * size


def _tiles(columns: int, rows: int, pitch: float, side: float) -> Array:
    """Return the corners (4 * columns * rows, 3), m, of separate squares, square by square."""
    return (
        _grid(columns, rows, pitch)[:, None] + side * np.pad(_CORNERS, ((0, 0), (0, 1)))
    ).reshape(-1, 3)


def _checks(columns: int, rows: int) -> Array:
    """Return the tint of inner corners: the print's first square is dark, as OpenCV prints it."""
    y, x = np.mgrid[:rows, :columns]
    return np.asarray(-((-1.0) ** (x + y)).ravel())


def check_of_board(pattern: Pattern) -> str:
    """Return what to check where a board is never found."""
    if pattern.kind == 'aprilgrid':
        return 'check kind, tagCols and tagRows of the board'
    if pattern.kind == LOOSE_TAGS:
        return 'check the family of the tags (36h11), and whether the map has their ids'
    counted = {
        'chessboard': ' (inner corners: one less than squares)',
        'charuco': ' (squares, columns first), its dictionary and the id of its first marker',
    }
    return f'check kind and size of the board{counted.get(pattern.kind, "")}'
