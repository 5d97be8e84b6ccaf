"""Start values for a lens calibration: a focal length and a pose a view, from nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.optics.camera import back_project, project
from fisheye_svp_ros.optics.lens import Lens, field_of_view, monotone_limit
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Views, views_of
from fisheye_svp_ros.solve.initial_pose import initial_poses

# Incidence angles between which the farthest image corner is looked for, rad, and in how many
# steps; neighbouring focal lengths differ by less than a fifth.
_CORNER_ANGLES = np.geomspace(np.radians(4.0), np.radians(160.0), 24)
_VIEWS, _POINTS = 20, 60  # enough for a start
_GOLDEN = (np.sqrt(5) - 1) / 2
_LOST, _FEW_LOST = 6.0, 0.2  # times the median view; of the views


def focal_candidates(lens: Lens, views: Views, keep: int) -> tuple[Array, Pose]:
    """Return the best focal lengths (C,), px, of a scan and the poses (C, V) under each.

    The image height is that of `lens` with the coefficients it has (kannala_brandt without any is
    equidistant), the centre is the lens's.  Candidates are ranked by what their poses leave over.
    """
    focals, pose, rms = _scan(lens, views)
    # A sum of root mean squares forgives one lost view.
    best = np.argsort(rms.sum(axis=1))[:keep]
    return focals[best], pose.take(best)


def lost_views(lens: Lens, views: Views) -> Mask:
    """Return which views (V,) are far worse than most at the focal length that suits most.

    No pose goes with their points, as those are in another order, say.  None where a fifth or
    more of the views are: then it is another lens that is wanted.
    """
    rms = _scan(lens, views)[2]
    middle = np.median(rms, axis=1)
    best = int(np.argmin(middle))
    lost: Mask = rms[best] > _LOST * middle[best]
    return lost if lost.mean() < _FEW_LOST else np.zeros_like(lost)


def _scan(lens: Lens, views: Views) -> tuple[Array, Pose, Array]:
    """Return focal lengths (C,), px, the poses (C, V) under each, and rms of each view, px."""
    corner = np.hypot(lens.width, lens.height) / 2
    heights, _ = lens.image_height.value_and_slope(
        np.minimum(_CORNER_ANGLES, monotone_limit(lens))
    )
    focals = np.unique(corner / heights)
    lenses = [replace(lens, fx=focal, fy=focal) for focal in focals.tolist()]
    lenses = [replace(one, max_incidence=field_of_view(one)) for one in lenses]
    direction = np.stack([back_project(one, views.uv).direction for one in lenses])
    shape = direction.shape[:3]
    points = np.broadcast_to(views.points, (*shape, 3)).reshape(-1, *views.points.shape[1:])
    weight = np.broadcast_to(views.weight, shape).reshape(-1, shape[-1])
    pose = initial_poses(points, direction.reshape(points.shape), weight).reshape(*shape[:2])
    rms = np.array([_view_rms(one, pose.take(i), views) for i, one in enumerate(lenses)])
    return focals, pose, rms


def select_points(views: Views, most: int = _VIEWS) -> Views:
    """Return the views that spread widest in the image, with a few evenly spread points each."""
    used = views.used[..., None]
    count = used.sum(axis=(1, 2))
    centre = (views.uv * used).sum(axis=1, keepdims=True) / count[:, None, None]
    spread = ((views.uv - centre) ** 2 * used).sum(axis=(1, 2)) / count
    widest = np.sort(np.argsort(-spread, kind='stable')[:most])
    chosen = views.take(widest)
    # Multiples of the golden ratio do not fall into step with the rows of a board.
    steps = np.arange(min(_POINTS, int(count.max()))) * _GOLDEN % 1
    slot = (count[widest, None] * steps).astype(np.int64)
    uv = np.take_along_axis(chosen.uv, slot[..., None], axis=1)
    points = np.take_along_axis(chosen.points, slot[..., None], axis=1)
    return views_of(points, uv, np.take_along_axis(chosen.weight, slot, axis=1))


def _view_rms(lens: Lens, pose: Pose, views: Views) -> Array:
    """Return the root mean square of the residuals of each view (V,), px."""
    image = project(lens, pose.into_body(views.points), limited=False)
    distance2 = np.where(views.used, ((image.uv - views.uv) ** 2).sum(axis=-1), 0.0)
    mean = distance2.sum(axis=1) / views.used.sum(axis=1)
    return np.sqrt(np.where(np.isfinite(mean), mean, np.inf))
