"""Tags and cameras together: a map of tags from images of a walk, the lens being known.

Starts from the tag that most images show: images that show mapped tags are localized, and of a
further tag, which alone has two poses in an image, the one is taken that all images agree on.
Then one bundle adjustment of all poses, with weights that fade for outliers (Cauchy), and without
the outliers least squares, which is where the covariance holds.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.effects.forward import ForwardModel, back_project_corrected
from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.pose import Pose, cross_matrix, identity
from fisheye_svp_ros.scene.observations import Views, views_of
from fisheye_svp_ros.solve.least_squares import never_singular, solve_damped, with_unit_diagonal
from fisheye_svp_ros.solve.localization import localize

_CORNERS = 4
_MAX_ITERATIONS, _TOLERANCE = 40, 1e-9
_CAUCHY_PX = 1.5  # px of residual at which a corner's weight falls to half
_OUTLIER_PX = 1e3  # px, in place of what is out of sight
_OUTLIER_SIGMAS = 8.0  # beyond which a corner is an outlier; small tags are noisier than most
_MEDIAN = 0.6745  # of the absolute value of a Gaussian of unit deviation
_EXACT_PX = 1e-6  # px below which residuals are rounding
_MAX_CANDIDATES = 40  # poses of a new tag that are compared


class TagMapping(NamedTuple):
    """Tags (T,): id, pose in the frame of the origin, which is one of them.

    information (6 T, 6 T): of the changes in `Pose.retract` of all tags, 1 / m^2 and 1 / rad^2:
    the inverse of their covariance, with zeros between tags that no image shows together and all
    along the origin, which has no error.
    images (F,): numbers of those that could be posed; cameras (F,); rms_px over inlying corners;
    missing: ids of tags that no image ties to the others; outside: how many sightings of a tag
    reach beyond the field of view of the lens, and were left out; focal: by which share the tags
    would have the focal length larger, and its standard error.
    """

    ids: Index
    poses: Pose
    information: Array
    images: Index
    cameras: Pose
    rms_px: float
    missing: tuple[int, ...]
    outside: int
    focal: tuple[float, float]


class _Scene(NamedTuple):
    """Corners uv (F, T, 4, 2), px, NaN = unseen, of tags whose corners are local (T, 4, 3), m."""

    uv: Array
    local: Array

    def views(self, tags: Pose, chosen: Mask, images: Index) -> Views:
        """Return what some images show of chosen tags (T,), these being where they are."""
        points = self.local @ np.swapaxes(tags.rotation, -1, -2) + tags.position[:, None]
        uv = np.where(chosen[:, None, None], self.uv[images], np.nan)
        return views_of(points.reshape(-1, 3), uv.reshape(len(images), -1, 2))


def map_tags(
    model: ForwardModel,
    image: Index,
    ids: Index,
    uv: Array,
    size: float,
    origin: int | None = None,
) -> TagMapping:
    """Map tags of one size, m, from corners uv (R, 4, 2), px, by image (R,) and id (R,).

    origin: id of the tag whose frame is that of the map; None: the one that most images show.
    Raises GeometryError where nothing ties two tags together, or the lens sees none.
    """
    inside = back_project_corrected(model.lens, uv).valid.all(axis=1)
    if not inside.any():
        raise GeometryError(
            'no tag is in the field of view of the lens; does the lens belong to this camera?'
        )
    image, ids, uv = image[inside], ids[inside], uv[inside]
    known, slot = np.unique(ids, return_inverse=True)
    numbers, row = np.unique(image, return_inverse=True)
    corners = np.full((len(numbers), len(known), _CORNERS, 2), np.nan)
    corners[row, slot] = uv
    square = size / 2 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    scene = _Scene(corners, np.tile(square, (len(known), 1, 1)))
    first = int(np.argmax(np.bincount(slot)))
    if origin is not None:
        if origin not in known:
            raise GeometryError(f'no image shows tag {origin}; name another origin')
        first = int(np.flatnonzero(known == origin)[0])
    tags, mapped, cameras, posed = _grow_map(model, scene, first)
    if mapped.sum() < 2:
        raise GeometryError(
            f'no image shows tag {known[first]} together with another; take images of two or more'
        )
    images, kept = np.flatnonzero(posed), np.flatnonzero(mapped)
    scene = _Scene(scene.uv[images][:, kept], scene.local[kept])
    anchor = int(np.searchsorted(kept, first))
    tags, cameras = tags.take(kept), cameras.take(images)
    tags, cameras = _adjust(model, scene, tags, cameras, anchor, _fading)
    scene = _without_outliers(model, scene, tags, cameras)
    rows, slots = _find_connected(scene, anchor)
    images, kept, anchor = images[rows], kept[slots], int(np.searchsorted(slots, anchor))
    scene = _Scene(scene.uv[rows][:, slots], scene.local[slots])
    tags, cameras = tags.take(slots), cameras.take(rows)
    tags, cameras = _adjust(model, scene, tags, cameras, anchor, _squares)
    information, rms, focal = _assess(model, scene, tags, cameras, anchor)
    return TagMapping(
        known[kept],
        tags,
        information,
        numbers[images],
        cameras,
        rms,
        tuple(np.setdiff1d(known, known[kept]).tolist()),
        int((~inside).sum()),
        focal,
    )


def _grow_map(model: ForwardModel, scene: _Scene, first: int) -> tuple[Pose, Mask, Pose, Mask]:
    """Return tags (T,) and which are mapped, cameras (F,) and which are posed: a start."""
    frames, count = scene.uv.shape[:2]
    seen = np.isfinite(scene.uv[..., 0, 0])
    tags, cameras = identity(count), identity(frames)
    mapped, posed = np.zeros(count, dtype=bool), np.zeros(frames, dtype=bool)
    mapped[first] = True
    while True:
        posed = np.asarray((seen & mapped).any(axis=1))
        images = np.flatnonzero(posed)
        solution = localize(model, scene.views(tags, mapped, images))
        # Of one tag alone a pose may be its mirror image: two tags, or none, tell.
        sure = solution.converged & (
            ((seen[images] & mapped).sum(axis=1) > 1) | (solution.gap > 20.0)
        )
        if mapped.sum() == 1:
            sure = solution.converged
        posed[images] = sure
        cameras.put(images, solution.pose)
        shared = np.where(mapped, 0, (seen & posed[:, None]).sum(axis=0))
        if not shared.any():
            return tags, mapped, cameras, posed
        new = int(np.argmax(shared))
        alternatives = solution if mapped.sum() == 1 else None
        start = _place_tag(model, scene, new, cameras, np.flatnonzero(posed & seen[:, new]))
        if alternatives is not None:
            other = Pose(cameras.rotation.copy(), cameras.position.copy())
            other.put(images, alternatives.other)
            second = _place_tag(model, scene, new, other, np.flatnonzero(posed & seen[:, new]))
            start = min(start, second, key=lambda one: one[1])
        tags.put([new], start[0].take(None))
        mapped[new] = True


def _place_tag(
    model: ForwardModel, scene: _Scene, tag: int, cameras: Pose, images: Index
) -> tuple[Pose, float]:
    """Return the pose of a tag that images with known cameras agree on, and their misfit, px."""
    views = views_of(scene.local[tag], scene.uv[images, tag])
    alone = localize(model, views)
    here = cameras.take(images)
    candidates = Pose.concatenate(
        [here.compose(one.inverse()) for one in (alone.pose, alone.other)]
    )
    finite = np.isfinite(candidates.position).all(axis=1)
    step = max(1, int(finite.sum()) // _MAX_CANDIDATES)
    best, least = candidates.take(0), np.inf
    for number in np.flatnonzero(finite)[::step]:
        one = candidates.take(number)
        points = scene.local[tag] @ one.rotation.T + one.position
        off = model.predict(here, views_of(np.tile(points, (len(images), 1, 1)))).uv - views.uv
        length = np.nan_to_num(np.linalg.norm(off, axis=-1), nan=_OUTLIER_PX)
        misfit = float(np.minimum(length, _OUTLIER_PX).mean())
        if misfit < least:
            best, least = one, misfit
    return best, least


def _adjust(
    model: ForwardModel,
    scene: _Scene,
    tags: Pose,
    cameras: Pose,
    anchor: int,
    loss: Callable[[Array], tuple[float, Array]],
) -> tuple[Pose, Pose]:
    """Adjust all poses but that of the anchor, and return them.

    loss: cost and weights of residuals.
    """
    frames, count = scene.uv.shape[:2]
    free = _free_columns(frames, count, anchor)
    damping, (residual, jacobian, _) = 1e-4, _linearize(model, scene, tags, cameras)
    cost, weight = loss(residual)
    for _ in range(_MAX_ITERATIONS):
        columns = jacobian[:, free]
        weighted = columns * weight[:, None]
        hessian, gradient = weighted.T @ columns, weighted.T @ residual
        damped = hessian + damping * np.diag(np.diag(hessian)) + 1e-12 * np.eye(len(hessian))
        step = np.zeros(6 * (frames + count))
        step[free] = -np.linalg.solve(damped, gradient)
        moves = step.reshape(-1, 6)
        trial = Pose(*tags.retract(moves[frames:])), Pose(*cameras.retract(moves[:frames]))
        fresh = _linearize(model, scene, *trial)
        lower, weight_there = loss(fresh[0])
        if lower <= cost:
            done = cost - lower <= _TOLERANCE * cost
            (tags, cameras), (residual, jacobian, _) = trial, fresh
            cost, weight = lower, weight_there
            damping = max(damping / 5, 1e-12)
            if done:
                break
        else:
            damping *= 8
    return tags, cameras


def _free_columns(frames: int, count: int, anchor: int) -> Index:
    """Return which of the 6 (F + T) columns of poses are free: all but those of the anchor."""
    held = slice(6 * (frames + anchor), 6 * (frames + anchor + 1))
    return np.delete(np.arange(6 * (frames + count)), held)


def _without_outliers(model: ForwardModel, scene: _Scene, tags: Pose, cameras: Pose) -> _Scene:
    """Return the corners without the sightings of tags that hold an outlier."""
    views = scene.views(tags, np.ones(len(tags.position), dtype=bool), np.arange(len(scene.uv)))
    off = (views.uv - model.predict(cameras, views).uv).reshape(scene.uv.shape)
    off = np.abs(np.where(np.isfinite(scene.uv), off, np.nan))
    scale = max(float(np.nanmedian(off)) / _MEDIAN, _EXACT_PX)
    wrong: Mask = np.asarray((off > _OUTLIER_SIGMAS * scale).any(axis=(2, 3)))
    return scene._replace(uv=np.where(wrong[..., None, None], np.nan, scene.uv))


def _find_connected(scene: _Scene, anchor: int) -> tuple[Index, Index]:
    """Return which images and tags sightings tie to the anchor, with others in between."""
    seen: Mask = np.asarray(np.isfinite(scene.uv[..., 0, 0]))
    tags = np.array([anchor])
    while True:
        images = np.flatnonzero(seen[:, tags].any(axis=1))
        reached = np.flatnonzero(seen[images].any(axis=0))
        if len(reached) <= len(tags):
            return images, tags
        tags = reached


def _assess(
    model: ForwardModel, scene: _Scene, tags: Pose, cameras: Pose, anchor: int
) -> tuple[Array, float, tuple[float, float]]:
    """Return the information of tags (6 T, 6 T), the rms of corners, px, and the focal length.

    The last: by which share the corners would have it larger, one step with all poses free, and
    its standard error.
    """
    frames, count = scene.uv.shape[:2]
    residual, jacobian, uv = _linearize(model, scene, tags, cameras)
    free = _free_columns(frames, count, anchor)
    columns = jacobian[:, free]
    variance = float((residual**2).sum()) / max(len(residual) - len(free), 1)
    rms = float(np.sqrt(2 * (residual**2).mean()))
    normal = columns.T @ columns
    growth = (uv - (model.lens.cx, model.lens.cy)).ravel()
    by_poses = solve_damped(normal[None], (columns.T @ growth)[None], np.zeros(1))[0]
    growth = growth + columns @ by_poses  # what poses leave
    information = float((growth**2).sum())
    change = -float((growth * residual).sum()) / information
    focal = change, float(np.sqrt(variance / information))
    return _tag_information(jacobian, frames, anchor) / max(variance, _EXACT_PX**2), rms, focal


def _tag_information(jacobian: Array, frames: int, anchor: int) -> Array:
    """Return the information (6 T, 6 T) of tags, cameras eliminated, zero along the anchor."""
    by_camera, by_tag = np.split(jacobian, [6 * frames], axis=1)
    cross = (by_camera.T @ by_tag).reshape(frames, 6, -1)
    of_camera = by_camera.T @ by_camera
    own = np.stack([of_camera[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i in range(frames)])
    scaled, scale = with_unit_diagonal(own, 0.0)
    inverse = never_singular(np.linalg.inv, scaled) / (scale[:, :, None] * scale[:, None, :])
    known = (np.swapaxes(cross, -1, -2) @ inverse @ cross).sum(axis=0)
    information = by_tag.T @ by_tag - known
    held = slice(6 * anchor, 6 * anchor + 6)
    information[held] = information[:, held] = 0.0
    return np.asarray(information + information.T) / 2


def _fading(residual: Array) -> tuple[float, Array]:
    """Return Cauchy's cost and weights."""
    square = (residual / _CAUCHY_PX) ** 2
    return float(_CAUCHY_PX**2 * np.log1p(square).sum()), np.asarray(1 / (1 + square))


def _squares(residual: Array) -> tuple[float, Array]:
    """Return the cost and weights of least squares."""
    return float((residual**2).sum()), np.ones_like(residual)


def _linearize(
    model: ForwardModel, scene: _Scene, tags: Pose, cameras: Pose
) -> tuple[Array, Array, Array]:
    """Return residuals (M,), px, their derivatives (M, 6 (F + T)) by cameras, then tags.

    And the pixels (M / 2, 2) that they belong to.
    """
    frames, count = scene.uv.shape[:2]
    views = scene.views(tags, np.ones(count, dtype=bool), np.arange(frames))
    linear = model.linearize(cameras, views)
    by_camera = model.d_pose(linear, views)
    used = views.used & np.isfinite(linear.uv).all(axis=-1)
    frame, point = np.nonzero(used)
    by_camera = by_camera[frame, point]
    tag = point // _CORNERS
    arm = views.points[frame, point] - tags.position[tag]
    # A point moves the image as the camera moves it the other way.
    by_point = -by_camera[:, :, :3]
    by_tag = np.concatenate([by_point, -by_point @ cross_matrix(arm)], axis=-1)
    jacobian = np.zeros((len(frame), 2, frames + count, 6))
    rows = np.arange(len(frame))
    jacobian[rows, :, frame] = by_camera
    jacobian[rows, :, frames + tag] = by_tag
    uv = linear.uv[frame, point]
    residual = uv - views.uv[frame, point]
    return residual.ravel(), jacobian.reshape(2 * len(frame), -1), uv
