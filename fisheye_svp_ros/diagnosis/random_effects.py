"""The random effects of the null model: what targets, frames and lenses have of their own.

Every component is a set of columns whose coefficients are drawn from one normal distribution (the
offsets of landmarks from a t distribution); the variances come from the data (`mixed_model`).
Frames are the groups of the mixed model, landmarks its units.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy import sparse

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.diagnosis.effect_forms import bump_values, hexagons
from fisheye_svp_ros.diagnosis.gathered_points import ColumnGeometry, GatheredPoints
from fisheye_svp_ros.mixed_model import Components, RandomColumns
from fisheye_svp_ros.solve.rig_state import Linearization

SAG = 'frame_sag'
STAGE_OF = {
    'image_broad': 'lens', 'image_coarse': 'lens', 'image_fine': 'lens', 'image_finest': 'lens',
    'landmark_in_plane': 'target', 'landmark_normal': 'target', 'landmark': 'target',
    'board_stretch': 'target', 'board_in_plane': 'target', 'board_normal': 'target',
    'frame_focal': 'frame', 'frame_centre': 'frame', 'frame_linear': 'frame',
    'frame_quadratic': 'frame', 'frame_bumps': 'frame', 'frame_bend': 'frame',
    SAG: 'frame',
}
NAMES = tuple(STAGE_OF)
OF_LANDMARKS = np.array([name.startswith('landmark') for name in NAMES])  # components
_NUMEROUS = np.isin(NAMES, ('frame_bumps', 'image_finest'))  # coefficients, seldom called for
_IMAGE_GRIDS = (('image_broad', 3, 0.5), ('image_coarse', 6, 0.5), ('image_fine', 14, 3.0),
           ('image_finest', 26, 3.0))
_FRAME_CELLS, _BOARD_CELLS = 4, 4
_MIN_LANDMARKS = 12


class ImageGrid(NamedTuple):
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


class RandomEffects(NamedTuple):
    """The random columns of a state, and what they stand for.

    landmark (L,): ids of the units; grids, fields: what the shared columns are of, grids first (u
    and v of each bump), fields last (axis by axis); axes (L, 3, 3): of the board of each landmark.
    """

    columns: RandomColumns
    landmark: Index
    grids: tuple[ImageGrid, ...]
    fields: tuple[BoardField, ...]
    axes: Array

    def select(self, alive: Mask) -> RandomEffects:
        """Return the effects of some of the components (`NAMES`) only."""
        return self._replace(
            columns=self.columns.select(alive),
            grids=tuple(g for g in self.grids if alive[NAMES.index(g.name)]),
            fields=tuple(f for f in self.fields if alive[NAMES.index(f.name)]),
        )

    @property
    def grid_columns(self) -> int:
        """How many of the shared columns, the first ones, belong to grids."""
        return sum(2 * len(grid.centres) for grid in self.grids)


def make_random_effects(
    linear: Linearization, finest: bool = False, geometry: ColumnGeometry | None = None
) -> RandomEffects:
    """Build the columns of every component that the data can hold; finest: of the image, too.

    geometry: of the data that the variances are of, None for these; with it every component has
    its columns, and what stays with a target those views alone that show it.
    """
    points = GatheredPoints.gather(linear, geometry)
    frame, label = _frame_columns(points, geometry is None)
    static = list(_image_grids(points, finest) if geometry is None else
                  _complete_grids(points, geometry.finest))
    grids, fields = [grid for grid, _ in static], _board_fields(points)
    weight = points.weight.reshape(-1, 1)
    parts = [_move_both_axes(bumps.multiply(weight).tocsr()) for _, bumps in static]
    names = [grid.name for grid in grids]
    if linear.data.poses is None:  # else the camera moves, and gravity beside it
        parts.append(_sag_columns(points, linear.state.pose.rotation))
        names.append(SAG)
    combinations = [_combine_offsets(field) for field in fields]
    of = [np.full(part.shape[1], NAMES.index(name)) for name, part in zip(
        [*names, *(field.name for field in fields)], [*parts, *combinations], strict=True)]
    in_plane, normal, free = (
        NAMES.index(name) for name in ('landmark_in_plane', 'landmark_normal', 'landmark')
    )
    landmarks = points.landmarks
    kinds = [[in_plane, in_plane, normal] if one.flat else [free] * 3
             for one in landmarks.boards]
    columns = RandomColumns(
        frame, label, points.place, points.slot, np.array(kinds)[landmarks.board_of],
        _join_columns(points.weight.size * 2, parts),
        _join_columns(landmarks.ids.size * 3, combinations),
        np.concatenate([np.zeros(0, dtype=np.int64), *of]),
        Components(OF_LANDMARKS, _NUMEROUS),
    )
    axes = np.stack([one.axes for one in landmarks.boards])[landmarks.board_of]
    return RandomEffects(columns, landmarks.ids, tuple(grids), tuple(fields), axes)


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
            blocks.append((name, _on_both_axes(powers * weight[..., None])))
        pitch = 2 * half / _FRAME_CELLS
        bumps = bump_values(points.uv, mine, _cover_points(points, mine, pitch), pitch).toarray()
        bumps = bumps.reshape(*mine.shape, -1) * weight[..., None]
        bumps = _compact_columns(bumps) if compact else bumps
        blocks.append(('frame_bumps', _on_both_axes(bumps)))
    blocks.append(('frame_bend', _bend_columns(points)))
    columns = np.concatenate([block for _, block in blocks], axis=-1)
    label = np.concatenate([
        np.full(block.shape[-1], NAMES.index(name)) for name, block in blocks
    ])
    frames, count = points.used.shape
    return columns.reshape(frames, 2 * count, -1), label


def _cover_points(points: GatheredPoints, mine: Mask, pitch: float) -> Array:
    """Return centres of bumps over the extent of a camera and over all its points."""
    low, high = points.extents[int(points.camera[mine][0])]
    uv = points.uv[mine]
    return hexagons(np.minimum(low, uv.min(axis=0)), np.maximum(high, uv.max(axis=0)), pitch)


def _bend_columns(points: GatheredPoints) -> Array:
    """Return columns (F, N, 2, 3 boards) of a bend of each board, anew in every frame."""
    x, y = np.moveaxis(points.local, -1, 0)
    powers = np.stack([x * x, x * y, y * y], axis=-1)
    bend = points.place[..., 2:] * powers[..., None, :]
    boards = len(points.landmarks.boards)
    mine = (points.slot >= 0)[..., None] & (points.board[..., None] == np.arange(boards))
    columns = bend[..., None, :] * mine[..., None, :, None]
    return np.asarray(columns.reshape(*columns.shape[:3], -1))


def _sag_columns(points: GatheredPoints, rotation: Array) -> sparse.csr_array:
    """Return columns (2 F N, 9 boards) of a bend of each board in proportion to its normal.

    rotation (F, 3, 3): of the camera or rig.  A board that sags by its own weight bends by
    b (n . g), n its normal and g the direction of gravity, which stands still beside a camera
    that does.
    """
    bend, boards = _bend_columns(points), points.landmarks.boards
    normals = np.array([one.axes[2] for one in boards]) @ rotation  # (F, boards, 3)
    parts = bend.reshape(*bend.shape[:3], len(boards), 3)[..., None]
    columns = parts * normals[:, None, None, :, None]
    return sparse.csr_array(columns.reshape(points.used.size * 2, -1))


def _image_grids(
    points: GatheredPoints, finest: bool
) -> Iterator[tuple[ImageGrid, sparse.csr_array]]:
    """Yield bumps over the image that all frames share, camera by camera, coarse to fine.

    Each grid with its values (F N, K) at the points.
    """
    for camera, (low, high) in enumerate(points.extents):
        mine = points.used & (points.camera == camera)
        if not mine.any():
            continue
        for name, most, fewest in _IMAGE_GRIDS[: 4 if finest else 3]:
            fits = max(int(np.sqrt(mine.sum() / fewest)), 16)
            cells = min(most, fits) if name == 'image_finest' else most
            pitch = max(float((high - low).max()) / cells, 1e-9)
            centres = hexagons(low, high, pitch)
            bumps = bump_values(points.uv, mine, centres, pitch)
            seen = np.asarray(bumps.sum(axis=0)) > 4.0
            # A grid finer than the points is noise by another name.
            if seen.any() and mine.sum() >= fewest * seen.sum():
                yield ImageGrid(name, camera, centres[seen], pitch), bumps[:, seen]


def _complete_grids(
    points: GatheredPoints, finest: float
) -> Iterator[tuple[ImageGrid, sparse.csr_array]]:
    """Yield the bumps wherever there are points; finest: pitch of the finest grid, px, or NaN."""
    for camera, (low, high) in enumerate(points.extents):
        mine = points.used & (points.camera == camera)
        for name, most, _ in _IMAGE_GRIDS if mine.any() else ():
            pitch = finest if name == 'image_finest' else float((high - low).max()) / most
            if np.isfinite(pitch):
                centres = _cover_points(points, mine, pitch)
                yield (ImageGrid(name, camera, centres, pitch),
                       bump_values(points.uv, mine, centres, pitch))


def _board_fields(points: GatheredPoints) -> list[BoardField]:
    """Return smooth displacements of boards, along and across them: neighbours err alike.

    Along it, what is linear has its own variance: paper stretches as a whole.  Across it, the
    smooth shapes that the catalogue has are taken out.
    """
    fields = []
    for i, board in enumerate(points.landmarks.boards):
        mine = points.landmarks.board_of == i
        if not board.flat or mine.sum() < _MIN_LANDMARKS:
            continue
        at = points.landmarks.at[mine]
        pitch = max(float(np.ptp(at, axis=0).max()) / _BOARD_CELLS, 1e-9)
        centres = hexagons(at.min(axis=0), at.max(axis=0), pitch)
        bumps = bump_values(at, np.ones(len(at), dtype=bool), centres, pitch).toarray()
        stretch = np.zeros((len(points.landmarks.at), 2))
        stretch[mine] = at - at.mean(axis=0)
        fields.append(BoardField('board_stretch', (0, 1), stretch))
        smooth = ('board_in_plane', (0, 1), 1), ('board_normal', (2,), board.highest_degree)
        for name, axes, degree in smooth:
            values = np.zeros((len(points.landmarks.at), len(centres)))
            values[mine] = _remove_polynomial(bumps, at, degree)
            kept = np.sqrt((values**2).sum(axis=0)) > 0.05
            if kept.any():
                fields.append(BoardField(name, axes, values[:, kept]))
    return fields


def _remove_polynomial(values: Array, at: Array, degree: int) -> Array:
    """Take the best polynomial of places (L, 2) out of values (L, K)."""
    x, y = at.T
    powers = np.stack(
        [x ** (total - j) * y**j for total in range(degree + 1) for j in range(total + 1)], axis=-1
    )
    return np.asarray(values - powers @ np.linalg.lstsq(powers, values, rcond=1e-9)[0])


def _combine_offsets(field: BoardField) -> sparse.csr_array:
    """Return a field as combinations (3 L, K axes) of the offsets of landmarks."""
    count, width = field.values.shape
    columns = np.zeros((count, 3, len(field.axes), width))
    columns[:, field.axes, np.arange(len(field.axes))] = field.values[:, None]
    return sparse.csr_array(columns.reshape(3 * count, -1))


def _join_columns(rows: int, parts: list[sparse.csr_array]) -> sparse.csr_array:
    return sparse.csr_array(sparse.hstack([sparse.csr_array((rows, 0)), *parts], format='csr'))


def _compact_columns(columns: Array) -> Array:
    """Move the columns (F, N, K) that a frame has to the front: most frames lack most of them."""
    weight = columns.sum(axis=1)
    kept = weight > 2.0 * np.median(columns.max(axis=(1, 2)))
    width = int(kept.sum(axis=1).max())
    order = np.argsort(~kept, axis=1, kind='stable')[:, :width]
    packed = np.take_along_axis(columns * kept[:, None, :], order[:, None, :], axis=2)
    return np.asarray(packed)


def _on_both_axes(values: Array) -> Array:
    """Return columns (F, N, 2, 2 K) that move u and v apart by values (F, N, K)."""
    columns = np.zeros((*values.shape[:2], 2, values.shape[-1], 2))
    columns[..., 0, :, 0] = values
    columns[..., 1, :, 1] = values
    return columns.reshape(*values.shape[:2], 2, -1)


def _move_both_axes(values: sparse.csr_array) -> sparse.csr_array:
    """Return columns (2 n, 2 K) that move u and v apart by values (n, K)."""
    return sparse.csr_array(sparse.kron(values, np.eye(2), 'csr'))
