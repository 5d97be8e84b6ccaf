"""Outliers of a table: points and views that belong elsewhere, found without a noise model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Observations, Views
from fisheye_svp_ros.solve.initial_rig import localize_cameras, prediction_distances
from fisheye_svp_ros.solve.rig_state import RigState, RigViews

OUTLIER_SIGMAS = 8.0  # robust standard deviations beyond which a point is not its landmark's
_SWAP_SIGMAS = 6.0  # and within which it belongs to another one
_SWAP_CHANCE = 0.01  # that so many do by chance
_SUSPICIOUS_SIGMAS = 6.0  # below this no point is worth a robust fit
LANDMARK = 'its landmark is not where the table says'
SWAPPED_POINT = 'at the predicted place of another landmark'
FAR_POINT = 'far from its prediction'
VIEW = 'all points of the view are off: check their order'
FRAME = (
    'its cameras contradict each other: check the order of the points, the time, and left and '
    'right'
)
_VIEW_RATIO, _MIN_VIEW_PX = 15.0, 3.0  # times the median view, px: it belongs elsewhere
_FRAME_RATIO = 6.0  # times the median frame: cameras that contradict each other
_MAX_INCONSISTENT_SHARE = 0.5  # of the views that another camera can contradict: a minority
_CAUCHY_SCALE = 2.0
_STEP_TOLERANCE = 0.1  # of the scale: how little predictions may move
UNSEEN_PX = 1e9  # px, for points out of the field of view: further off than any other
MIN_RESIDUAL_PX = 1e-6  # px: no residual of computed points is smaller
MEDIAN_NORM = 1.1774  # of the norm of two standard normal coordinates
_MAX_ITERATIONS = 8


class WrongLandmark(NamedTuple):
    """A landmark that is not where the table says.

    number; points: of it in the table; px: median distance of these from their predictions;
    offset (3,): from the stated place to where the rays meet, m, NaN where they do not.
    """

    number: int
    points: int
    px: float
    offset: Array

    @property
    def is_displaced(self) -> bool:
        """Whether another place explains its points."""
        return bool(np.isfinite(self.offset).all())

    def to_dict(self) -> dict[str, Any]:
        """Return what files hold; offset: m, None where no place explains the points."""
        offset = self.offset.tolist() if self.is_displaced else None
        return {'landmark': self.number, 'points': self.points, 'px': self.px, 'offset': offset}


class Outliers(NamedTuple):
    """Outliers of a table: which rows of it, how far (px), and why; landmarks that are wrong."""

    rows: Index
    px: Array
    why: tuple[str, ...]
    landmarks: tuple[WrongLandmark, ...] = ()

    def join(self, other: Outliers) -> Outliers:
        """Return these and other rows."""
        return Outliers(
            np.concatenate([self.rows, other.rows]),
            np.concatenate([self.px, other.px]),
            (*self.why, *other.why),
            (*self.landmarks, *other.landmarks),
        )

    def append(self, rows: Index, px: Array, why: str) -> Outliers:
        """Return these and other rows, of one reason."""
        return self.join(Outliers(rows, px, (why,) * len(rows)))

    def append_landmarks(self, table: Observations, wrong: Sequence[WrongLandmark]) -> Outliers:
        """Return these and all points of wrong landmarks of a table."""
        px = {landmark.number: landmark.px for landmark in wrong}
        rows = np.flatnonzero(np.isin(table.landmark, list(px)))
        off = np.array([px[number] for number in table.landmark[rows].tolist()])
        return self.append(rows, off, LANDMARK)._replace(landmarks=(*self.landmarks, *wrong))

    def without_landmarks(self) -> Outliers:
        """Return those that are not of wrong landmarks."""
        kept = np.array([why != LANDMARK for why in self.why], dtype=bool)
        why = tuple(why for why in self.why if why != LANDMARK)
        return Outliers(self.rows[kept], self.px[kept], why)

    @property
    def swap_count(self) -> int:
        """How many lie where another landmark is predicted."""
        return self.why.count(SWAPPED_POINT)


NO_OUTLIERS = Outliers(np.zeros(0, dtype=np.int64), np.zeros(0), ())


def find_outliers(data: RigViews, state: RigState) -> tuple[RigViews, Outliers]:
    """Return the data without outliers, and what these were.

    A view that a model error bends as a whole holds no outlier, nor does a landmark that is off in
    most of its views.  A view out of all proportion belongs elsewhere as a whole.  A point whose
    own sigma is larger than most may lie so much further off.
    """
    model, views = state.model, data.views
    pose, alone, scale, offset = _localize_robustly(data, state)
    of_landmark = _landmark_scale(views, offset)
    typical = float(np.median(scale))
    whole = scale[:, 0] > max(_VIEW_RATIO * typical, _MIN_VIEW_PX)
    whole = np.asarray(whole & (whole.mean() < 0.2))
    limit = OUTLIER_SIGMAS * np.maximum(scale, of_landmark)
    far = views.used & (offset > limit) & ~whole[:, None]
    swapped = _find_swaps(model, pose, views, far, _SWAP_SIGMAS * typical)
    torn, apart = _inconsistent_frames(data, state, alone, typical)
    whole = whole & ~torn
    far, swapped = far & ~torn[:, None], swapped & ~torn[:, None]
    offset, outliers = offset * relative_sigma(views), NO_OUTLIERS
    for mask, px, why in (
        (swapped, offset, SWAPPED_POINT),
        (far & ~swapped, offset, FAR_POINT),
        (views.used & whole[:, None], offset, VIEW),
        (views.used & torn[:, None], apart, FRAME),
    ):
        outliers = outliers.append(views.row[mask], px[mask], why)
    return without_points(data, far | (views.used & (whole | torn)[:, None])), outliers


def _localize_robustly(data: RigViews, state: RigState) -> tuple[Pose, Pose, Array, Array]:
    """Localize every view with weights that fade for points far from their prediction (Cauchy).

    On the scale of the median residual of that view or of all, whichever is larger.  Returns poses
    (S,), those of each view by itself (S,), scales (S, 1) and offsets (S, N) over the points' own
    relative sigma, px.
    """
    model, views, pose = state.model, data.views, state.view_poses(data)
    alone = localize_cameras(model, views) if data.cameras > 1 else pose
    sigma = relative_sigma(views)
    offset = prediction_distances(model, pose, views) / sigma
    scale = robust_scale(offset)
    if not np.nanmax(offset / scale) > _SUSPICIOUS_SIGMAS:
        return pose, alone, scale, offset
    for _ in range(_MAX_ITERATIONS):
        before = offset
        fading = 1 / np.sqrt(1 + (offset / (_CAUCHY_SCALE * scale)) ** 2)
        weight = np.where(views.used, views.weight * fading, 0.0)
        pose = localize_cameras(model, views._replace(weight=weight), pose)
        offset = prediction_distances(model, pose, views) / sigma
        scale = robust_scale(offset)
        with np.errstate(invalid='ignore'):  # what is out of sight stays so
            change = np.nanmax(np.abs(offset - before) / scale)
        if change < _STEP_TOLERANCE:
            break
    return pose, pose, scale, offset


def _inconsistent_frames(
    data: RigViews, state: RigState, alone: Pose, typical: float
) -> tuple[Mask, Array]:
    """Return the views (S,) of frames whose cameras contradict each other, and by how much, px.

    Each view alone may fit, its camera posed (S,) by itself: a board seen in reversed order is a
    board turned by half.  But then no pose of the rig explains two of them, whichever is asked to
    predict the other, as little as in most frames.
    """
    if data.cameras < 2:
        return np.zeros(len(data.frame_of), dtype=bool), np.zeros(data.views.used.shape)
    misfit, apart = cross_camera_offsets(data, state, alone)
    several = np.isfinite(misfit)
    usual = float(np.quantile(misfit[several], 0.5, method='lower')) if several.any() else 0.0
    torn = several & (misfit > max(_VIEW_RATIO * typical, _MIN_VIEW_PX, _FRAME_RATIO * usual))
    # Of two views that contradict each other either may be wrong.
    borne_out = np.bincount(data.frame_of, several & ~torn)[data.frame_of] > 1
    torn |= several & ~borne_out & np.isin(data.frame_of, data.frame_of[torn])
    return np.asarray(torn & (torn.sum() < _MAX_INCONSISTENT_SHARE * several.sum())), apart


def cross_camera_offsets(data: RigViews, state: RigState, alone: Pose) -> tuple[Array, Array]:
    """Return how far off, px, each view is from where another camera of its frame has it.

    alone: poses (S,) of the views, each by itself; another camera is the one that predicts it
    best, by the rig of the state.  Returns medians (S,), infinite where no other camera saw the
    frame, and the distances (S, N) of all points.
    """
    views, model = data.views, state.model
    apart = np.zeros(views.used.shape)
    place = state.rig.take(data.camera_of)
    body = alone.compose(place.inverse())
    misfit = np.full(len(views.frame), np.inf)
    for step in range(1, data.cameras):
        # From another view of the same frame: views are in the order of frames.
        other = np.arange(len(views.frame))
        for frame_views in (np.flatnonzero(data.frame_of == f) for f in range(data.frames)):
            other[frame_views] = np.roll(frame_views, step)
        offset = prediction_distances(model, body.take(other).compose(place), views)
        median = np.nanmedian(np.minimum(offset, UNSEEN_PX), axis=1)
        frame_views = (other != np.arange(len(other))) & (median < misfit)
        apart[frame_views], misfit[frame_views] = (
            np.nan_to_num(offset[frame_views], posinf=UNSEEN_PX),
            median[frame_views],
        )
    return misfit, apart


def without_points(data: RigViews, mask: Mask) -> RigViews:
    """Return the data without some points (S, N), and without views that have none left."""
    views = data.views
    views = views._replace(
        weight=np.where(mask, 0.0, views.weight), row=np.where(mask, -1, views.row)
    )
    return replace(data, views=views).select(np.asarray(views.used.any(axis=1)))


def _find_swaps(model: ForwardModel, pose: Pose, views: Views, far: Mask, gate: float) -> Mask:
    """Which far points (S, N) lie where another landmark of the table is predicted.

    None where so many would by chance, as dense as landmarks are predicted around their own place.
    """
    from scipy import special  # not while --help waits

    ids, first = np.unique(views.landmark[views.used], return_index=True)
    points = views.points[views.used][first]
    swapped, by_chance = np.zeros_like(far), 0.0
    for view in np.flatnonzero(far.any(axis=1)):
        single = views.take(slice(view, view + 1))._replace(
            points=points[None],
            board=np.zeros((1, len(ids)), dtype=np.int64),
            landmark=ids[None],
            t=np.full((1, len(ids)), np.nan),
            uv=np.zeros((1, len(ids), 2)),
            row=np.arange(len(ids))[None],
        )
        view_pose = pose.take(slice(view, view + 1))
        seen = model.linearize(view_pose, single).uv[0]
        for point in np.flatnonzero(far[view]):
            is_another = ids != views.landmark[view, point]
            off = np.linalg.norm(seen - views.uv[view, point], axis=-1)
            swapped[view, point] = bool(np.nanmin(np.where(is_another, off, np.inf)) < gate)
            reach = 2 * off[~is_another]
            around = is_another & (np.linalg.norm(seen - seen[~is_another], axis=-1) < reach)
            by_chance += float(np.nan_to_num(around.sum() * (gate / reach) ** 2).sum())
    return np.asarray(swapped & (special.pdtrc(swapped.sum() - 1, by_chance) < _SWAP_CHANCE))


def relative_sigma(views: Views) -> Array:
    """Return the sigma of each point (S, N) over the median one, 1 at least."""
    sigma = 1 / np.where(views.used, views.weight, np.nan)
    return np.nan_to_num(np.maximum(sigma / np.nanmedian(sigma), 1.0), nan=1.0)


def robust_scale(offset: Array) -> Array:
    """Robust standard deviation of a coordinate, one a view (S, 1), from offsets (S, N)."""
    median, typical = (
        np.nanmedian(np.minimum(offset, UNSEEN_PX), axis=axis, keepdims=True) for axis in (1, None)
    )
    least = np.maximum(typical, MIN_RESIDUAL_PX)
    return np.asarray(np.maximum(median, least) / MEDIAN_NORM)


def _landmark_scale(views: Views, offset: Array) -> Array:
    """Robust standard deviations (S, N) of a coordinate, one a landmark."""
    scale = np.zeros_like(offset)
    for landmark in np.unique(views.landmark[views.used]):
        sightings = views.used & (views.landmark == landmark)
        scale[sightings] = np.median(offset[sightings]) / MEDIAN_NORM
    return scale
