"""How the tags of an AprilGrid are printed, read off one photograph.

Kalibr turns each tag by half a turn against OpenCV's dictionary; other programs do not, or count
ids from another corner or number, or print a border of one cell.  Tags next to one another tell:
from the corners of a tag follows where its neighbors are, and their ids say which ones these are.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask

_NEIGHBORS = 4  # nearest tags of each that are compared with it
_TOLERANCE, _TOLERANCE_GROWTH = 0.35, 0.15  # steps of the grid; and over the steps between tags
_MIN_AGREEING_SHARE = 0.5  # of the pairs of neighbors, those of the grid alone
# OpenCV goes clockwise from a tag's upper left, Kalibr the other way from its lower left.
_ORDER = np.array([3, 2, 1, 0])


_NO_GRID = 'no board found: ids of neighboring tags are not those of one grid'


class TagLayout(NamedTuple):
    """How the tags of a grid are printed.

    border: cells around the code; turn: quarter turns of a tag against OpenCV's dictionary;
    from_top: rows of ids are counted from the top; first: the least id.
    """

    border: int
    turn: int
    from_top: bool
    first: int

    @property
    def is_standard(self) -> bool:
        """Whether ids are counted as Kalibr does it, from 0 at the lower left."""
        return self.first == 0 and not self.from_top


class GridSize(NamedTuple):
    """Columns and rows of tags, and the distance between tags over their size."""

    columns: int
    rows: int
    gap: float

    @property
    def tags(self) -> int:
        """How many tags there are."""
        return self.columns * self.rows


class GridReading(NamedTuple):
    """What the tags in a photograph say about their grid.

    layout: None where they leave it open; layouts: all that fit them; ids, uv: points (M,) of
    the grid and where they are (M, 2), px, by `layout`; others: tags that are not of the grid, in
    another grid; reason: why there are no points.
    """

    layout: TagLayout | None
    layouts: frozenset[TagLayout]
    ids: Index
    uv: Array
    others: int = 0
    reason: str = ''


def read_grid(
    ids: Index, corners: Array, border: int, size: GridSize, layout: TagLayout | None = None
) -> GridReading:
    """Return what tags (T,) with corners (T, 4, 2), px, in OpenCV's order, say about their grid.

    layout: the only one that is considered.
    """
    nothing = GridReading(None, frozenset(), ids[:0], np.empty((0, 2)))
    if not len(ids):
        return nothing
    pairs, offset = _pair_tags(corners, size.gap)
    ways = (
        _ways(size)
        if layout is None
        else [(layout.turn, layout.from_top, layout.first % size.columns)]
    )
    agreement = [_agree(ids, pairs, offset, way, size) for way in ways]
    count = np.array([agree.sum() for agree in agreement])
    best = [ways[i] for i in np.flatnonzero(count == count.max())]
    agree = agreement[int(count.argmax())]
    reason = _wrong_columns(ids, pairs, offset[best[0][0]], size)
    if count.max() < _MIN_AGREEING_SHARE * _neighboring(offset).sum():
        reason = reason or _NO_GRID
    if reason:
        return nothing._replace(reason=reason)
    kept, others = _one_grid(ids, pairs[agree], size, layout)
    layouts = frozenset(
        TagLayout(border, turn, from_top, first)
        for turn, from_top, residue in best
        for first in _firsts(ids[kept], residue, size)
        if layout is None or layout.first == first
    )
    chosen = layout if layout in layouts else _choose(layouts)
    if chosen is None:
        return nothing._replace(layouts=layouts, others=others, reason=_ambiguity(layouts))
    index, uv = _points(ids[kept], corners[kept], chosen, size)
    return GridReading(chosen, layouts, index, uv, others)


def common_layout(each: Sequence[frozenset[TagLayout]]) -> TagLayout | None:
    """Return the layout that fits the most photographs, by those that fit each; None for none."""
    count: dict[TagLayout, int] = {}
    for layouts in each:
        for layout in layouts:
            count[layout] = count.get(layout, 0) + 1
    return max(
        sorted(count),
        key=lambda layout: (count[layout], layout.is_standard, layout.first == 0),
        default=None,
    )


def _pair_tags(corners: Array, gap: float) -> tuple[Index, Array]:
    """Return pairs (P, 2) of neighboring tags, and the steps (4, P, 2) from one to the other.

    For each quarter turn: steps along the axes of tags so turned, by the mean of both.
    """
    from scipy.spatial import cKDTree  # half a second that no help waits for

    center = corners.mean(axis=1)
    near = min(_NEIGHBORS + 1, len(center))
    others = np.asarray(cKDTree(center).query(center, near)[1]).reshape(len(center), near)[:, 1:]
    pairs = np.column_stack([np.repeat(np.arange(len(center)), near - 1), others.ravel()])
    pairs = np.unique(np.sort(pairs, axis=1), axis=0).astype(np.int64)
    offset = np.full((4, len(pairs), 2), np.inf)
    move = center[pairs[:, 1]] - center[pairs[:, 0]]
    for turn in range(4):
        tag = corners[:, np.roll(_ORDER, -turn)]
        right, up = tag[:, 1] + tag[:, 2] - tag[:, 0] - tag[:, 3], tag[:, 2:].sum(axis=1)
        axes = (1 + gap) / 2 * np.stack([right, up - tag[:, :2].sum(axis=1)], axis=-1)
        mean = axes[pairs].mean(axis=1)
        det = np.linalg.det(axes)[pairs]
        regular = np.abs(np.linalg.det(mean)) > 0.2 * np.abs(det).max(axis=1, initial=1e-9)
        offset[turn, regular] = np.linalg.solve(mean[regular], move[regular, :, None])[..., 0]
    return pairs, offset


Way = tuple[int, bool, int]  # quarter turns, rows from the top, first id modulo columns


def _ways(size: GridSize) -> list[Way]:
    turns = range(4) if size.tags > 1 else (0,)  # of a single tag any turn is as good
    return [*product(turns, (False, True)[: min(size.rows, 2)], range(size.columns))]


def _agree(ids: Index, pairs: Index, offset: Array, way: Way, size: GridSize) -> Mask:
    """Return for which pairs (P,) of tags the steps between them are those that ids say."""
    turn, from_top, residue = way
    row, column = np.divmod(ids - residue, size.columns)
    place = np.stack([column, -row if from_top else row], axis=-1)
    expected = place[pairs[:, 1]] - place[pairs[:, 0]]
    off = np.abs(offset[turn] - expected).max(axis=-1)
    close = off < _TOLERANCE + _TOLERANCE_GROWTH * np.abs(expected).max(axis=-1, initial=0)
    return np.asarray(close & expected.any(axis=-1))


def _neighboring(offset: Array) -> Mask:
    """Return which pairs (P,) are a step apart along an axis, as tags of one grid are."""
    far = np.abs(offset[0])
    return np.asarray((np.abs(far.max(axis=-1) - 1) < _TOLERANCE) & (far.min(axis=-1) < 0.35))


def _one_grid(
    ids: Index, pairs: Index, size: GridSize, layout: TagLayout | None
) -> tuple[Index, int]:
    """Return which tags (K,) are of one grid, and how many are of another one."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    joined = coo_array((np.ones(len(pairs)), pairs.T), (len(ids), len(ids)))
    label = connected_components(joined, directed=False)[1]
    first = layout.first if layout else 0
    expected = (ids >= first) & (ids < first + size.tags)
    groups = [np.flatnonzero(label == number) for number in np.unique(label)]
    # A grid with the ids of the target comes before a larger one with others.
    grid = max(groups, key=lambda group: (len(group) > 1 and expected[group].any(), len(group)))
    return grid, sum(len(group) for group in groups if group is not grid and len(group) > 1)


def _firsts(ids: Index, residue: int, size: GridSize) -> list[int]:
    """Return which least ids of a grid leave all of these inside it; 0 if need be."""
    low, high = int(ids.min()), int(ids.max())
    return [
        first for first in range(residue, low + 1, size.columns) if first > high - size.tags
    ] or [0] * (residue == 0 and low < size.tags)


def _choose(layouts: frozenset[TagLayout]) -> TagLayout | None:
    """Return the layout that is meant: the only standard one, or else the only one."""
    standard = [layout for layout in layouts if layout.is_standard] or [
        layout for layout in layouts if layout.first == 0
    ]
    open_ones = standard or [*layouts]
    return open_ones[0] if len(open_ones) == 1 else None


def _points(ids: Index, corners: Array, layout: TagLayout, size: GridSize) -> tuple[Index, Array]:
    """Return points (M,) of the target's, and where they are (M, 2), of tags within it."""
    place = ids - layout.first
    inside = (place >= 0) & (place < size.tags)
    row, column = np.divmod(place[inside], size.columns)
    row = size.rows - 1 - row if layout.from_top else row
    index = 4 * (row * size.columns + column)[:, None] + np.arange(4)
    uv = corners[inside][:, np.roll(_ORDER, -layout.turn)]
    return index.reshape(-1).astype(np.int64), uv.reshape(-1, 2).astype(float)


def _wrong_columns(ids: Index, pairs: Index, offset: Array, size: GridSize) -> str:
    """Return that ids grow by another number from row to row than the target has columns."""
    steps = np.abs(offset)
    above = (steps[:, 0] < _TOLERANCE) & (np.abs(steps[:, 1] - 1) < _TOLERANCE)
    apart = np.abs(np.diff(ids[pairs[above]], axis=1)).ravel()
    usual = int(np.bincount(apart).argmax()) if len(apart) > 1 else size.columns
    if usual < 2 or usual == size.columns or 2 * (apart == usual).sum() < len(apart):
        return ''
    return f'no board found: ids grow by {usual} from row to row, and tagCols is {size.columns}'


def _ambiguity(layouts: frozenset[TagLayout]) -> str:
    if not layouts:
        return 'no board found: ids of its tags are beyond the grid'
    if len({layout.turn for layout in layouts}) > 1:
        return 'no board found: a single tag does not show how the grid is printed'
    return 'no board found: ids do not begin at 0; show the whole grid in at least one photograph'
