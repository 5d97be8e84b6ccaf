"""The simulation under criticism: poses, rig, intrinsics and effects against one table."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.diagnosis.cameras import Cameras, Seen
from fisheye_svp_ros.effects.base import Effect, Scene, noise_weight
from fisheye_svp_ros.effects.forward import Term
from fisheye_svp_ros.optics.lens import INTRINSICS, Lens
from fisheye_svp_ros.pose import Pose, cross_matrix
from fisheye_svp_ros.scene.observations import Observations, Views, group_views


@dataclass(frozen=True)
class Data:
    """A table in the batch forms that a diagnosis needs.

    views: S views of up to N points; frame_of, camera_of (S,): which frame (0..F-1) and camera
    (0..C-1) a view belongs to; poses: true poses (F,) of the rig where they are known.
    """

    observations: Observations
    views: Views
    frame_of: Index
    camera_of: Index
    poses: Pose | None = None

    @property
    def frames(self) -> int:
        return int(self.frame_of.max()) + 1

    @property
    def cameras(self) -> int:
        return int(self.camera_of.max()) + 1

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


@dataclass(frozen=True)
class State:
    """A fit: poses (F,) of the rig's body, rig (C,) of the cameras in it, lens, effects.

    others: the lenses of the further cameras of a rig, by whose names (`labels`) parameters and
    effects are told apart; without them every camera has the same lens.
    """

    pose: Pose
    rig: Pose
    lens: Lens
    terms: tuple[Term, ...]
    others: tuple[Lens, ...] = ()
    labels: tuple[str, ...] = ('',)

    @property
    def lenses(self) -> tuple[Lens, ...]:
        """The lens of each camera of a rig, or the one of all."""
        return (self.lens, *self.others)

    @property
    def cameras(self) -> Cameras:
        """The forward models of the cameras."""
        return Cameras(self.lenses, self.terms)

    @property
    def parameters(self) -> dict[str, float]:
        """Values of the parameters of all lenses."""
        return {
            f'{label}.{name}' if label else name: value
            for label, lens in zip(self.labels, self.lenses, strict=True)
            for name, value in lens.parameters.items()
        }

    def own_names(self, free: Sequence[str]) -> list[list[str]]:
        """Return which of some parameters each lens has, by their names there."""
        heads = [f'{label}.' if label else '' for label in self.labels]
        return [[name.removeprefix(head) for name in free if name.startswith(head)]
                for head in heads]

    def without(self, names: Collection[str]) -> State:
        """Return the state without some effects."""
        return replace(self, terms=tuple(t for t in self.terms if t[0].name not in names))

    def view_poses(self, data: Data) -> Pose:
        """Return the camera's pose in each view (S,)."""
        return self.pose.take(data.frame_of).compose(self.rig.take(data.camera_of))


def prepare(observations: Observations, poses: dict[int, Pose] | None = None) -> Data:
    """Group a table by view; sigma is 1 px where the table does not say.

    poses: true poses by frame number; they are kept fixed in the fits.
    """
    views = group_views(observations)
    numbers, frame_of = np.unique(views.frame, return_inverse=True)
    _, camera_of = np.unique(views.camera, return_inverse=True)
    known = None
    if poses is not None:
        chosen = [poses[int(number)] for number in numbers]
        known = Pose.stack(chosen)
    return Data(observations, views, frame_of.reshape(-1), camera_of.reshape(-1), known)


def chosen_views(data: Data, kept: Mask) -> Data:
    """Return the data of some of the views (S,)."""
    frames, frame_of = np.unique(data.frame_of[kept], return_inverse=True)
    poses = None if data.poses is None else data.poses.take(frames)
    return replace(
        data, views=data.views.take(kept), frame_of=frame_of.reshape(-1),
        camera_of=data.camera_of[kept], poses=poses,
    )


def intrinsic_names(lens: Lens) -> tuple[str, ...]:
    """Return the intrinsics that a calibration frees: the four, and the height's coefficients."""
    return (*INTRINSICS, *lens.image_height.coefficient_names)


class Linearised:
    """A state's residuals and derivatives, whitened and gathered by frame.

    residual (F, M), whitened, measured minus predicted; frame_columns (F, M, 6): by the pose of
    the frame (zero where poses are known); shared_columns (F, M, K): by rig, free intrinsics and
    the parameters of the effects, in this order.
    """

    def __init__(self, data: Data, state: State, free: Sequence[str]) -> None:
        self.data, self.state, self.free = data, state, tuple(free)
        self.model = state.cameras
        pose = state.view_poses(data)
        self.linear: Seen = self.model.linearise(pose, data.views)
        self.scene: Scene = self.model.scene(pose, data.views, self.linear)
        self.weight = data.views.weight * noise_weight(state.terms, self.scene)
        with np.errstate(invalid='ignore'):
            offset = np.where(data.views.used[..., None], data.views.uv - self.linear.uv, 0.0)
        self.residual = data.blocks(offset * self.weight[..., None])
        self.frame_columns = self.whitened(self._frame_columns(pose))

    @cached_property
    def shared_columns(self) -> Array:
        """Whitened columns (F, M, K) of what all frames share."""
        free = self.state.own_names(self.free)
        shared = [self._rig_columns(), self.model.lens_columns(self.linear, free)]
        shared += [
            self.model.effect_columns(effect, self.scene, self.linear)
            for effect, _ in self.state.terms if is_shared(effect)
        ]
        return self.whitened(np.concatenate(shared, axis=-1))

    @cached_property
    def row_weight(self) -> Array:
        """Weights (F, M) of the rows, 1/px, zero for padding."""
        return self.data.blocks(self.weight[..., None] * np.ones(2))

    @property
    def used(self) -> Mask:
        """Which rows (F, M) are observations and not padding."""
        return self.row_weight > 0

    def whitened(self, columns: Array) -> Array:
        """Gather columns (S, N, 2, P) as (F, M, P), whitened, zero for padding."""
        weight = self.weight[..., None, None]
        return self.data.blocks(np.where(weight > 0, columns * weight, 0.0))

    def effect_columns(self, effect: Effect) -> Array:
        """Whitened columns (F, M, P) by the parameters of one more effect."""
        return self.whitened(self.model.effect_columns(effect, self.scene, self.linear))

    def _frame_columns(self, pose: Pose) -> Array:
        d_place, d_turn = self.linear.d_pose[..., :3], self.linear.d_pose[..., 3:]
        # The frame turns about the rig's body: a camera off its origin also moves.
        arm = pose.position - self.state.pose.position[self.data.frame_of]
        lever = d_place @ -cross_matrix(arm)[:, None]
        frame = np.concatenate([d_place, d_turn + lever], axis=-1)
        return frame if self.data.poses is None else np.zeros_like(frame)

    def _rig_columns(self) -> Array:
        d_place, d_turn = self.linear.d_pose[..., :3], self.linear.d_pose[..., 3:]
        body = self.state.pose.rotation[self.data.frame_of][:, None]
        rig = np.concatenate([d_place @ body, d_turn @ body], axis=-1)
        mine = self.data.camera_of[:, None] == np.arange(1, self.data.cameras)
        columns = rig[..., None, :] * mine[:, None, None, :, None]
        return np.asarray(columns.reshape(*rig.shape[:3], -1))


def is_shared(effect: Effect) -> bool:
    """Whether an effect's parameters stand among the shared ones of a fit: not those of noise."""
    return effect.stage != 'noise'


def flat_rows(columns: Array) -> Array:
    """Return columns (..., P) as (rows, P), also where P is 0."""
    return columns.reshape(int(np.prod(columns.shape[:-1])), columns.shape[-1])
