"""Self-localization: the pose of a camera from the image points of known landmarks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.effects.forward import ForwardModel, ModelPart
from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.optics import engines
from fisheye_svp_ros.optics.engines.marquardt import MAX_ITERATIONS
from fisheye_svp_ros.optics.engines.results import PLANARITY
from fisheye_svp_ros.optics.engines.results import Localization as Localization
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Views
from fisheye_svp_ros.scene.pose_priors import PlanarPrior
from fisheye_svp_ros.solve.initial_pose import candidate_poses, initial_poses
from fisheye_svp_ros.solve.landmark_errors import covariance_by_landmarks, generalized_equations
from fisheye_svp_ros.solve.least_squares import (
    UNDETERMINED_EIGENVALUE,
    Arrays,
    dense_step,
    levenberg_marquardt,
    never_singular,
    solve_damped,
    with_unit_diagonal,
)

MIN_POINTS, FEW_POINTS = 4, 6
_STARTING_STEPS = 4  # from rough poses to ones that a joint solution can begin with
_MOTIONS = 3  # times that velocities and poses follow from each other
_MIN_AREA = 0.1  # of the largest of the four triangles that four points of a plane have
_MIN_SEPARATION = 0.01  # squared Mahalanobis distance of two minima
_WEIGHINGS = 2  # steps from a pose by exact landmarks to one by their errors
_VIEWS_AT_ONCE = 64  # whose noise is a full matrix
_FAR = 50.0  # px, beyond which a point is as wrong as it can be


def localize(model: ForwardModel, views: Views, start: Pose | None = None) -> Localization:
    """Return the maximum-likelihood pose of every view; no start value is needed.

    Kita, section 3: bundle adjustment of one camera against known landmarks.  A flat target seen
    small looks, tilted to one side, like tilted to the other, and the misfit has a minimum on
    either side (Schweighofer and Pinz, PAMI 2006; Collins and Bartoli, IJCV 2014): both are tried.
    So are all minima of views with fewer than FEW_POINTS points that are not flat.
    Landmarks that have a covariance are weighed by it (`solve.landmark_errors`); a prior of the
    views counts as further observations do.
    What a lens has that follows from motion (a rolling shutter) needs times: velocities are those
    between the poses of neighboring views.
    Raises GeometryError, naming the frame, for fewer than MIN_POINTS usable points.
    """
    model = model.seeing(views)
    still = model.without_motion()
    solution = _localize(still, views, start)
    for _ in range(_MOTIONS if still is not model else 0):
        moving = views._replace(t=np.where(solution.converged[:, None], views.t, np.nan))
        moved, stood = (one.predict(solution.pose, moving, False).uv for one in (model, still))
        moved = np.nan_to_num(moved - stood)
        if not moved.any():
            break
        solution = _localize(still, views._replace(uv=views.uv - moved), solution.pose)
    return solution


def nearly_localize(model: ForwardModel, views: Views) -> tuple[Pose, Mask]:
    """Return poses (S,) that a joint solution can begin with, and which of them are determined.

    As `localize`, but only a few steps from rough poses and their mirror images, all at once.
    Raises GeometryError, naming the frame, for fewer than MIN_POINTS usable points.
    """
    model = model.seeing(views)
    few = (views.weight > 0).sum(axis=1) < FEW_POINTS
    if few.any() or model.without_motion() is not model:
        solved = localize(model, views)
        return solved.pose, solved.converged
    rough, count = start_poses(model, views), len(views.frame)
    flat, center, normal = _flat_targets(views)
    rows, mirrored = np.append(np.arange(count), flat), np.arange(count, count + len(flat))
    start = rough.take(rows)
    eye = _viewpoints(model, views).take(flat, axis=0)
    start.put(mirrored, _mirror_image(rough.take(flat), center, normal, eye))
    solved, _ = _solve_from(model, views.take(rows), start, _STARTING_STEPS)
    cost = np.where(solved.converged, solved.cost, np.inf)
    best = np.arange(count)
    best[flat] = np.where(cost[mirrored] < cost[flat], mirrored, flat)
    return solved.pose.take(best), solved.converged[best]


def improve_poses(model: ForwardModel, views: Views, start: Pose) -> Pose:
    """Return poses (S,) a few steps from others toward their minima; no other minima are tried.

    Raises GeometryError, naming the frame, for fewer than MIN_POINTS usable points.
    """
    still = model.seeing(views).without_motion()
    return _solve_from(still, views, start, _STARTING_STEPS)[0].pose


def _localize(model: ForwardModel, views: Views, start: Pose | None) -> Localization:
    """Return the poses of views whose cameras do not move, see `localize`."""
    anywhere = start is None
    if start is None:
        check_views(views, MIN_POINTS)
        start = start_poses(model, views)
    found, some_flat = _solve_from(model, views, start)
    flat: Index = np.zeros(0, dtype=np.int64)
    if some_flat:
        flat, center, normal = _flat_targets(views)
        if flat.size:
            eye = _viewpoints(model, views).take(flat, axis=0)
            reflected = _mirror_image(found.pose.take(flat), center, normal, eye)
            _improve(model, views, found, flat, reflected.reshape(len(flat), 1))
    if anywhere:
        few = np.flatnonzero((views.weight > 0).sum(axis=1) < FEW_POINTS)
        few = np.setdiff1d(few, flat[_are_spread(views.take(flat))])
        if few.size:
            some = views.take(few)
            direction = model.back_project(some.uv).direction
            _improve(
                model, views, found, few, candidate_poses(some.points, direction, some.weight)
            )
    if views.landmark_covariance is not None or views.prior is not None:
        rows = np.flatnonzero(found.converged)
        for first in range(0, len(rows), _VIEWS_AT_ONCE):
            _weigh(model, views, found, rows[first : first + _VIEWS_AT_ONCE])
    return found


def _are_spread(views: Views) -> Mask:
    """Say which views (S,) have four points or more that no three of them could replace.

    Of four points of a plane, two beside each other leave the minima of three points.
    """
    used = views.weight > 0
    order = np.argsort(~used, axis=1, kind='stable')[:, :4]
    corners = np.take_along_axis(views.points, order[..., None], axis=1)
    triangles = corners[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]]
    sides = triangles[:, :, 1:] - triangles[:, :, :1]
    areas = np.linalg.norm(np.cross(sides[:, :, 0], sides[:, :, 1]), axis=-1)
    spread = areas.min(axis=1) > _MIN_AREA * areas.max(axis=1)
    return np.asarray(spread | (used.sum(axis=1) > 4))


def _weigh(model: ForwardModel, views: Views, localization: Localization, rows: Index) -> None:
    """Write to views (R,), solved by exact landmarks alone, what their covariance and prior do."""
    before, seen = localization.take(rows), views.take(rows)
    weighed, two = _weigh_from(model, seen, before.pose), np.flatnonzero(np.isfinite(before.gap))
    if two.size:
        second = _weigh_from(model, seen.take(two), before.other.take(two))
        first = weighed.take(two)
        better = second.cost < first.cost
        weighed.put(two[better], second.take(better))
        weighed.other.put(two, first.pose.where(better, second.pose))
        weighed.gap[two] = np.abs(second.cost - first.cost)
    if seen.prior is not None:  # residuals are tested without it
        weighed.cost[:] = np.maximum(weighed.cost - seen.prior.equations(weighed.pose)[0], 0.0)
    if seen.landmark_covariance is not None:
        added = covariance_by_landmarks(model, seen, weighed.pose, weighed.covariance)
        weighed.added[:] = added
    localization.put(rows, weighed._replace(iterations=before.iterations))


def _weigh_from(model: ForwardModel, views: Views, pose: Pose) -> Localization:
    """Return the minima (S,) near poses (S,), landmarks being weighed by their covariance.

    A prior may move a pose far that the image leaves open.
    """
    if views.prior is not None:
        problem = _Localization(model, views._replace(landmark_covariance=None), views.prior)
        pose = Pose(*levenberg_marquardt(problem, tuple(pose)).state)
    cost, (hessian, gradient) = pose_equations(model, pose, views)
    for _ in range(_WEIGHINGS):
        trial = pose.retract(solve_damped(hessian, gradient, np.zeros(len(cost))))
        lower, normal = pose_equations(model, trial, views)
        seen = np.isfinite(lower)
        pose, cost = trial.where(seen, pose), np.where(seen, lower, cost)
        hessian = np.where(seen[:, None, None], normal[0], hessian)
        gradient = np.where(seen[:, None], normal[1], gradient)
    covariance, fixed = _covariance(hessian)
    covariance[~fixed] = np.nan
    off, no_steps = residuals(model, pose, views), np.zeros(len(cost), dtype=np.int64)
    return Localization.of_one_minimum(pose, covariance, off, cost, fixed, no_steps)


def _improve(
    model: ForwardModel, views: Views, localization: Localization, rows: Index, start: Pose
) -> None:
    """Write what fits better from further starts (R, C) of views (R,), and the second best."""
    repeated = np.repeat(rows, start.shape[1])
    other, _ = _solve_from(model, views.take(repeated), start.reshape(-1))
    cost = np.where(other.converged, other.cost, np.inf).reshape(start.shape)
    before = localization.take(rows)
    known = Pose.stack([before.pose, before.other])
    minima = Pose(
        *(
            np.concatenate([np.moveaxis(old, 0, 1), new], axis=1)
            for old, new in zip(known, other.pose.reshape(*start.shape), strict=True)
        )
    )
    costs = np.stack([before.cost, before.cost + before.gap], axis=1)
    costs = np.concatenate([costs, cost], axis=1)
    best = np.argmin(cost, axis=1) + start.shape[1] * np.arange(len(rows))
    better = cost.min(axis=1) < before.cost
    localization.put(rows[better], other.take(best[better]))
    now = localization.take(rows)
    away = minima.difference(now.pose.take((slice(None), None)))
    costs[~(squared_distances(away, now.covariance) > _MIN_SEPARATION)] = np.inf
    second = np.arange(len(rows)), np.argmin(costs, axis=1)
    localization.other.put(rows, minima.take(second))
    base = np.where(now.converged, now.cost, -np.inf)
    localization.gap[rows] = np.maximum(costs[second] - base, 0.0)


def _solve_from(
    model: ForwardModel, views: Views, start: Pose, steps: int | None = None
) -> tuple[Localization, bool]:
    """Solve from these starts alone; return also whether any target may be flat.

    steps: after which the reference is near enough; None: it converges.
    """
    quick = None
    if model.is_lens_only:
        quick = engines.localize(model.lens, views.solver_inputs, views.row, MIN_POINTS, start)
    if quick is None:
        return _by_reference(model, views, start, steps), True
    found, remaining, flat = quick
    if remaining:
        rest = np.flatnonzero(~found.converged)
        found.put(rest, _by_reference(model, views.take(rest), start.take(rest)))
    return found, flat > 0


def _by_reference(
    model: ForwardModel, views: Views, start: Pose, steps: int | None = None
) -> Localization:
    check_views(views, MIN_POINTS)
    most = MAX_ITERATIONS if steps is None else steps
    solved = levenberg_marquardt(_Localization(model, views), tuple(start), most)
    pose = Pose(*solved.state)
    covariance, fixed = _covariance(solved.normal[0])
    fixed &= solved.converged | (solved.iterations == steps)
    covariance[~fixed] = np.nan
    return Localization.of_one_minimum(
        pose, covariance, residuals(model, pose, views), solved.cost, fixed, solved.iterations
    )


def residuals(model: ForwardModel, pose: Pose, views: Views) -> Array:
    """Return measured minus predicted image points (S, N, 2), px, NaN for padding."""
    off = views.uv - model.predict(pose, views, limited=False).uv
    off[~views.used] = np.nan
    return off


def sight(model: ForwardModel, pose: Pose, views: Views) -> tuple[Array, Array]:
    """Return incidence angles, rad, and ranges, m, of points (S, N) from poses (S,), as solved."""
    theta, distance = [], []
    for part in model.parts(views):
        camera = pose.compose(part.place.broadcast_to(*pose.shape))
        image = part.model.linearize(camera, part.views).image
        theta.append(image.incidence.theta)
        distance.append(np.linalg.norm(image.points, axis=-1))
    return np.concatenate(theta, axis=1), np.concatenate(distance, axis=1)


def start_poses(model: ForwardModel, views: Views) -> Pose:
    """Return rough poses (S,) of the views from the directions of their rays.

    Raises GeometryError, naming the frame, where too few points lie inside the field of view.
    """
    rays = model.back_project(views.uv)
    inside = np.where(rays.valid, views.weight, 0.0)
    check_views(views._replace(weight=inside), MIN_POINTS, 'inside the field of view of the lens')
    pose = initial_poses(views.points, rays.direction, inside)
    # Seen from the rough pose, each landmark's own viewpoint can be brought to the origin: near a
    # lens with a shift the pose would otherwise leave landmarks without an image.
    axial = np.where(inside[..., None] > 0, rays.origin, 0.0)
    if np.any(axial):
        pose = initial_poses(
            views.points - axial @ np.swapaxes(pose.rotation, -1, -2), rays.direction, inside
        )
    parts = model.parts(views)
    return pose if len(parts) == 1 else _best_starts(model, views, pose, parts)


def _best_starts(
    model: ForwardModel, views: Views, rough: Pose, parts: Sequence[ModelPart]
) -> Pose:
    """Return the starts (S,) of a rig that fit best: rough ones, or by one of its cameras."""
    off = _capped_costs(model, views, rough)
    pose = Pose(rough.rotation.copy(), rough.position.copy())
    for part in parts:
        inside = (part.views.weight > 0) & part.model.back_project(part.views.uv).valid
        rows = np.flatnonzero(inside.sum(axis=1) >= MIN_POINTS)
        if not rows.size:
            continue
        alone = localize(part.model.without_motion(), part.views.take(rows))
        body = part.place.inverse().broadcast_to(len(rows))
        for camera in (alone.pose, alone.other):
            start = camera.compose(body)
            cost = _capped_costs(model, views.take(rows), start)
            better = alone.converged & (cost < off[rows])
            pose.put(rows[better], start.take(better))
            off[rows[better]] = cost[better]
    return pose


def _capped_costs(model: ForwardModel, views: Views, pose: Pose) -> Array:
    """Return sums (S,) of squared offsets, px, none more than _FAR: wrong points count little."""
    off = np.linalg.norm(views.uv - model.predict(pose, views).uv, axis=-1)
    off = np.where(np.isfinite(off), np.minimum(off, _FAR), _FAR)
    return np.asarray(np.where(views.weight > 0, off**2, 0.0).sum(axis=1))


def _flat_targets(views: Views) -> tuple[Index, Array, Array]:
    """Return the views (F,) of flat targets, the centers (F, 3) of these and normals (F, 3)."""
    weight = views.weight[:, None]
    center = weight @ views.points / weight.sum(axis=2, keepdims=True)
    centerd = views.points - center
    extent, axes = np.linalg.eigh((np.swapaxes(centerd, -1, -2) * weight) @ centerd)
    flat = np.flatnonzero(extent[:, 0] < PLANARITY**2 * extent[:, 2])
    return flat, center[flat, 0], axes[flat, :, 0]


def _viewpoints(model: ForwardModel, views: Views) -> Array:
    """Return where the views (S,) are seen from, in the body, (S, 3), m: the mean of the rays."""
    parts = model.parts(views)
    count = [(part.views.weight > 0).sum(axis=1)[:, None] for part in parts]
    total = sum(one * part.place.position for one, part in zip(count, parts, strict=True))
    return np.asarray(total / np.maximum(sum(count), 1))


def _mirror_image(pose: Pose, center: Array, normal: Array, eye: Array) -> Pose:
    """Reflect the target, flat across `normal` (S, 3), by the plane across its line of sight.

    eye (S, 3), m: where that begins, in the body.
    """
    place = pose.inverse().transform(center)
    sight = place - eye
    along = sight / np.maximum(np.linalg.norm(sight, axis=-1, keepdims=True), 1e-12)
    to_camera = _mirror(along) @ np.swapaxes(pose.rotation, -1, -2) @ _mirror(normal)
    rotation = np.swapaxes(to_camera, -1, -2)
    return Pose(rotation, center - (rotation @ place[..., None])[..., 0])


def _mirror(normal: Array) -> Array:
    return np.asarray(np.eye(3) - 2 * normal[..., :, None] * normal[..., None, :])


def check_views(views: Views, minimum: int, what: str = 'in it') -> None:
    """Raise GeometryError, naming the first frame with fewer than `minimum` weighted points."""
    counts = (views.weight > 0).sum(axis=1)
    poor = np.flatnonzero(counts < minimum)
    if poor.size:
        raise GeometryError(
            f'frame {views.frame[poor[0]]} has {counts[poor[0]]} usable points {what}; '
            f'at least {minimum} are needed'
        )


def squared_distances(change: Array, covariance: Array) -> Array:
    """Return Mahalanobis squares (S, K) of changes (S, K, 6) by covariances (S, 6, 6)."""
    relative, scale = with_unit_diagonal(covariance, 0.0)
    unit = change / scale[:, None]
    return np.asarray((unit * (unit @ never_singular(np.linalg.inv, relative))).sum(axis=-1))


def _covariance(hessian: Array) -> tuple[Array, Mask]:
    """Return the inverses of information (S, 6, 6), and which (S,) are determined."""
    relative, scale = with_unit_diagonal(hessian, 0.0)
    inverse = never_singular(np.linalg.inv, relative)
    # The trace of the inverse is the reciprocal of the smallest eigenvalue, up to a factor of 6.
    spread = np.trace(inverse, axis1=-2, axis2=-1)
    outer = scale[..., :, None] * scale[..., None, :]
    return inverse / outer, (spread > 0) & (spread < 1 / UNDETERMINED_EIGENVALUE)


class _Localization:
    """S systems of one pose each, see least_squares.LeastSquares."""

    step = staticmethod(dense_step)

    def __init__(
        self, model: ForwardModel, views: Views, prior: PlanarPrior | None = None
    ) -> None:
        self._model = model
        self._views = views._replace(landmark_covariance=None, prior=prior)  # see `_weigh`

    def linearize(self, state: Arrays, index: Index) -> tuple[Array, Arrays]:
        views = self._views
        if len(index) < len(views.frame):
            views = views.take(index)
        return pose_equations(self._model, Pose(*state), views)

    def retract(self, state: Arrays, step: Arrays) -> Arrays:
        return tuple(Pose(*state).retract(step[0]))


def pose_equations(model: ForwardModel, pose: Pose, views: Views) -> tuple[Array, Arrays]:
    """Return costs (S,) and (H (S, 6, 6), g (S, 6)) of poses (S,), each the only unknown."""
    exact = views.landmark_covariance is None
    if exact and model.is_lens_only and model.lens.is_bare:
        cost, hessian, gradient = engines.pose_equations(model.lens, *pose, views.solver_inputs)
    else:
        linear = model.linearize(pose, views)
        equations = normal_equations if exact else generalized_equations
        cost, (hessian, gradient) = equations(linear.uv, model.d_pose(linear, views), views)
    if views.prior is not None:
        more = views.prior.equations(pose)
        cost, hessian, gradient = cost + more[0], hessian + more[1], gradient + more[2]
    return cost, (hessian, gradient)


def normal_equations(uv: Array, jacobian: Array, views: Views) -> tuple[Array, Arrays]:
    """Return cost (S,) and (H (S, P, P), g (S, P)) of predictions with Jacobian (S, N, 2, P)."""
    weight = views.weight[..., None]
    with np.errstate(invalid='ignore'):
        residual = np.where(weight > 0, (uv - views.uv) * weight, 0.0)
    systems, rows, columns = len(uv), 2 * uv.shape[1], jacobian.shape[-1]
    j = np.where(weight[..., None] > 0, jacobian * weight[..., None], 0.0)
    j = j.reshape(systems, rows, columns)
    r = residual.reshape(systems, rows, 1)
    transposed = np.swapaxes(j, -1, -2)
    cost = (r**2).sum(axis=(1, 2))
    outside = ~np.isfinite(cost)
    hessian, gradient = transposed @ j, (transposed @ r)[..., 0]
    hessian[outside], gradient[outside] = np.eye(columns), 0.0
    return np.where(outside, np.inf, cost), (hessian, gradient)
