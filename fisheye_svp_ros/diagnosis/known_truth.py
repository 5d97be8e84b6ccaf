"""The gain where more is known than image points: true poses, and the depth of a rig."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.adjustment import fit
from fisheye_svp_ros.diagnosis.model import Data, Linearised, State, chosen_views
from fisheye_svp_ros.pose import Pose, axis_angle_between
from fisheye_svp_ros.solve.stereo_depth import triangulate

_FOLDS = 3
_RESAMPLES = 2000


class Compared(NamedTuple):
    """A mean error over held-out frames with the base and the extended model.

    gain: 1 - extended / base, and its 95 % interval, by bootstrap over frames.
    """

    base: float
    extended: float
    gain: float
    low: float
    high: float


def known_errors(
    before: Linearised, after: Linearised, free: Sequence[str]
) -> dict[str, Compared]:
    """Compare the errors of two states of the same data, each fitted without the judged frames.

    position_error_m and axis_error_rad of the first camera where true poses are known;
    depth_error_m of two cameras (Error3 of Kita, section 5), unless the landmarks themselves are
    in doubt, or where the cameras stood at each moment: mean distance of triangulated landmarks
    from where poses and rig say they are.
    """
    measured: dict[str, Callable[[Data, State], Array]] = {}
    if after.data.poses is not None:
        measured |= {'position_error_m': _position_errors, 'axis_error_rad': _axis_errors}
    doubtful = any(effect.stage in ('target', 'pose') for effect, _ in after.state.terms)
    if after.data.cameras == 2 and not doubtful:
        measured['depth_error_m'] = _depth_errors
    pairs = [list(_trained(linear, free)) for linear in (before, after)] if measured else []
    found = {
        name: [np.concatenate([errors(held_out, state) for held_out, state in folds])
               for folds in pairs]
        for name, errors in measured.items()
    }
    return {name: compared(*both) for name, both in found.items()
            if np.isfinite(both[0] + both[1]).any()}


def _trained(linear: Linearised, free: Sequence[str]) -> Iterator[tuple[Data, State]]:
    """Yield held-out data and a state with the poses of the first camera's views in it."""
    data = linear.data
    folds = np.arange(data.frames) % min(_FOLDS, data.frames)
    for fold in np.unique(folds):
        kept = folds != fold
        part = replace(linear.state, pose=linear.state.pose.take(np.flatnonzero(kept)))
        trained = fit(chosen_views(data, kept[data.frame_of]), part, free)
        held_out = chosen_views(data, ~kept[data.frame_of])
        solved = trained.cameras.localize(held_out.views.take(_first(held_out)))
        yield held_out, replace(trained, pose=solved)


def _first(data: Data) -> Index:
    """Return the views of the first camera."""
    return np.flatnonzero(data.camera_of == 0)


def _true(data: Data) -> Pose:
    assert data.poses is not None
    return data.poses.take(data.frame_of[_first(data)])


def _position_errors(held_out: Data, state: State) -> Array:
    return np.asarray(np.linalg.norm(state.pose.position - _true(held_out).position, axis=-1))


def _axis_errors(held_out: Data, state: State) -> Array:
    return axis_angle_between(state.pose, _true(held_out))


def _depth_errors(held_out: Data, state: State) -> Array:
    """Return the mean error of each frame, m; NaN where the cameras share no landmark."""
    first, second = (state.cameras.model(camera) for camera in (0, 1))
    place = state.pose if held_out.poses is None else _true(held_out)
    right_pose = place.compose(state.rig.take(1))
    rig = state.rig.take(1).inverse()
    errors = []
    for i, view in enumerate(_first(held_out)):
        points, left, right = _shared(held_out, int(view))
        found = triangulate(first, second, rig, left, right).points
        off = np.linalg.norm(found - right_pose.take(i).into_body(points), axis=-1)
        errors.append(float(off[np.isfinite(off)].mean()) if np.isfinite(off).any() else np.nan)
    return np.array(errors)


def _shared(data: Data, view: int) -> tuple[Array, Array, Array]:
    """Return what a view of the first camera shares with the second: points (N, 3), uv (N, 2)."""
    other = np.flatnonzero((data.frame_of == data.frame_of[view]) & (data.camera_of == 1))
    ids = np.where(data.views.used, data.views.landmark, -1 - data.camera_of[:, None])
    _, i, j = np.intersect1d(ids[view], ids[other], return_indices=True)
    uv = data.views.uv
    return data.views.points[view, i], uv[view, i], uv[other].reshape(-1, 2)[j]


def compared(base: Array, extended: Array) -> Compared:
    """Compare the errors (F,) of frames, NaN where there is none."""
    known = np.isfinite(base) & np.isfinite(extended)
    both = np.stack([base[known], extended[known]])
    rows = np.random.default_rng(0).integers(0, both.shape[1], (_RESAMPLES, both.shape[1]))
    before, after = both[:, rows].mean(axis=-1)
    low, high = np.quantile(1 - after / before, (0.025, 0.975))
    first, second = both.mean(axis=1).tolist()
    return Compared(first, second, 1 - second / first, float(low), float(high))
