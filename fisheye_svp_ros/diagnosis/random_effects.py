"""The random parts of the null model: what targets, frames and lenses have of their own.

Every component is a set of columns whose coefficients are drawn from one normal distribution (the
offsets of landmarks from a t distribution); the variances come from the data (`mixed`).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.diagnosis.gathered import GatheredPoints, Setting
from fisheye_svp_ros.diagnosis.model import Linearised

STAGE_OF = {
    'image_broad': 'lens', 'image_coarse': 'lens', 'image_fine': 'lens', 'image_finest': 'lens',
    'landmark_in_plane': 'target', 'landmark_normal': 'target', 'landmark': 'target',
    'board_stretch': 'target', 'board_in_plane': 'target', 'board_normal': 'target',
    'frame_focal': 'frame', 'frame_centre': 'frame', 'frame_linear': 'frame',
    'frame_quadratic': 'frame', 'frame_bumps': 'frame', 'frame_bend': 'frame',
}
NAMES = tuple(STAGE_OF)
_STATIC = (('image_broad', 3, 0.5), ('image_coarse', 6, 0.5), ('image_fine', 14, 3.0),
           ('image_finest', 26, 3.0))
_FRAME_CELLS, _BOARD_CELLS = 4, 4
_FEWEST_ON_BOARD = 12
_REACH = 3.0  # of a bump, in its standard deviations
_WIDTH = 0.65  # standard deviation of a bump over the distance of its neighbours


class Grid(NamedTuple):
    """Bumps over the image of one camera: component, camera, centres (K, 2) and pitch, px."""

    name: str
    camera: int
    centres: Array
    pitch: float


class BoardField(NamedTuple):
    """Smooth displacements of one board along some of its axes: values (L, K) at the landmarks."""

    name: str
    axes: tuple[int, ...]
    values: Array


class Design(NamedTuple):
    """Columns of the random coefficients, whitened, and the component of each.

    frame (F, M, B): of coefficients that each frame has for itself, frame_label (B,);
    place (F, N, 2, 3) by landmark_slot (F, N): offsets of landmarks (L,), landmark_label (L, 3);
    shared: sparse (F M, Q), shared_label (Q,), of grids (u and v of each bump), then of fields
    (axis by axis); axes (L, 3, 3): of the board of each landmark; -1 labels what is not there.
    """

    frame: Array
    frame_label: Index
    place: Array
    slot: Index
    landmark: Index
    landmark_label: Index
    shared: sparse.csr_array
    shared_label: Index
    grids: tuple[Grid, ...]
    fields: tuple[BoardField, ...]
    axes: Array

    @property
    def offsets(self) -> sparse.csr_array:
        """Columns (F M, 3 L) of the offsets of landmarks, sparse; zero for what is not there."""
        row, place = np.arange(self.slot.size * 2), self.place.reshape(-1, 3)
        slot = np.repeat(self.slot.ravel(), 2)
        values = np.where((slot >= 0)[:, None] & (self.landmark_label[slot] >= 0), place, 0.0)
        column = 3 * np.maximum(slot, 0)[:, None] + np.arange(3)
        return sparse.csr_array(
            (values.ravel(), (np.repeat(row, 3), column.ravel())),
            (len(row), 3 * len(self.landmark)),
        )

    def kept(self, alive: Mask) -> Design:
        """Return the design with some of the components (`NAMES`) only."""
        known = np.append(alive, False)
        columns, shared = known[self.frame_label], known[self.shared_label]
        landmark = np.where(known[self.landmark_label], self.landmark_label, -1)
        return self._replace(
            frame=self.frame[..., columns], frame_label=self.frame_label[columns],
            landmark_label=landmark, shared=self.shared[:, shared],
            shared_label=self.shared_label[shared],
            grids=tuple(g for g in self.grids if known[NAMES.index(g.name)]),
            fields=tuple(f for f in self.fields if known[NAMES.index(f.name)]),
        )


def design(linear: Linearised, finest: bool = False, setting: Setting | None = None) -> Design:
    """Build the columns of every component that the data can hold; finest: of the image, too.

    setting: of the data that the variances are of, None for these; with it every component has
    its columns, and what stays with a target those views alone that show it.
    """
    points = GatheredPoints.of(linear, setting)
    frame, label = _frame_columns(points, setting is None)
    static = list(_grids(points, finest) if setting is None else
                  _all_grids(points, setting.finest))
    grids, fields = [grid for grid, _ in static], _board_fields(points)
    weight = points.weight.reshape(-1, 1)
    parts = [_moving_both(bumps.multiply(weight).tocsr()) for _, bumps in static]
    parts += [_field_columns(points, field) for field in fields]
    names = [grid.name for grid in grids] + [field.name for field in fields]
    of = [np.full(part.shape[1], NAMES.index(n)) for n, part in zip(names, parts, strict=True)]
    rows = points.weight.size * 2
    in_plane, normal, free = (
        NAMES.index(name) for name in ('landmark_in_plane', 'landmark_normal', 'landmark')
    )
    kinds = [[in_plane, in_plane, normal] if one.flat else [free] * 3 for one in points.boards]
    return Design(
        frame, label, points.place, points.slot, points.landmark,
        np.array(kinds)[points.of_landmark],
        sparse.hstack([sparse.csr_array((rows, 0)), *parts], format='csr'),
        np.concatenate([np.zeros(0, dtype=np.int64), *of]), tuple(grids), tuple(fields),
        np.stack([one.axes for one in points.boards])[points.of_landmark],
    )


def _frame_columns(points: GatheredPoints, compact: bool) -> tuple[Array, Index]:
    """Return columns (F, M, B) and labels (B,) of what single frames have of their own."""
    blocks: list[tuple[str, Array]] = []
    for camera, (low, high) in enumerate(points.extents):
        mine = points.used & (points.camera == camera)
        if not mine.any():
            continue
        half = float((high - low).max()) / 2
        x, y = np.moveaxis((points.uv - (low + high) / 2) / half, -1, 0)
        weight = points.weight * mine
        radial = np.stack([x, y], axis=-1)[..., None] * weight[..., None, None]
        blocks.append(('frame_focal', radial))
        for name, degree in (('frame_centre', 0), ('frame_linear', 1), ('frame_quadratic', 2)):
            powers = np.stack([x ** (degree - j) * y**j for j in range(degree + 1)], axis=-1)
            blocks.append((name, _both(powers * weight[..., None])))
        pitch = 2 * half / _FRAME_CELLS
        bumps = bump_values(points.uv, mine, _over(points, mine, pitch), pitch).toarray()
        bumps = bumps.reshape(*mine.shape, -1) * weight[..., None]
        blocks.append(('frame_bumps', _both(_compact(bumps) if compact else bumps)))
    blocks.append(('frame_bend', _bend_columns(points)))
    columns = np.concatenate([block for _, block in blocks], axis=-1)
    label = np.concatenate([
        np.full(block.shape[-1], NAMES.index(name)) for name, block in blocks
    ])
    frames, count = points.used.shape
    return columns.reshape(frames, 2 * count, -1), label


def _over(points: GatheredPoints, mine: Mask, pitch: float) -> Array:
    """Return centres of bumps over the extent of a camera and over all its points."""
    low, high = points.extents[int(points.camera[mine][0])]
    uv = points.uv[mine]
    return hexagons(np.minimum(low, uv.min(axis=0)), np.maximum(high, uv.max(axis=0)), pitch)


def _bend_columns(points: GatheredPoints) -> Array:
    """Return columns (F, N, 2, 3 boards) of a bend of each board, anew in every frame."""
    x, y = np.moveaxis(points.local, -1, 0)
    powers = np.stack([x * x, x * y, y * y], axis=-1)
    bend = points.place[..., 2:] * powers[..., None, :]
    boards = len(points.boards)
    mine = (points.slot >= 0)[..., None] & (points.board[..., None] == np.arange(boards))
    columns = bend[..., None, :] * mine[..., None, :, None]
    return np.asarray(columns.reshape(*columns.shape[:3], -1))


def _grids(points: GatheredPoints, finest: bool) -> Iterator[tuple[Grid, sparse.csr_array]]:
    """Yield bumps over the image that all frames share, camera by camera, coarse to fine.

    Each grid with its values (F N, K) at the points.
    """
    for camera, (low, high) in enumerate(points.extents):
        mine = points.used & (points.camera == camera)
        if not mine.any():
            continue
        for name, most, fewest in _STATIC[: 4 if finest else 3]:
            fits = max(int(np.sqrt(mine.sum() / fewest)), 16)
            cells = min(most, fits) if name == 'image_finest' else most
            pitch = max(float((high - low).max()) / cells, 1e-9)
            centres = hexagons(low, high, pitch)
            bumps = bump_values(points.uv, mine, centres, pitch)
            seen = np.asarray(bumps.sum(axis=0)) > 4.0
            # A grid finer than the points is noise by another name.
            if seen.any() and mine.sum() >= fewest * seen.sum():
                yield Grid(name, camera, centres[seen], pitch), bumps[:, seen]


def _all_grids(
    points: GatheredPoints, finest: float
) -> Iterator[tuple[Grid, sparse.csr_array]]:
    """Yield the bumps wherever there are points; finest: pitch of the finest grid, px, or NaN."""
    for camera, (low, high) in enumerate(points.extents):
        mine = points.used & (points.camera == camera)
        for name, most, _ in _STATIC if mine.any() else ():
            pitch = finest if name == 'image_finest' else float((high - low).max()) / most
            if np.isfinite(pitch):
                centres = _over(points, mine, pitch)
                yield (Grid(name, camera, centres, pitch),
                       bump_values(points.uv, mine, centres, pitch))


def _board_fields(points: GatheredPoints) -> list[BoardField]:
    """Return smooth displacements of boards, along and across them: neighbours err alike.

    Along it, what is linear has its own variance: paper stretches as a whole.  Across it, the
    smooth shapes that the catalogue has are taken out.
    """
    fields = []
    for i, board in enumerate(points.boards):
        mine = points.of_landmark == i
        if not board.flat or mine.sum() < _FEWEST_ON_BOARD:
            continue
        at = points.at[mine]
        pitch = max(float(np.ptp(at, axis=0).max()) / _BOARD_CELLS, 1e-9)
        centres = hexagons(at.min(axis=0), at.max(axis=0), pitch)
        bumps = bump_values(at, np.ones(len(at), dtype=bool), centres, pitch).toarray()
        stretch = np.zeros((len(points.at), 2))
        stretch[mine] = at - at.mean(axis=0)
        fields.append(BoardField('board_stretch', (0, 1), stretch))
        smooth = ('board_in_plane', (0, 1), 1), ('board_normal', (2,), board.highest_degree)
        for name, axes, degree in smooth:
            values = np.zeros((len(points.at), len(centres)))
            values[mine] = _outside_powers(bumps, at, degree)
            kept = np.sqrt((values**2).sum(axis=0)) > 0.05
            if kept.any():
                fields.append(BoardField(name, axes, values[:, kept]))
    return fields


def _outside_powers(values: Array, at: Array, degree: int) -> Array:
    """Take the best polynomial of places (L, 2) out of values (L, K)."""
    x, y = at.T
    powers = np.stack(
        [x ** (total - j) * y**j for total in range(degree + 1) for j in range(total + 1)], axis=-1
    )
    return np.asarray(values - powers @ np.linalg.lstsq(powers, values, rcond=1e-9)[0])


def _field_columns(points: GatheredPoints, field: BoardField) -> sparse.csr_array:
    values = np.where(points.slot[..., None] >= 0, field.values[points.slot], 0.0)
    columns = [values[..., None, :] * points.place[..., axis, None] for axis in field.axes]
    return sparse.csr_array(np.concatenate(columns, axis=-1).reshape(points.used.size * 2, -1))


def hexagons(low: Array, high: Array, pitch: float) -> Array:
    """Return the centres (K, 2) of a hexagonal grid of a pitch over a rectangle."""
    columns = np.arange(low[0] - pitch / 2, high[0] + pitch, pitch)
    rows = np.arange(low[1] - pitch / 2, high[1] + pitch, pitch * np.sqrt(0.75))
    return np.array([(x + pitch / 2 * (j % 2), y) for j, y in enumerate(rows) for x in columns])


def bump_values(at: Array, mine: Mask, centres: Array, pitch: float) -> sparse.csr_array:
    """Return Gaussian bumps (n, K) at places (..., 2), zero out of reach and not of `mine`."""
    sd = _WIDTH * pitch
    near = cKDTree(at[mine]).sparse_distance_matrix(
        cKDTree(centres), _REACH * sd, output_type='ndarray')
    row = np.flatnonzero(mine)[near['i']]
    values = np.exp(-((near['v'] / sd) ** 2) / 2)
    return sparse.csr_array((values, (row, near['j'])), (mine.size, len(centres)))


def _compact(columns: Array) -> Array:
    """Move the columns (F, N, K) that a frame has to the front: most frames lack most of them."""
    weight = columns.sum(axis=1)
    kept = weight > 2.0 * np.median(columns.max(axis=(1, 2)))
    width = int(kept.sum(axis=1).max())
    order = np.argsort(~kept, axis=1, kind='stable')[:, :width]
    packed = np.take_along_axis(columns * kept[:, None, :], order[:, None, :], axis=2)
    return np.asarray(packed)


def _both(values: Array) -> Array:
    """Return columns (F, N, 2, 2 K) that move u and v apart by values (F, N, K)."""
    columns = np.zeros((*values.shape[:2], 2, values.shape[-1], 2))
    columns[..., 0, :, 0] = values
    columns[..., 1, :, 1] = values
    return columns.reshape(*values.shape[:2], 2, -1)


def _moving_both(values: sparse.csr_array) -> sparse.csr_array:
    """Return columns (2 n, 2 K) that move u and v apart by values (n, K)."""
    return sparse.csr_array(sparse.kron(values, np.eye(2), 'csr'))
