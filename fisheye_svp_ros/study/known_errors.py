"""The gain where more is known than image points: true poses, and the depth of a rig."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis import Comparison, compare_errors
from fisheye_svp_ros.pose import Pose, axis_angle_between
from fisheye_svp_ros.solve.bundle_adjustment import adjust
from fisheye_svp_ros.solve.initial_rig import localize_cameras
from fisheye_svp_ros.solve.rig_state import Linearization, RigState, RigViews
from fisheye_svp_ros.solve.stereo_depth import triangulate

_FOLDS = 3


def known_errors(
    before: Linearization, after: Linearization, free: Sequence[str]
) -> dict[str, Comparison]:
    """Compare the errors of two states of the same data, each fitted without the judged frames.

    position_error_m and axis_error_rad of the first camera where true poses are known;
    depth_error_m of two cameras (Error3 of Kita, section 5), unless the landmarks themselves are
    in doubt, or where the cameras stood at each moment: mean distance of triangulated landmarks
    from where poses and rig say they are.
    """
    measured: dict[str, Callable[[RigViews, RigState], Array]] = {}
    if after.data.poses is not None:
        measured |= {'position_error_m': _position_errors, 'axis_error_rad': _axis_errors}
    doubtful = any(effect.stage in ('target', 'pose') for effect, _ in after.state.terms)
    if after.data.cameras == 2 and not doubtful:
        measured['depth_error_m'] = _depth_errors
    pairs = [list(_train_folds(linear, free)) for linear in (before, after)] if measured else []
    found = {
        name: [np.concatenate([errors(held_out, state) for held_out, state in folds])
               for folds in pairs]
        for name, errors in measured.items()
    }
    return {name: compare_errors(*both) for name, both in found.items()
            if np.isfinite(both[0] + both[1]).any()}


def _train_folds(
    linear: Linearization, free: Sequence[str]
) -> Iterator[tuple[RigViews, RigState]]:
    """Yield held-out data and a state with the poses of the first camera's views in it."""
    data = linear.data
    folds = np.arange(data.frames) % min(_FOLDS, data.frames)
    for fold in np.unique(folds):
        kept = folds != fold
        part = replace(linear.state, pose=linear.state.pose.take(np.flatnonzero(kept)))
        trained = adjust(data.select(kept[data.frame_of]), part, free)
        held_out = data.select(~kept[data.frame_of])
        solved = localize_cameras(trained.model, held_out.views.take(_first_camera(held_out)))
        yield held_out, replace(trained, pose=solved)


def _first_camera(data: RigViews) -> Index:
    """Return the views of the first camera."""
    return np.flatnonzero(data.camera_of == 0)


def _true_poses(data: RigViews) -> Pose:
    assert data.poses is not None
    return data.poses.take(data.frame_of[_first_camera(data)])


def _position_errors(held_out: RigViews, state: RigState) -> Array:
    off = state.pose.position - _true_poses(held_out).position
    return np.asarray(np.linalg.norm(off, axis=-1))


def _axis_errors(held_out: RigViews, state: RigState) -> Array:
    return axis_angle_between(state.pose, _true_poses(held_out))


def _depth_errors(held_out: RigViews, state: RigState) -> Array:
    """Return the mean error of each frame, m; NaN where the cameras share no landmark."""
    first, second = (state.model.camera(camera) for camera in (0, 1))
    place = state.pose if held_out.poses is None else _true_poses(held_out)
    right_pose = place.compose(state.rig.take(1))
    rig = state.rig.take(1).inverse()
    errors = []
    for i, view in enumerate(_first_camera(held_out)):
        points, left, right = _shared_points(held_out, int(view))
        found = triangulate(first, second, rig, left, right).points
        off = np.linalg.norm(found - right_pose.take(i).into_body(points), axis=-1)
        errors.append(float(off[np.isfinite(off)].mean()) if np.isfinite(off).any() else np.nan)
    return np.array(errors)


def _shared_points(data: RigViews, view: int) -> tuple[Array, Array, Array]:
    """Return what a view of the first camera shares with the second: points (N, 3), uv (N, 2)."""
    other = np.flatnonzero((data.frame_of == data.frame_of[view]) & (data.camera_of == 1))
    ids = np.where(data.views.used, data.views.landmark, -1 - data.camera_of[:, None])
    _, i, j = np.intersect1d(ids[view], ids[other], return_indices=True)
    uv = data.views.uv
    return data.views.points[view, i], uv[view, i], uv[other].reshape(-1, 2)[j]
