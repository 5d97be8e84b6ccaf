"""Refit of poses, rig, intrinsics and effects together by least squares, and its start."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.cameras import Cameras
from fisheye_svp_ros.diagnosis.model import Data, Linearised, State, flat_rows, is_shared
from fisheye_svp_ros.effects.forward import ForwardModel, Term
from fisheye_svp_ros.effects.of_cameras import by_camera
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, identity
from fisheye_svp_ros.scene.observations import Views
from fisheye_svp_ros.solve.arrow import ArrowEquations, arrow_step
from fisheye_svp_ros.solve.least_squares import Arrays, levenberg_marquardt
from fisheye_svp_ros.solve.lens_adjustment import parameter_values

_TRIED = 5  # rigs that a start is chosen from


def start(data: Data, lens: Lens, others: Sequence[Lens] = ()) -> State:
    """Localize every view with the lens as it is; take the rig from the middle of the frames.

    others: the lenses of the further cameras of a rig.
    Raises GeometryError, naming the frame, where a view has too few points.
    """
    models = [ForwardModel(one) for one in (lens, *others)]
    labels = data.observations.cameras if others else ('',)
    terms = models[0].terms_for(data.views)
    of_target = terms[len(models[0].terms) :]
    if others:
        held: dict[str, Term] = {}
        for i, (label, model) in enumerate(zip(labels, models, strict=True)):
            effects = by_camera(i, label, (effect for effect, _ in model.terms))
            for effect, (_, values) in zip(effects, model.terms, strict=True):
                known = held.get(effect.name)
                held[effect.name] = (effect, values) if known is None else (
                    known[0].joined(effect), np.concatenate([known[1], values]))
        terms = (*held.values(), *of_target)
    bare = [replace(one, corrections={}, target={} if of_target else one.target)
            for one in (lens, *others)]
    state = State(identity(data.frames), identity(data.cameras), bare[0], terms, tuple(bare[1:]),
                  labels)
    solved = state.cameras.localize(data.views)
    rig = _rig(data, state.cameras, solved)
    return replace(state, rig=rig, pose=data.poses or _frame_poses(data, solved, rig))


def start_poses(data: Data, trained: State) -> State:
    """Return a state fitted to other data with the poses of these frames; all else is kept."""
    solved = trained.cameras.localize(data.views)
    pose = data.poses or _frame_poses(data, solved, trained.rig)
    return fit_poses(data, replace(trained, pose=pose))


def _rig(data: Data, model: Cameras, solved: Pose) -> Pose:
    """Return the cameras (C,) in the first one, each from the frame that suits most others."""
    rig, placed = identity(data.cameras), np.zeros(data.frames, dtype=bool)
    body = identity(data.frames) if data.poses is None else data.poses
    placed[:] = data.poses is not None
    for camera in range(data.cameras):
        mine = np.flatnonzero(data.camera_of == camera)
        frames = data.frame_of[mine]
        shared = placed[frames]
        if camera and shared.any():
            seen, views = body.take(frames[shared]), data.views.take(mine[shared])
            relative = seen.inverse().compose(solved.take(mine[shared]))
            rig.put(camera, relative.take(_best(model, views, seen, relative)))
        new = ~shared
        own = solved.take(mine[new]).compose(rig.take([camera] * int(new.sum())).inverse())
        body.put(frames[new], own)
        placed[frames] = True
    return rig


def _best(model: Cameras, views: Views, body: Pose, rigs: Pose) -> int:
    """Return which rig (S,), one from each view and its body (S,), predicts most views best."""
    count = len(rigs.position)

    def misfit(i: int) -> float:
        offset = model.offsets(body.compose(rigs.take([i] * count)), views)
        return float(np.median(np.nanmedian(offset, axis=1)))

    # A far view says little of where its camera stands: among the middle ones images decide.
    return int(min(_middle(rigs)[:_TRIED].tolist(), key=misfit))


def _middle(poses: Pose) -> Index:
    """Return poses in the order of how near each is to most others."""
    count = len(poses.position)
    far = np.zeros((count, count))
    size = max(float(np.median(np.linalg.norm(poses.position, axis=1))), 1e-9)
    for i in range(count):
        change = poses.difference(poses.take([i] * count))
        far[i] = np.linalg.norm(change[:, 3:], axis=1)
        far[i] += np.linalg.norm(change[:, :3], axis=1) / size
    return np.argsort(np.median(far, axis=1), kind='stable')


def _frame_poses(data: Data, solved: Pose, rig: Pose) -> Pose:
    """Return frame poses (F,) from those of the views, from the first camera where it saw."""
    body = solved.compose(rig.take(data.camera_of).inverse())
    first = np.unique(data.frame_of, return_index=True)[1]
    return body.take(first)


class Prior(NamedTuple):
    """What is known before of free intrinsics and effect values: mean (K,), root (R, K).

    root: times what is off the mean it is of unit covariance.
    """

    mean: Array
    root: Array


def fit(
    data: Data, state: State, free: Sequence[str], prior: Prior | None = None,
    held: Collection[str] = (),
) -> State:
    """Refit poses, rig, free intrinsics and effect values together by least squares.

    The frames are the blocks of one arrow.  held: effects whose values stay what they are.
    """
    problem = _Adjustment(data, state, free, held, prior)
    return problem.unpack(levenberg_marquardt(problem, problem.pack(state)).state)


def fit_poses(data: Data, state: State) -> State:
    """Refit the poses of the frames alone."""
    problem = _Adjustment(data, state, (), held=None)
    return problem.unpack(levenberg_marquardt(problem, problem.pack(state)).state)


def moved(data: Data, state: State, free: Sequence[str], frame: Array, shared: Array) -> State:
    """Return the state after a step of the poses (F, 6) and of what is shared (K,)."""
    problem = _Adjustment(data, state, free)
    return problem.unpack(problem.retract(problem.pack(state), (frame[None], shared[None])))


class _Adjustment:
    """One arrow system: frames are the blocks; rig, intrinsics and effects are shared."""

    def __init__(
        self, data: Data, template: State, free: Sequence[str],
        held: Collection[str] | None = (), prior: Prior | None = None,
    ) -> None:
        """Take what to fit; held: effects that stay as they are, None for all but the poses."""
        self._data, self._template, self._free = data, template, tuple(free)
        self._prior = prior
        moving = [np.full(6 * (data.cameras - 1) + len(self._free), held is not None)]
        moving += [np.full(len(values), held is not None and effect.name not in held)
                   for effect, values in template.terms if is_shared(effect)]
        self._moving = np.concatenate(moving)

    def pack(self, state: State) -> Arrays:
        lens = np.concatenate([
            parameter_values(lens, tuple(names))
            for lens, names in zip(state.lenses, state.own_names(self._free), strict=True)
        ])
        values = [v for effect, v in state.terms if is_shared(effect)]
        parts = (*state.pose, *state.rig, np.concatenate([np.array(lens), *values]))
        return tuple(array[None] for array in parts)

    def unpack(self, packed: Arrays) -> State:
        rotation, position, rig_rotation, rig_position, shared = (a[0] for a in packed)
        values, lenses, terms = shared, [], []
        for lens, names in zip(
            self._template.lenses, self._template.own_names(self._free), strict=True
        ):
            lenses.append(lens.with_parameters(names, list(values[: len(names)])))
            values = values[len(names) :]
        for effect, known in self._template.terms:
            if is_shared(effect):
                known, values = values[: len(known)], values[len(known) :]
            terms.append((effect, known))
        pose, rig = Pose(rotation, position), Pose(rig_rotation, rig_position)
        return replace(self._template, pose=pose, rig=rig, lens=lenses[0],
                       others=tuple(lenses[1:]), terms=tuple(terms))

    def linearise(self, state: Arrays, index: Index) -> tuple[Array, Arrays]:
        if not len(index):
            return np.zeros(0), ()
        linear = Linearised(self._data, self.unpack(state), self._free)
        if self._moving.any():
            # A column of zeros leaves its parameter where it is.
            shared = linear.shared_columns * self._moving
        else:
            shared = np.zeros((*linear.residual.shape, len(self._moving)))
        cost, normal = _equations(linear.residual, linear.frame_columns, shared)
        if self._prior is not None:
            mean, root = self._prior
            off = root @ (state[-1][0, -len(mean):] - mean)
            cost = cost + off @ off
            normal[2][0, -len(mean):, -len(mean):] += root.T @ root
            normal[4][0, -len(mean):] += root.T @ off
        return cost, normal

    def step(self, normal: Arrays, damping: Array) -> tuple[Arrays, Array]:
        return arrow_step(normal, damping)

    def retract(self, state: Arrays, step: Arrays) -> Arrays:
        frame, shared = step
        rotation, position, rig_rotation, rig_position, values = state
        cameras = 6 * (self._data.cameras - 1)
        move = np.zeros((len(shared), self._data.cameras, 6))
        move[:, 1:] = shared[:, :cameras].reshape(len(shared), -1, 6)
        return (
            *Pose(rotation, position).retract(frame),
            *Pose(rig_rotation, rig_position).retract(move),
            values + shared[:, cameras:],
        )


def _equations(residual: Array, block: Array, shared: Array) -> tuple[Array, Arrays]:
    """Return cost (1,) and arrow of rows (V, M) with columns (V, M, B) and (V, M, K)."""
    cost = float((residual**2).sum())
    if not np.isfinite(cost):
        residual, block, shared = (np.zeros_like(a) for a in (residual, block, shared))
        cost = np.inf
    flat = flat_rows(shared)
    transposed = np.ascontiguousarray(np.swapaxes(block, -1, -2))
    equations = ArrowEquations(
        (transposed @ block)[None],
        (transposed @ shared)[None],
        (flat.T @ flat)[None],
        -(transposed @ residual[..., None])[None, ..., 0],
        -(flat.T @ residual.ravel())[None],
    )
    return np.array([cost]), tuple(equations)
