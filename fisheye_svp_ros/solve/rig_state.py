"""What a bundle adjustment is of: views by frame and camera, and what is estimated from them."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.effects.base import Effect, ModelTerm, Scene, noise_scale
from fisheye_svp_ros.effects.forward import ForwardModel, LinearViews
from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.optics.lens import INTRINSICS, Lens, intrinsic_names, parameter_values
from fisheye_svp_ros.pose import Pose, cross_matrix
from fisheye_svp_ros.scene.observations import Observations, Views, group_views


@dataclass(frozen=True)
class RigViews:
    """A table as views by frame and camera.

    views: S views of up to N points; frame_of, camera_of (S,): which frame (0..F-1) and camera
    (0..C-1) a view belongs to; poses: true poses (F,) of the rig where they are known; table:
    where the views are from, None for views that are not of a table.
    """

    views: Views
    frame_of: Index
    camera_of: Index
    poses: Pose | None = None
    table: Observations | None = None

    @classmethod
    def of_one_camera(cls, views: Views) -> RigViews:
        """Return views that are a frame each."""
        count = len(views.frame)
        return cls(views, np.arange(count), np.zeros(count, dtype=np.int64))

    @property
    def observations(self) -> Observations:
        """The table that the views are from."""
        assert self.table is not None, 'these views are not of a table'
        return self.table

    @property
    def frames(self) -> int:
        return int(self.frame_of.max()) + 1

    @property
    def cameras(self) -> int:
        return int(self.camera_of.max()) + 1

    @property
    def first_views(self) -> Index:
        """The first view (F,) of each frame."""
        return np.unique(self.frame_of, return_index=True)[1]

    @property
    def frame_numbers(self) -> Index:
        """The numbers (F,) of the frames in the table."""
        return self.views.frame[self.first_views]

    def blocks(self, values: Array) -> Array:
        """Gather (S, N, 2, ...) by frame, (F, C * N * 2, ...), zero where a view is missing."""
        shape = (self.frames, self.cameras, *values.shape[1:])
        blocks = np.zeros(shape)
        blocks[self.frame_of, self.camera_of] = values
        rows = self.cameras * values.shape[1] * values.shape[2]
        return blocks.reshape(self.frames, rows, *values.shape[3:])

    def by_view(self, blocks: Array) -> Array:
        """Return blocks (F, C * N * 2) by view and point, (S, N, 2)."""
        return blocks.reshape(self.frames, self.cameras, -1, 2)[self.frame_of, self.camera_of]

    def select(self, kept: Mask) -> RigViews:
        """Return some of the views (S,), and the frames that they are of."""
        frames, frame_of = np.unique(self.frame_of[kept], return_inverse=True)
        poses = None if self.poses is None else self.poses.take(frames)
        return replace(
            self,
            views=self.views.take(kept),
            frame_of=frame_of.reshape(-1),
            camera_of=self.camera_of[kept],
            poses=poses,
        )


def group_by_frame(observations: Observations, poses: dict[int, Pose] | None = None) -> RigViews:
    """Group a table by frame and camera; sigma is 1 px where the table does not say.

    poses: true poses by frame number; they are kept fixed in adjustments.
    """
    views = group_views(observations)
    numbers, frame_of = np.unique(views.frame, return_inverse=True)
    _, camera_of = np.unique(views.camera, return_inverse=True)
    given_poses = None
    if poses is not None:
        given_poses = Pose.stack([poses[int(number)] for number in numbers])
    return RigViews(views, frame_of.reshape(-1), camera_of.reshape(-1), given_poses, observations)


@dataclass(frozen=True)
class RigState:
    """Poses (F,) of the rig's body, rig (C,) of the cameras in it, lens, effects.

    boards (C,): which board a camera sees, where each board has a pose that is estimated: the
    poses of boards 1 ... in the frame of board 0 follow those of the cameras in `rig`.
    others: the lenses of the further cameras of a rig, by whose names (`labels`) parameters and
    effects are told apart; without them every camera has the same lens.  terms: the effects and
    their values; corrected: whether the lens's own corrections act in place of them, unchanged.
    """

    pose: Pose
    rig: Pose
    lens: Lens
    terms: tuple[ModelTerm, ...]
    others: tuple[Lens, ...] = ()
    labels: tuple[str, ...] = ('',)
    corrected: bool = False
    boards: tuple[int, ...] = ()

    @property
    def lenses(self) -> tuple[Lens, ...]:
        """The lens of each camera of a rig, or the one of all."""
        return (self.lens, *self.others)

    @property
    def model(self) -> ForwardModel:
        """The forward model of all cameras."""
        return ForwardModel(self.lenses, None if self.corrected else self.terms)

    @property
    def parameters(self) -> dict[str, float]:
        """Values of the parameters of all lenses."""
        return {
            f'{label}.{name}' if label else name: value
            for label, lens in zip(self.labels, self.lenses, strict=True)
            for name, value in lens.parameters.items()
        }

    def lens_names(self, free: Sequence[str]) -> list[list[str]]:
        """Return which of some parameters each lens has, by their names there."""
        heads = [f'{label}.' if label else '' for label in self.labels]
        return [
            [name.removeprefix(head) for name in free if name.startswith(head)] for head in heads
        ]

    def shared_values(self, free: Sequence[str]) -> Array:
        """Return free intrinsics and the values of the effects that move image points, (K,)."""
        lens = [
            parameter_values(lens, names)
            for lens, names in zip(self.lenses, self.lens_names(free), strict=True)
        ]
        return np.concatenate(
            [*map(np.array, lens), *(term.values for term in self.terms if is_shared(term.effect))]
        )

    def with_shared_values(self, free: Sequence[str], values: Array) -> RigState:
        """Return the state with other free intrinsics and values of effects, (K,)."""
        lenses, terms = [], []
        for lens, names in zip(self.lenses, self.lens_names(free), strict=True):
            lenses.append(lens.with_parameters(names, values[: len(names)].tolist()))
            values = values[len(names) :]
        for term in self.terms:
            if is_shared(term.effect):
                count = len(term.values)
                term, values = replace(term, values=values[:count]), values[count:]
            terms.append(term)
        return replace(self, lens=lenses[0], others=tuple(lenses[1:]), terms=tuple(terms))

    def retract(
        self, free: Sequence[str], frame: Array, shared: Array, part: float = 1.0
    ) -> RigState:
        """Return the state after a part of a step of poses (F, 6) and of what all frames share.

        shared (6 (C - 1) + K,): of the rig with its boards, free intrinsics and effects.
        """
        frame, shared = part * frame, part * shared
        move = np.zeros((*self.rig.shape, 6))
        turned = move[1:].size
        move[1:] = shared[:turned].reshape(-1, 6)
        moved = replace(self, pose=self.pose.retract(frame), rig=self.rig.retract(move))
        return moved.with_shared_values(free, self.shared_values(free) + shared[turned:])

    def without_effects(self, names: Collection[str]) -> RigState:
        """Return the state without some effects."""
        return replace(self, terms=tuple(t for t in self.terms if t.name not in names))

    def view_poses(self, data: RigViews) -> Pose:
        """Return the camera's pose in each view (S,)."""
        pose = self.pose.take(data.frame_of).compose(self.rig.take(data.camera_of))
        return self.board_poses(data).inverse().compose(pose) if self.boards else pose

    def board_poses(self, data: RigViews) -> Pose:
        """Return the pose (S,) of the board of each view, in the frame of the first board."""
        board = np.array(self.boards)[data.camera_of]
        # The first board is where the body of the rig is in itself: the identity.
        return self.rig.take(np.where(board > 0, data.cameras - 1 + board, 0))


class Linearization:
    """A state's residuals and derivatives, whitened and gathered by frame.

    residual (F, M), whitened, measured minus predicted; frame_columns (F, M, 6): by the pose of
    the frame (zero where poses are known); shared_columns (F, M, K): by rig, free intrinsics and
    the parameters of the effects, in this order.  Where the corrections of a lens stay what they
    are, the derivatives follow how these vary over the image; those of effects do not, unless
    `fixed_effects` says that the effects stay what they are, too: poses alone are then fitted in
    three steps, where inexact derivatives find no step that keeps what it promises.
    """

    def __init__(
        self, data: RigViews, state: RigState, free: Sequence[str], fixed_effects: bool = False
    ) -> None:
        self.data, self.state, self.free = data, state, tuple(free)
        self._follows_effects = state.corrected or fixed_effects
        self.model = state.model
        pose = state.view_poses(data)
        self.linear: LinearViews = self.model.linearize(pose, data.views)
        self.scene: Scene = self.model.scene(pose, data.views, self.linear)
        self.weight = data.views.weight / noise_scale(state.terms, self.scene)
        with np.errstate(invalid='ignore'):
            offset = np.where(data.views.used[..., None], data.views.uv - self.linear.uv, 0.0)
        self.residual = data.blocks(offset * self.weight[..., None])
        self._d_pose = self._through_corrections(self.linear.d_pose)
        if state.boards:
            board = state.board_poses(data)
            pose = board.compose(pose)
            turn = np.kron(np.eye(2), np.swapaxes(board.rotation, -1, -2))
            self._d_pose = self._d_pose @ turn[:, None]
        self._camera = pose  # (S,) in the frame of the first board, as the derivatives by it
        self.frame_columns = self.whiten(self._frame_columns())

    def check_images(self) -> None:
        """Raise GeometryError where the state has no image of some of the points."""
        lost = self.row_mask & ~np.isfinite(self.residual)
        if lost.any():
            named = ', '.join(term.name for term in self.state.terms)
            raise GeometryError(
                f'{int(lost.sum() + 1) // 2} points lie out of sight of the fitted lens'
                + (f' with {named}' if named else '')
            )

    @cached_property
    def shared_columns(self) -> Array:
        """Whitened columns (F, M, K) of what all frames share."""
        shared = [self._rig_columns()]
        shared += [self._board_columns()] if self.state.boards else []
        shared.append(self._lens_columns())
        shared += [
            self.model.effect_columns(term.effect, self.scene, self.linear)
            for term in self.state.terms
            if is_shared(term.effect)
        ]
        return self.whiten(np.concatenate(shared, axis=-1))

    @property
    def sum_of_squares(self) -> float:
        """Sum of the squared whitened residuals."""
        return float((self.residual**2).sum())

    @property
    def rms_px(self) -> float:
        """Root mean square of the 2-D norm of the residuals, px."""
        return self.rms_px_of(self.residual)

    def rms_px_of(self, whitened: Array) -> float:
        """Return the root mean square of the 2-D norm, px, of whitened residuals (F, M)."""
        used = self.row_mask
        return float(np.sqrt(2 * np.mean((whitened[used] / self.row_weight[used]) ** 2)))

    @property
    def residual_px(self) -> Array:
        """Residuals (S, N, 2), px, measured minus predicted, NaN for padding."""
        views = self.data.views
        return np.where(views.used[..., None], views.uv - self.linear.uv, np.nan)

    @cached_property
    def row_weight(self) -> Array:
        """Weights (F, M) of the rows, 1/px, zero for padding."""
        return self.data.blocks(self.weight[..., None] * np.ones(2))

    @property
    def row_mask(self) -> Mask:
        """Which rows (F, M) are observations and not padding."""
        return self.row_weight > 0

    def whiten(self, columns: Array) -> Array:
        """Gather columns (S, N, 2, P) as (F, M, P), whitened, zero for padding."""
        weight = self.weight[..., None, None]
        return self.data.blocks(np.where(weight > 0, columns * weight, 0.0))

    def effect_columns(self, effect: Effect) -> Array:
        """Whitened columns (F, M, P) by the parameters of one more effect."""
        return self.whiten(self.model.effect_columns(effect, self.scene, self.linear))

    def _through_corrections(self, columns: Array) -> Array:
        """Return columns (S, N, 2, P) of measured points from those of ideal ones."""
        if not self._follows_effects:
            return columns
        return self.model.transform_columns(self.linear, self.data.views, columns)

    def _frame_columns(self) -> Array:
        d_place, d_turn = self._d_pose[..., :3], self._d_pose[..., 3:]
        # The frame turns about the rig's body: a camera off its origin also moves.
        arm = self._camera.position - self.state.pose.position[self.data.frame_of]
        lever = d_place @ -cross_matrix(arm)[:, None]
        frame = np.concatenate([d_place, d_turn + lever], axis=-1)
        return frame if self.data.poses is None else np.zeros_like(frame)

    def _rig_columns(self) -> Array:
        d_place, d_turn = self._d_pose[..., :3], self._d_pose[..., 3:]
        body = self.state.pose.rotation[self.data.frame_of][:, None]
        rig = np.concatenate([d_place @ body, d_turn @ body], axis=-1)
        return _place_columns(rig, self.data.camera_of, self.data.cameras)

    def _board_columns(self) -> Array:
        """Return columns (S, N, 2, 6 (B - 1)) by the poses of the boards but the first."""
        d_place, d_turn = self._d_pose[..., :3], self._d_pose[..., 3:]
        board = np.array(self.state.boards)[self.data.camera_of]
        arm = self._camera.position - self.state.board_poses(self.data).position
        columns = np.concatenate(
            [-d_place, d_place @ cross_matrix(arm)[:, None] - d_turn], axis=-1
        )
        return _place_columns(columns, board, max(self.state.boards) + 1)

    def _lens_columns(self) -> Array:
        columns = self.model.lens_columns(self.linear, self.state.lens_names(self.free))
        # Corrections of the image plane go with its center and focal lengths.
        inner = [name.rpartition('.')[2] not in ('f', *INTRINSICS) for name in self.free]
        if any(inner):
            columns[..., inner] = self._through_corrections(columns[..., inner])
        return columns


def _place_columns(columns: Array, body: Index, count: int) -> Array:
    """Return columns (S, N, 2, 6) where those of each body stand, (S, N, 2, 6 (count - 1))."""
    is_body = body[:, None] == np.arange(1, count)
    placed = columns[..., None, :] * is_body[:, None, None, :, None]
    return np.asarray(placed.reshape(*columns.shape[:3], -1))


def is_shared(effect: Effect) -> bool:
    """Whether an effect's parameters stand among the shared ones of a fit: not those of noise."""
    return effect.stage != 'noise'


def free_parameters(lenses: Mapping[str, Lens], free: bool | None = None) -> tuple[str, ...]:
    """Return the intrinsics that are fitted, those of a rig with the camera's name before them.

    free: of all lenses or of none; None asks each lens whether a calibration made it.
    """
    return tuple(
        f'{camera}.{name}' if camera else name
        for camera, lens in lenses.items()
        if (lens.calibration is not None if free is None else free)
        for name in intrinsic_names(lens)
    )


def with_effect(state: RigState, effect: Effect, values: Array | None = None) -> RigState:
    """Return the state with one more effect, joined with an earlier form of the same."""
    start = np.zeros(len(effect.parameters)) if values is None else values
    term, terms = ModelTerm(effect, start), list(state.terms)
    for i, old in enumerate(terms):
        if old.name == effect.name:
            joined = old.effect.merge_with(effect)
            terms[i] = ModelTerm(
                joined, transfer_values(old, joined) + transfer_values(term, joined)
            )
            return replace(state, terms=tuple(terms))
    return replace(state, terms=(*terms, term))


def transfer_values(term: ModelTerm, new: Effect) -> Array:
    """Return start values of a form of an effect from another form's, by parameter name."""
    values = dict(zip((p.name for p in term.effect.parameters), term.values, strict=True))
    return np.array([values.get(parameter.name, 0.0) for parameter in new.parameters])
