"""The random effects of the null model: what targets, frames and lenses have of their own.

Every component is a set of columns whose coefficients are drawn from one normal distribution (the
offsets of landmarks from a t distribution); the variances come from the data (`mixed_model`).
Frames are the groups of the mixed model, landmarks its units.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.diagnosis.effect_forms import bump_values, hexagons
from fisheye_svp_ros.effects.extension import Target
from fisheye_svp_ros.effects.target_map import KnownTarget
from fisheye_svp_ros.mixed_model import Components, RandomColumns
from fisheye_svp_ros.scene.boards import Board, find_boards
from fisheye_svp_ros.solve.rig_state import Linearization

MILLIMETRE = 1e-3  # unit of offsets on the target
BEND, SAG, MOTION = 'frame_bend', 'frame_sag', 'frame_motion'
STAGE_OF = {
    'image_broad': 'lens',
    'image_coarse': 'lens',
    'image_fine': 'lens',
    'image_finest': 'lens',
    'landmark_in_plane': 'target',
    'landmark_normal': 'target',
    'landmark': 'target',
    'board_stretch': 'target',
    'board_in_plane': 'target',
    'board_normal': 'target',
    'frame_focal': 'frame',
    'frame_centre': 'frame',
    'frame_linear': 'frame',
    'frame_quadratic': 'frame',
    'frame_bumps': 'frame',
    BEND: 'frame',
    SAG: 'frame',
    MOTION: 'frame',
}
NAMES = tuple(STAGE_OF)
# Whose sizes are lengths on the target; those of all others are px
IN_MILLIMETRES = {*(name for name in NAMES if STAGE_OF[name] == 'target'), 'frame_bend', SAG}
OF_LANDMARKS = np.array([name.startswith('landmark') for name in NAMES])  # components
# Of many coefficients, seldom called for: asked for beside all others that are there.
_NUMEROUS = np.isin(NAMES, ('frame_bumps', 'image_fine', 'image_finest'))
_IMAGE_GRIDS = (
    ('image_broad', 3, 0.5),
    ('image_coarse', 6, 0.5),
    ('image_fine', 14, 3.0),
    ('image_finest', 26, 3.0),
)
_FRAME_CELLS, _BOARD_CELLS = 4, 4
_MIN_LANDMARKS = 12


class ImageGrid(NamedTuple):
    """Bumps over the image of one camera: component, camera, centers (K, 2) and pitch, px."""

    name: str
    camera: int
    centers: Array
    pitch: float


class RandomEffects(NamedTuple):
    """The random columns of a state, and what they stand for.

    landmark (L,): ids of the units; grids: what the first of the shared columns are of (u and v of
    each bump); axes (L, 3, 3): of the board of each landmark; normals (boards, 3): see
    `ColumnGeometry`.
    """

    columns: RandomColumns
    landmark: Index
    grids: tuple[ImageGrid, ...]
    axes: Array
    normals: Array

    def select(self, alive: Mask) -> RandomEffects:
        """Return the effects of some of the components (`NAMES`) only."""
        return self._replace(
            columns=self.columns.select(alive),
            grids=tuple(grid for grid in self.grids if alive[NAMES.index(grid.name)]),
        )

    @property
    def grid_columns(self) -> int:
        """How many of the shared columns, the first ones, belong to grids."""
        return sum(2 * len(grid.centers) for grid in self.grids)


class ColumnGeometry(NamedTuple):
    """What the columns rest on, for data other than those that the variances are of.

    extents (C, 2, 2), px: least and largest u, v by camera; finest, px: pitch of the finest grid,
    NaN without one; target: its L landmarks;
    modes (L, 3, K) and alone (L, 3), m: how far its landmarks are off along the axes of their
    boards, each as a sum of the modes, drawn once for all, and of what it has alone; normals
    (boards, 3): means over the frames, by the axes of the camera or rig.
    """

    extents: Array
    finest: float
    target: KnownTarget
    modes: Array
    alone: Array
    normals: Array

    @classmethod
    def measure(
        cls, linear: Linearization, finest: float, modes: Array, alone: Array, normals: Array
    ) -> ColumnGeometry:
        """Return that of a linearized state; modes, alone, normals: see above."""
        target = KnownTarget.from_views(linear.data.views)
        return cls(_extents(linear), finest, target, modes, alone, normals)


class _Landmarks(NamedTuple):
    """The landmarks of a target: ids (L,), its boards, that of each (L,), place on it (L, 2).

    board_of (L,): among `boards`; at (L, 2): place on the board over its size.
    """

    ids: Index
    boards: list[Board]
    board_of: Index
    at: Array

    @classmethod
    def of_target(cls, target: KnownTarget) -> _Landmarks:
        landmark, board, points = target
        boards = find_boards(points, board)
        board_of, at = np.zeros(len(points), dtype=np.int64), np.zeros((len(points), 2))
        for i, one in enumerate(boards):
            mine = board == one.id
            board_of[mine], at[mine] = i, one.to_board(points[mine])[:, :2]
        return cls(landmark, boards, board_of, at)

    @property
    def axes(self) -> Array:
        """The axes (L, 3, 3) of the board of each."""
        return np.stack([board.axes for board in self.boards])[self.board_of]


class _Points(NamedTuple):
    """The points of all frames, (F, N) each: N of all cameras; what a design is built from.

    used; uv (F, N, 2), px; weight, 1/px; camera; slot: place among the landmarks, -1 for none;
    place (F, N, 2, 3): whitened derivatives by an offset along the board's axes, per mm; extents
    (C, 2, 2), px: see `ColumnGeometry`.
    """

    used: Mask
    uv: Array
    weight: Array
    camera: Index
    slot: Index
    place: Array
    extents: Array
    landmarks: _Landmarks

    @classmethod
    def gather(cls, linear: Linearization, geometry: ColumnGeometry | None) -> _Points:
        """Gather the points of a linearized state; geometry: None for its own."""
        data, views = linear.data, linear.data.views

        def rows(values: Any) -> Array:
            return data.blocks(values[..., None])

        camera = np.broadcast_to(data.camera_of[:, None], views.landmark.shape)
        camera, landmark = (rows(of).astype(np.int64) for of in (camera, views.landmark))
        weight = rows(linear.weight)
        used = shown = weight > 0
        if geometry is None:
            extents, target = _extents(linear), KnownTarget.from_views(views)
        else:
            extents, target = geometry.extents, geometry.target
            shown = used & (rows(Target((), target).landmark_mask(views)) > 0)
        known = _Landmarks.of_target(target)
        slot = np.searchsorted(known.ids, landmark).clip(max=len(known.ids) - 1)
        slot = np.where(shown, slot, -1)
        place = linear.whiten(linear.linear.d_target).reshape(*used.shape, 2, 3) * MILLIMETRE
        place = place @ np.swapaxes(known.axes[slot], -1, -2)
        uv = data.blocks(np.nan_to_num(linear.linear.uv)[..., None, :])
        return cls(used, uv, weight, camera, slot, place, extents, known)


def _extents(linear: Linearization) -> Array:
    """Return the least and the largest u, v of each camera, (C, 2, 2), px; NaN without points."""
    uv, data = np.nan_to_num(linear.linear.uv), linear.data
    extents = np.full((data.cameras, 2, 2), np.nan)
    for camera in range(data.cameras):
        mine = data.views.used & (data.camera_of == camera)[:, None]
        if mine.any():
            extents[camera] = uv[mine].min(axis=0), uv[mine].max(axis=0)
    return extents


def make_random_effects(
    linear: Linearization, finest: bool = False, geometry: ColumnGeometry | None = None
) -> RandomEffects:
    """Build the columns of every component that the data can hold; finest: of the image, too.

    geometry: of the data that the variances are of, None for these; with it every component has
    its columns, and what stays with a target those views alone that show it.
    """
    points = _Points.gather(linear, geometry)
    frame, label = _frame_columns(points, linear, geometry is None)
    static = list(
        _image_grids(points, finest)
        if geometry is None
        else _complete_grids(points, geometry.finest)
    )
    grids, fields = [grid for grid, _ in static], list(_board_fields(points.landmarks))
    weight = points.weight.reshape(-1, 1)
    parts = [
        sparse.csr_array(sparse.kron(bumps.multiply(weight).tocsr(), np.eye(2), 'csr'))
        for _, bumps in static
    ]
    names = [grid.name for grid in grids]
    normals = np.zeros((len(points.landmarks.boards), 3))
    if linear.data.poses is None:  # else the camera moves, and gravity beside it
        middle = None if geometry is None else geometry.normals
        columns, normals = _sag_columns(points, linear.state.pose.rotation, middle)
        parts.append(columns)
        names.append(SAG)
    of = [
        np.full(part.shape[1], NAMES.index(name))
        for name, part in (*zip(names, parts, strict=True), *fields)
    ]
    landmarks = points.landmarks
    kinds = np.array(
        [
            [
                NAMES.index(name)
                for name in (
                    ('landmark_in_plane', 'landmark_in_plane', 'landmark_normal')
                    if board.flat
                    else ('landmark',) * 3
                )
            ]
            for board in landmarks.boards
        ]
    )
    every = RandomColumns(
        frame,
        label,
        points.place,
        points.slot,
        kinds[landmarks.board_of],
        _join_columns(points.weight.size * 2, parts),
        _join_columns(landmarks.ids.size * 3, [field for _, field in fields]),
        np.concatenate([np.zeros(0, dtype=np.int64), *of]),
        Components(OF_LANDMARKS, _NUMEROUS),
    )
    return RandomEffects(every, landmarks.ids, tuple(grids), landmarks.axes, normals)


def _frame_columns(points: _Points, linear: Linearization, compact: bool) -> tuple[Array, Index]:
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
    blocks.append((BEND, _bend_columns(points)))
    if linear.data.poses is None:  # else nothing is known of how the pose moves an image
        blocks.append((MOTION, _motion_columns(points, linear)))
    columns = np.concatenate([block for _, block in blocks], axis=-1)
    label = np.repeat(
        [NAMES.index(name) for name, _ in blocks], [block.shape[-1] for _, block in blocks]
    )
    frames, count = points.used.shape
    return columns.reshape(frames, 2 * count, -1), label


def _cover_points(points: _Points, mine: Mask, pitch: float) -> Array:
    """Return centers of bumps over the extent of a camera and over all its points."""
    low, high = points.extents[int(points.camera[mine][0])]
    uv = points.uv[mine]
    return hexagons(np.minimum(low, uv.min(axis=0)), np.maximum(high, uv.max(axis=0)), pitch)


def _bend_columns(points: _Points) -> Array:
    """Return columns (F, N, 2, 3 boards) of a bend of each board, anew in every frame."""
    known = points.landmarks
    x, y = np.moveaxis(known.at[points.slot], -1, 0)
    powers = np.stack([x * x, x * y, y * y], axis=-1)
    bend = points.place[..., 2:] * powers[..., None, :]
    board = np.where(points.slot < 0, -1, known.board_of[points.slot])
    mine = board[..., None] == np.arange(len(known.boards))
    columns = bend[..., None, :] * mine[..., None, :, None]
    return np.asarray(columns.reshape(*columns.shape[:3], -1))


def _motion_columns(points: _Points, linear: Linearization) -> Array:
    """Return columns (F, N, 2, 6) of a steady motion while the rows of an image are read.

    From the middle row on, over half an extent: a shift by the distance of the target, and a turn
    by a radian.  It is another in every frame, as of a camera in the hand.
    Source: Hedborg, Forssen, Felsberg and Ringaby, Rolling shutter bundle adjustment, CVPR (2012),
    section 3: the pose is linear in the row.
    """
    low, high = np.moveaxis(points.extents, 1, 0)
    half, middle = (high - low).max(axis=-1) / 2, (high + low)[:, 1] / 2
    row = (points.uv[..., 1] - middle[points.camera]) / half[points.camera]
    columns = linear.frame_columns.reshape(*points.used.shape, 2, 6)
    target = linear.data.views.points[linear.data.views.used].mean(axis=0)
    distance = np.linalg.norm(linear.state.pose.position - target, axis=1)
    per_pose = np.concatenate([distance[:, None]] * 3 + [np.ones((len(distance), 3))], axis=1)
    moved = columns * per_pose[:, None, None] * row[..., None, None]
    return np.where(points.used[..., None, None], moved, 0.0)


def board_bends(target: KnownTarget, coefficients: Array) -> Array:
    """Return by how much landmarks leave their boards in each frame (F, L), mm.

    coefficients (F, 3 boards): of the columns of `frame_bend`.  A plane is in the poses, and taken
    out.
    """
    known = _Landmarks.of_target(target)
    x, y = known.at.T
    powers = np.stack([x * x, x * y, y * y], axis=-1)
    heights = np.zeros((len(coefficients), len(x)))
    for board in range(len(known.boards)):
        mine = known.board_of == board
        shape = _remove_polynomial(powers[mine], known.at[mine], 1)
        heights[:, mine] = coefficients[:, 3 * board : 3 * board + 3] @ shape.T
    return heights


def _sag_columns(
    points: _Points, rotation: Array, middle: Array | None
) -> tuple[sparse.csr_array, Array]:
    """Return columns (2 F N, 9 boards) of a bend of each board by how its normal departs.

    And the means (boards, 3) of the normals that these are centered on, `middle` where given.
    rotation (F, 3, 3): of the camera or rig.  A board that sags by its own weight bends by
    b (n . g), n its normal and g the direction of gravity, which stands still beside a camera
    that does.  The mean is a bend that stays: left in, it would hide `target_shape`.
    """
    bend, boards = _bend_columns(points), points.landmarks.boards
    normals = np.array([board.axes[2] for board in boards]) @ rotation  # (F, boards, 3)
    parts = bend.reshape(*bend.shape[:3], len(boards), 3)[..., None]
    if middle is None:
        weight = (parts**2).sum(axis=(1, 2, 4, 5))  # of a frame: what it shows of a bend
        middle = (weight[..., None] * normals).sum(axis=0)
        middle = middle / np.maximum(weight.sum(axis=0), 1e-300)[:, None]
    columns = parts * (normals - middle)[:, None, None, :, None]
    return sparse.csr_array(columns.reshape(points.used.size * 2, -1)), middle


def _image_grids(points: _Points, finest: bool) -> Iterator[tuple[ImageGrid, sparse.csr_array]]:
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
            centers = hexagons(low, high, pitch)
            bumps = bump_values(points.uv, mine, centers, pitch)
            seen = np.asarray(bumps.sum(axis=0)) > 4.0
            # A grid finer than the points is noise by another name.
            if seen.any() and mine.sum() >= fewest * seen.sum():
                yield ImageGrid(name, camera, centers[seen], pitch), bumps[:, seen]


def _complete_grids(
    points: _Points, finest: float
) -> Iterator[tuple[ImageGrid, sparse.csr_array]]:
    """Yield the bumps wherever there are points; finest: pitch of the finest grid, px, or NaN."""
    for camera, (low, high) in enumerate(points.extents):
        mine = points.used & (points.camera == camera)
        for name, most, _ in _IMAGE_GRIDS if mine.any() else ():
            pitch = finest if name == 'image_finest' else float((high - low).max()) / most
            if np.isfinite(pitch):
                centers = _cover_points(points, mine, pitch)
                yield (
                    ImageGrid(name, camera, centers, pitch),
                    bump_values(points.uv, mine, centers, pitch),
                )


def _board_fields(landmarks: _Landmarks) -> Iterator[tuple[str, sparse.csr_array]]:
    """Yield smooth displacements of boards, along and across them: neighbors err alike.

    As combinations (3 L, K axes) of the offsets of landmarks.  Along a board, what is linear has
    its own variance: paper stretches as a whole.  Across it, the smooth shapes that the catalogue
    has are taken out.
    """
    for i, board in enumerate(landmarks.boards):
        mine = landmarks.board_of == i
        if not board.flat or mine.sum() < _MIN_LANDMARKS:
            continue
        at = landmarks.at[mine]
        pitch = max(float(np.ptp(at, axis=0).max()) / _BOARD_CELLS, 1e-9)
        centers = hexagons(at.min(axis=0), at.max(axis=0), pitch)
        bumps = bump_values(at, np.ones(len(at), dtype=bool), centers, pitch).toarray()
        yield 'board_stretch', _combine_offsets(at - at.mean(axis=0), mine, [0, 1])
        smooth = ('board_in_plane', [0, 1], 1), ('board_normal', [2], board.highest_degree)
        for name, axes, degree in smooth:
            values = _remove_polynomial(bumps, at, degree)
            values = values[:, np.sqrt((values**2).sum(axis=0)) > 0.05]
            if values.size:
                yield name, _combine_offsets(values, mine, axes)


def _remove_polynomial(values: Array, at: Array, degree: int) -> Array:
    """Take the best polynomial of places (L, 2) out of values (L, K)."""
    x, y = at.T
    powers = np.stack(
        [x ** (total - j) * y**j for total in range(degree + 1) for j in range(total + 1)], axis=-1
    )
    return np.asarray(values - powers @ np.linalg.lstsq(powers, values, rcond=1e-9)[0])


def _combine_offsets(values: Array, mine: Mask, axes: list[int]) -> sparse.csr_array:
    """Return values (M, K) of some of the landmarks (L,) along each of some axes."""
    columns = np.zeros((len(mine), 3, len(axes), values.shape[1]))
    columns[mine] = values[:, None, None] * np.eye(3)[:, axes, None]
    return sparse.csr_array(columns.reshape(3 * len(mine), -1))


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
    columns = values[..., None, :, None] * np.eye(2)[:, None]
    return np.asarray(columns.reshape(*values.shape[:2], 2, -1))
