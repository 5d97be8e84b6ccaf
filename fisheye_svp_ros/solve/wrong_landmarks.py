"""Landmarks that are not where the table says, found from what most landmarks agree on.

One wrong landmark bends lens and poses, and good points are then the outliers.  So lens and poses
are fitted to the landmarks that fit best, again and again (least trimmed squares: Rousseeuw and
Van Driessen, Computing LTS regression for large data sets, 2006), then to all that agree with
these.  What moves smoothly from landmark to landmark, as a bent or displaced board does, is left
to the models of targets.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.pose import Pose, identity
from fisheye_svp_ros.scene.observations import Observations, Views, group_views
from fisheye_svp_ros.solve.initial_rig import prediction_distances
from fisheye_svp_ros.solve.localization import MIN_POINTS, localize
from fisheye_svp_ros.solve.outliers import (
    MEDIAN_NORM,
    MIN_RESIDUAL_PX,
    OUTLIER_SIGMAS,
    UNSEEN_PX,
    WrongLandmark,
    relative_sigma,
)
from fisheye_svp_ros.solve.reliability import NOISIEST_PX, consensus_pose

Fit = Callable[[Observations], ForwardModel]

_MIN_VIEWS = 3  # of a landmark: fewer do not show where it is
_MIN_LANDMARKS = 8
_KEPT_SHARE = 0.6  # of the landmarks, that a lens is fitted to
_MAX_WRONG_SHARE = 0.4
_STEPS = 8
_CONSENSUS_VIEWS = 12  # those with most points
_CONSENSUS_POINTS = 120  # of a view, about: more tell no better which pose most agree on
_LANDMARK_SHARE = 0.75  # of the squared residuals, explained by displaced landmarks
_NEIGHBORS = 8
_OWN_SHARE = 0.5  # of an offset, that the nearest landmarks do not have
_MAX_REMAINDER = 0.3  # of the offset, where another place explains the points
_MISMATCH_RATIO = 3.0  # times the limit, of points that no place explains: a lens may bend as much
_MIN_RAYS = 1e-6  # relative eigenvalue, of rays that meet in a point


def find_wrong_landmarks(
    table: Observations, model: ForwardModel | None, fit: Fit, starts: Iterable[ForwardModel] = ()
) -> tuple[WrongLandmark, ...]:
    """Return the landmarks of a table that are not where it says, up to two fifths of them.

    model: fitted to the whole table, None where that failed; fit: fits a model to some of its
    rows, or raises GeometryError; starts: further models, rough ones, to start from where what
    that model leads to is worse than any detector.
    """
    landmarks = _LandmarkTable.from_table(table)
    if len(landmarks.ids) < _MIN_LANDMARKS:
        return ()
    if model is not None and not landmarks.is_suspicious(model):
        return ()
    best: _Agreement | None = None
    for start in (*(() if model is None else (model,)), *starts):
        if best is not None and best.typical < NOISIEST_PX:
            break
        try:
            wrong = landmarks.concentrate(start, fit)
        except (GeometryError, np.linalg.LinAlgError):
            continue
        if best is None or wrong.typical < best.typical:
            best = wrong
    return () if best is None or best.typical > NOISIEST_PX else landmarks.wrong(best)


class _Agreement(NamedTuple):
    """A model, the landmarks (L,) that agree with it, and the poses of the views by these."""

    model: ForwardModel
    kept: Mask
    pose: Pose
    posed: Mask
    scale: Array

    @property
    def typical(self) -> float:
        """Robust standard deviation of most landmarks, px."""
        return float(np.median(self.scale))


class _LandmarkTable(NamedTuple):
    """Views of a table, and the landmarks (L,) in it that enough of them show.

    slot (S, N): place of each point's landmark among ids, L for others; xyz (L, 3), m.
    """

    table: Observations
    views: Views
    ids: Index
    slot: Index
    xyz: Array

    @classmethod
    def from_table(cls, table: Observations) -> _LandmarkTable:
        views = group_views(table)
        views = views._replace(weight=np.where(views.used, 1 / relative_sigma(views), 0.0))
        ids, first, count = np.unique(table.landmark, return_index=True, return_counts=True)
        often = count >= _MIN_VIEWS
        ids, first = ids[often], first[often]
        place = np.searchsorted(ids, views.landmark)
        listed = views.used & np.isin(views.landmark, ids)
        return cls(table, views, ids, np.where(listed, place, len(ids)), table.xyz[first])

    def is_suspicious(self, model: ForwardModel) -> bool:
        """Whether displaced landmarks explain most of what is left, or one stands out."""
        pose, posed = self._poses_by(model, np.ones(len(self.ids), dtype=bool))
        linear = model.linearize(pose, self.views)
        weight = np.where(posed[:, None], self.views.weight, 0.0)
        seen = np.asarray((weight > 0) & np.isfinite(linear.uv).all(axis=-1))
        scale = self.scale_of(self._distances(model, pose, posed))
        if not _agreeing(scale).all():
            return True
        off = np.where(seen[..., None], self.views.uv - linear.uv, 0.0) * weight[..., None]
        columns = np.where(seen[..., None, None], linear.d_target, 0.0) * weight[..., None, None]
        information = self._sum(np.swapaxes(columns, -1, -2) @ columns)
        gradient = self._sum((np.swapaxes(columns, -1, -2) @ off[..., None])[..., 0])
        inverse = np.linalg.pinv(information, hermitian=True)
        explained = np.einsum('li,lij,lj->', gradient, inverse, gradient)
        return bool(explained > _LANDMARK_SHARE * (off**2).sum())

    def concentrate(self, model: ForwardModel, fit: Fit) -> _Agreement:
        """Fit to the landmarks that fit best until these stay, then to all that agree."""
        scale = self.scale_of(self._consensus_distances(model))
        kept = np.zeros(len(self.ids), dtype=bool)
        for choose in (_best_share, _agreeing):
            for _ in range(_STEPS):
                before, kept = kept, choose(scale)
                if np.array_equal(kept, before):
                    break
                model = fit(self.table.take(np.isin(self.table.landmark, self.ids[kept])))
                pose, posed = self._poses_by(model, kept)
                scale = self.scale_of(self._distances(model, pose, posed))
        return _Agreement(model, kept, pose, posed, scale)

    def wrong(self, agreement: _Agreement) -> tuple[WrongLandmark, ...]:
        """Return the landmarks that do not agree and do not move as their neighbors do."""
        uv = agreement.model.linearize(agreement.pose, self.views).uv
        off = np.where(agreement.posed[:, None, None], self.views.uv - uv, np.nan)
        by_landmark = np.full((len(off), len(self.ids) + 1, 2), np.nan)
        np.put_along_axis(by_landmark, self.slot[..., None], off, axis=1)
        wrong = []
        for i in np.flatnonzero(~agreement.kept):
            near = np.argsort(np.linalg.norm(self.xyz - self.xyz[i], axis=1), kind='stable')
            around = _finite_median(by_landmark[:, near[1 : 1 + _NEIGHBORS]], axis=1)
            places = by_landmark[:, i]
            distance = np.linalg.norm(places - np.nan_to_num(around), axis=-1)
            if _finite_median(distance) > _OWN_SHARE * _finite_median(
                np.linalg.norm(places, axis=-1)
            ):
                landmark = self._describe(int(i), agreement)
                far = agreement.scale[i] > _MISMATCH_RATIO * OUTLIER_SIGMAS * agreement.typical
                wrong += [landmark] if landmark.is_displaced or far else []
        share = len(wrong) / len(self.ids)
        return tuple(wrong) if share <= _MAX_WRONG_SHARE else ()

    def _describe(self, i: int, agreement: _Agreement) -> WrongLandmark:
        sightings = (self.slot == i) & agreement.posed[:, None]
        offset = np.full(3, np.nan)
        meeting = _meeting_point(agreement.model, agreement.pose, self.views, sightings)
        if meeting is not None:
            moved = self.views._replace(
                points=np.where(sightings[..., None], meeting, self.views.points)
            )
            left = prediction_distances(agreement.model, agreement.pose, moved)[sightings]
            if _finite_median(left) / MEDIAN_NORM < _MAX_REMAINDER * agreement.scale[i]:
                offset = meeting - self.xyz[i]
        points = int((self.table.landmark == self.ids[i]).sum())
        return WrongLandmark(
            int(self.ids[i]), points, MEDIAN_NORM * float(agreement.scale[i]), offset
        )

    def scale_of(self, distance: Array) -> Array:
        """Return robust standard deviations (L,) of a coordinate, px, of distances (S, N).

        Infinite for landmarks of which none is known.
        """
        order = np.argsort(self.slot, axis=None, kind='stable')
        parts = np.split(distance.ravel()[order], np.cumsum(np.bincount(self.slot.ravel()))[:-1])
        finite = [part[np.isfinite(part)] for part in parts[: len(self.ids)]]
        return np.array(
            [np.median(part) / MEDIAN_NORM if len(part) else UNSEEN_PX for part in finite]
        )

    def _sum(self, values: Array) -> Array:
        """Return sums (L, ...) of values (S, N, ...) by landmark."""
        total = np.zeros((len(self.ids) + 1, *values.shape[2:]))
        np.add.at(total, self.slot, values)
        return total[:-1]

    def _consensus_distances(self, model: ForwardModel) -> Array:
        """Return distances (S, N), px, from the poses that most points of a view agree on."""
        pose, posed = identity(len(self.views.frame)), np.zeros(len(self.views.frame), dtype=bool)
        richest = np.argsort(-self.views.used.sum(axis=1), kind='stable')[:_CONSENSUS_VIEWS]
        for rows, _, camera_model in model.split(self.views):
            for view in np.intersect1d(np.arange(len(posed))[rows], richest):
                used = np.flatnonzero(self.views.used[view])
                step = max(1, len(used) // _CONSENSUS_POINTS)
                single = self.views.take([view]).take_points(used[::step])
                try:
                    solution = localize(camera_model, single)
                except GeometryError:
                    continue
                pose.put(
                    [view], consensus_pose(camera_model.seeing(single), single, solution, 1.0)
                )
                posed[view] = True
        return self._distances(model, pose, posed)

    def _poses_by(self, model: ForwardModel, kept: Mask) -> tuple[Pose, Mask]:
        """Return poses (S,) by some landmarks (L,), and which views show enough of them."""
        used = self.views.used & np.append(kept, False)[self.slot]
        pose, posed = identity(len(used)), np.zeros(len(used), dtype=bool)
        for rows, _, camera_model in model.split(self.views):
            views = self.views.take(rows)
            views = views._replace(weight=np.where(used[rows], views.weight, 0.0))
            inside = (views.weight > 0) & camera_model.seeing(views).back_project(views.uv).valid
            which = np.flatnonzero(inside.sum(axis=1) >= MIN_POINTS)
            if len(which):
                solution = localize(camera_model, views.take(which))
                at = np.arange(len(used))[rows][which]
                pose.put(at, solution.pose)
                posed[at] = solution.converged
        return pose, posed

    def _distances(self, model: ForwardModel, pose: Pose, posed: Mask) -> Array:
        """Return distances (S, N) of points from their predictions, px; NaN where not posed."""
        distance = np.minimum(prediction_distances(model, pose, self.views), UNSEEN_PX)
        return np.where(posed[:, None], distance / relative_sigma(self.views), np.nan)


def _best_share(scale: Array) -> Mask:
    """Return the landmarks (L,) of least scale (L,), as many as agree at least."""
    kept = np.zeros(len(scale), dtype=bool)
    kept[np.argsort(scale, kind='stable')[: int(np.ceil(_KEPT_SHARE * len(scale)))]] = True
    return kept


def _agreeing(scale: Array) -> Mask:
    """Return the landmarks (L,) whose scale (L,) is like that of most."""
    return np.asarray(scale <= OUTLIER_SIGMAS * max(float(np.median(scale)), MIN_RESIDUAL_PX))


def _meeting_point(model: ForwardModel, pose: Pose, views: Views, mine: Mask) -> Array | None:
    """Return the point (3,) nearest to the rays of some points (S, N); None for no such point."""
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for rows, _, camera_model in model.split(views):
        rays = camera_model.seeing(views.take(rows)).back_project(views.take(rows).uv)
        view, point = np.nonzero(mine[rows] & rays.valid)
        camera = pose.take(np.arange(len(mine))[rows][view])
        direction = (camera.rotation @ rays.direction[view, point][..., None])[..., 0]
        origin = camera.transform(rays.origin[view, point])
        across = np.eye(3) - direction[:, :, None] * direction[:, None]
        normal += across.sum(axis=0)
        right += (across @ origin[..., None]).sum(axis=(0, 2))
    values = np.linalg.eigvalsh(normal)
    met = values[0] > _MIN_RAYS * values[2]
    return np.asarray(np.linalg.solve(normal, right), dtype=float) if met else None


def _finite_median(values: Array, axis: int | None = None) -> Array:
    """Return medians of what is finite; NaN where nothing is."""
    finite = np.isfinite(values)
    any_finite = finite.any(axis=axis, keepdims=True)
    # Where nothing is finite: of zeros, and masked afterwards.
    median = np.nanmedian(np.where(finite, values, np.where(any_finite, np.nan, 0.0)), axis=axis)
    return np.asarray(np.where(np.squeeze(any_finite, axis=axis), median, np.nan))
