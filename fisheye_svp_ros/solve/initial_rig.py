"""Where a bundle adjustment starts: views localized, the rig from the middle of the frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.effects.base import ModelTerm
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.effects.rig_effect import assign_camera
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, identity
from fisheye_svp_ros.scene.observations import Views
from fisheye_svp_ros.solve.bundle_adjustment import adjust_poses
from fisheye_svp_ros.solve.localization import localize
from fisheye_svp_ros.solve.rig_state import RigState, RigViews

_MAX_RIGS = 5  # that a start is chosen from


def initial_state(data: RigViews, lens: Lens, others: Sequence[Lens] = ()) -> RigState:
    """Localize every view with the lens as it is; take the rig from the middle of the frames.

    others: the lenses of the further cameras of a rig.  The corrections of the lenses become
    effects of the state.
    Raises GeometryError, naming the frame, where a view has too few points.
    """
    models = [ForwardModel(other_lens) for other_lens in (lens, *others)]
    labels = data.observations.cameras if others else ('',)
    terms = models[0].terms_for(data.views)
    of_target = terms[len(models[0].terms) :]
    if others:
        terms = (*_camera_terms(labels, models), *of_target)
    bare = [
        replace(other_lens, corrections={}, target={} if of_target else other_lens.target)
        for other_lens in (lens, *others)
    ]
    state = RigState(
        identity(data.frames), identity(data.cameras), bare[0], terms, tuple(bare[1:]), labels
    )
    solved = localize_cameras(state.model, data.views)
    rig = _rig_from_frames(data, state.model, solved)
    return replace(state, rig=rig, pose=data.poses or _frame_poses(data, solved, rig))


def localize_frames(data: RigViews, known: RigState) -> RigState:
    """Return a state adjusted to other data with the poses of these frames; all else is kept."""
    solved = localize_cameras(known.model, data.views)
    pose = data.poses or _frame_poses(data, solved, known.rig)
    return adjust_poses(data, replace(known, pose=pose))


def localize_cameras(model: ForwardModel, views: Views, start: Pose | None = None) -> Pose:
    """Return the pose of every view, by the lens of its camera; raises as `localize` does."""
    poses = identity(len(views.frame))
    for rows, _, camera_model in model.split(views):
        near = None if start is None else start.take(rows)
        poses.put(rows, localize(camera_model, views.take(rows), near).pose)
    return poses


def prediction_distances(model: ForwardModel, pose: Pose, views: Views) -> Array:
    """Distances (S, N) of points from their predictions, px; NaN: padding; inf: unseen."""
    distance = np.linalg.norm(views.uv - model.linearize(pose, views).uv, axis=-1)
    return np.where(views.used, np.nan_to_num(distance, nan=np.inf), np.nan)


def _camera_terms(labels: Sequence[str], models: Sequence[ForwardModel]) -> list[ModelTerm]:
    """Return the corrections of the lenses of a rig, those of one effect as one."""
    held: dict[str, ModelTerm] = {}
    for i, (label, model) in enumerate(zip(labels, models, strict=True)):
        for term in model.terms:
            effect, values = assign_camera(term.effect, i, label), term.values
            if held_values := held.get(term.name):
                effect = held_values.effect.merge_with(effect)
                values = np.concatenate([held_values.values, values])
            held[term.name] = ModelTerm(effect, values)
    return list(held.values())


def _rig_from_frames(data: RigViews, model: ForwardModel, solved: Pose) -> Pose:
    """Return the cameras (C,) in the first one, each from the frame that suits most others."""
    rig, placed = identity(data.cameras), np.zeros(data.frames, dtype=bool)
    body = identity(data.frames) if data.poses is None else data.poses
    placed[:] = data.poses is not None
    for camera in range(data.cameras):
        rows = np.flatnonzero(data.camera_of == camera)
        frames = data.frame_of[rows]
        shared = placed[frames]
        if camera and shared.any():
            seen, views = body.take(frames[shared]), data.views.take(rows[shared])
            relative = seen.inverse().compose(solved.take(rows[shared]))
            rig.put(camera, relative.take(_best_rig(model, views, seen, relative)))
        new = ~shared
        rig_in_world = solved.take(rows[new]).compose(
            rig.take([camera] * int(new.sum())).inverse()
        )
        body.put(frames[new], rig_in_world)
        placed[frames] = True
    return rig


def _best_rig(model: ForwardModel, views: Views, body: Pose, rigs: Pose) -> int:
    """Return which rig (S,), one from each view and its body (S,), predicts most views best."""
    count = len(rigs.position)

    def distance(i: int) -> float:
        pose = body.compose(rigs.take([i] * count))
        return float(np.median(np.nanmedian(prediction_distances(model, pose, views), axis=1)))

    # A far view says little of where its camera stands: among the middle ones images decide.
    return int(min(_sort_by_centrality(rigs)[:_MAX_RIGS].tolist(), key=distance))


def _sort_by_centrality(poses: Pose) -> Index:
    """Return poses in the order of how near each is to most others."""
    count = len(poses.position)
    far = np.zeros((count, count))
    size = max(float(np.median(np.linalg.norm(poses.position, axis=1))), 1e-9)
    for i in range(count):
        change = poses.difference(poses.take([i] * count))
        far[i] = np.linalg.norm(change[:, 3:], axis=1)
        far[i] += np.linalg.norm(change[:, :3], axis=1) / size
    return np.argsort(np.median(far, axis=1), kind='stable')


def _frame_poses(data: RigViews, solved: Pose, rig: Pose) -> Pose:
    """Return frame poses (F,) from those of the views, from the first camera where it saw."""
    body = solved.compose(rig.take(data.camera_of).inverse())
    return body.take(data.first_views)
