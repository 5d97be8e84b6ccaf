"""Which solved poses can be believed: a test of every misfit, and outliers found and named.

A view passes when its misfit is what its sigma allows (chi-square) and no residual stands out of
the others.  One that does not is searched for a pose that most of its points agree on: the points
that do not are outliers (Fischler and Bolles, CACM 1981; locally optimized after Chum, Matas,
Kittler, DAGM 2003).  Views that pass pay for no search.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Views
from fisheye_svp_ros.scene.pose_priors import PRIOR_ROWS
from fisheye_svp_ros.solve.initial_pose import initial_poses
from fisheye_svp_ros.solve.landmark_errors import with_own_errors
from fisheye_svp_ros.solve.least_squares import misfit_fails
from fisheye_svp_ros.solve.localization import (
    MIN_POINTS,
    Localization,
    improve_poses,
    localize,
    residuals,
)
from fisheye_svp_ros.solve.solved_poses import SolvedPoses
from fisheye_svp_ros.solve.stereo_depth import triangulate_optimally
from fisheye_svp_ros.solve.tag_units import (
    TagChoices,
    choose_tags,
    cover_choices,
    holds_tags,
    suspect_tags,
    tags_agree,
)
from fisheye_svp_ros.solve.weak_geometry import hold_weak_geometry

_MAX_RESIDUAL_RATIO = 3.8  # a residual beside the root mean square of all, which starts a search
_OUTLIER_SIGMAS = 5.0  # standard deviations
_MIN_AGREEMENT = 0.6  # of the points must agree on a pose
_SPARE_POINTS = 3  # points beyond a minimal set that must agree as well
_SUBSETS, _SUBSET, _FEW_SUBSETS, _KEPT, _ROUNDS = 120, 6, 30, 6, 8
_FADE = 2.0  # standard deviations at which a point's weight falls to about half
_MEDIAN = 1.1774  # median length of a plane Gaussian vector of unit deviation
_INFINITE = 1e6  # standard deviations: what is more is as good as infinite
_MAX_RANGE = 100.0  # m, a range at which landmarks are probably not in meters
NOISIEST_PX = 2.0  # px, that a detector leaves
# Where sigma is unknown: a view may misfit this many times as much as most do; how many views
# can be held against each other; and px below which residuals are rounding.
_TOLERANCE, _OTHERS, _EXACT = 2.0, 4, 1e-6
_MAX_NAMES = 5


def examine(
    model: ForwardModel,
    views: Views,
    localization: Localization,
    sigma_known: bool = True,
    searched: bool = True,
    tags: bool = False,
) -> SolvedPoses:
    """Test the poses that `localize` found, and look for outliers where they fail.

    sigma_known: whether weights are 1 / sigma; if not, views are held against each other, a
    single one against its own median residual, and covariances are scaled by the estimate.
    searched: look for outliers; without, a view that fails is only said to.  tags: the boards of
    the views are tags, whose points stand or fall together.
    """
    model = model.seeing(views)
    freedom = np.maximum(2 * (views.weight > 0).sum(axis=1) - 6, 1)
    scale, tolerance = 1.0, 1.0
    if not sigma_known:
        usual = float(np.sqrt(np.median(localization.cost / freedom)))
        if len(freedom) < _OTHERS:
            usual = min(usual, float(_noise_from_median(views, localization).max()))
        scale, tolerance = max(usual, _EXACT), _TOLERANCE
    checked, choices = _test(model, views, localization, scale, tolerance, searched, tags)
    if not sigma_known:
        checked = _estimate_noise(checked)
    checked = _hold_covariances(model, checked, choices)
    return _with_suspects(model, checked) if tags and sigma_known else checked


def _estimate_noise(checked: SolvedPoses) -> SolvedPoses:
    """Return the poses with the noise that the residuals of those show which pass."""
    result, weight = checked.result, checked.views.weight
    passed = np.array([not reason for reason in checked.reasons]) & result.converged
    sound = passed if passed.any() else result.converged
    rows = 2 * ((weight > 0) & ~checked.outliers)[sound].sum()
    sigma = noise_sigma(result.cost[sound].sum(), int(rows), 6 * int(sound.sum()))
    reasons = checked.reasons
    if sigma > NOISIEST_PX:
        noisy = (
            f'the noise would be {sigma:.3g} px, more than any detector has: check lens, '
            'image size, landmarks and their unit'
        )
        reasons = tuple(_join_reasons(noisy, reason) for reason in reasons)
    return checked._replace(reasons=reasons, sigma=sigma)


def _with_suspects(model: ForwardModel, checked: SolvedPoses) -> SolvedPoses:
    """Return also which tags, of those that were not left out, may have moved."""
    views = checked.views
    inliers = views._replace(weight=np.where(checked.outliers, 0.0, views.weight))
    suspects = tuple(
        suspect_tags(model, inliers.take([i]), checked.result.take([i]))
        for i in range(len(checked.reasons))
    )
    return checked._replace(suspects=suspects)


def _hold_covariances(
    model: ForwardModel, checked: SolvedPoses, choices: Mapping[int, TagChoices]
) -> SolvedPoses:
    """Return covariances that hold for weak geometry and cover each choice of tags (by view).

    An estimated sigma is in units of 1 / weight, which they are scaled by.
    """
    sigma = 1.0 if checked.sigma is None else checked.sigma

    def hold(seen: Views, solution: Localization, excess: Array) -> Localization:
        if sigma != 1.0:
            solution = solution._replace(covariance=solution.covariance * sigma**2)
        return hold_weak_geometry(model, seen, solution, sigma * excess)

    views = checked.views
    inliers = views._replace(weight=np.where(checked.outliers, 0.0, views.weight))
    result = hold(inliers, checked.result, checked.excess)
    for i, choice in choices.items():
        held = hold(choice.views, choice.solution, np.ones(len(choice.odds)))
        covered = cover_choices(choice, held)
        result.put([i], covered._replace(residual=result.residual[[i]]))
    return checked._replace(result=result)


def _test(
    model: ForwardModel,
    views: Views,
    localization: Localization,
    sigma: float,
    tolerance: float,
    searched: bool,
    tags: bool,
) -> tuple[SolvedPoses, dict[int, TagChoices]]:
    """Return tested poses, and by view the choices of tags; see `examine`.

    sigma: in units of 1 / weight; tolerance: of the misfit, as a factor.
    """
    freedom = 2 * (views.weight > 0).sum(axis=1) - 6
    allowed = (tolerance * sigma) ** 2
    with_errors = with_own_errors(model, views, localization.pose)
    suspect = ~localization.converged | _suspect(with_errors, localization, freedom, allowed)
    if tags:
        suspect |= ~tags_agree(model, views, localization, allowed)
    result, reasons = localization, _place_reasons(views, localization)
    outliers, excess = np.zeros(views.used.shape, dtype=bool), np.ones(len(freedom))
    choices: dict[int, TagChoices] = {}
    if suspect.any():
        result = Localization.concatenate([localization])  # a copy
    for i in np.flatnonzero(suspect):
        view, other = views.take([i]), None
        if searched and tags and holds_tags(view):
            if (chosen := choose_tags(model, view, allowed)) is not None:
                choices[int(i)], other = chosen, chosen.inliers
        elif searched:
            other = _consensus_pose(
                model, view, with_errors.take([i]), localization.take([i]), sigma, tolerance
            )
        if other is not None:
            result.put([i], other)
            outliers[i] = (view.weight[0] > 0) & np.isnan(other.residual[0, :, 0])
            result.residual[i] = residuals(model, other.pose, view)[0]
            why = (
                _tags_reason(choices[int(i)], result.residual[i])
                if int(i) in choices
                else _outliers_reason(view, outliers[i], result.residual[i], tags)
            )
            reasons[i] = _join_reasons(why, reasons[i])
        elif result.converged[i] and misfit_fails(result.cost[i] / allowed, freedom[i]):
            variance = float(result.cost[i]) / max(freedom[i], 1) / sigma**2
            excess[i] = np.sqrt(variance)
            result.covariance[i] *= variance
            reasons[i] = _join_reasons(
                f'{misfit_reason(variance, int(freedom[i]))}; the covariance is scaled by it',
                reasons[i],
            )
    return SolvedPoses(model, views, result, outliers, tuple(reasons), None, excess), choices


def doubt_of_pairs(
    models: tuple[ForwardModel, ForwardModel],
    rig: Pose,
    uv: tuple[Array, Array],
    landmark: Index,
    sigma: float,
) -> str:
    """Say why stereo depth should not be relied on; '' for a reliable one.

    models, uv (N, 2), px: left, right; rig: left camera in the right one; landmark (N,); sigma:
    noise of u and of v, px.  The least reprojection error of a pair has one degree of freedom.
    """
    best = triangulate_optimally(*models, rig, *uv, sigma)
    behind = int((~best.valid).sum())
    if behind > (1 - _MIN_AGREEMENT) * len(landmark):
        return (
            f'the rays of {behind} of {len(landmark)} landmarks do not meet in front of both '
            'cameras: check left and right, rig and ids'
        )
    cost = np.square(np.stack([best.left_residual, best.right_residual])).sum(axis=(0, -1))
    cost, ids = cost[best.valid] / sigma**2, landmark[best.valid]
    gross = cost > _OUTLIER_SIGMAS**2
    fails = misfit_fails(cost.sum(), np.asarray(len(cost)))
    if not gross.any() and not fails:
        return ''
    inlier_cost = cost[~gross]
    agreeing = len(inlier_cost) >= _MIN_AGREEMENT * len(cost)
    if agreeing and not misfit_fails(inlier_cost.sum(), np.asarray(len(inlier_cost))):
        off = np.sqrt(cost[gross]) * sigma
        return f'pairs that do not match: {_landmark_names(ids[gross], off)}'
    return misfit_reason(float(cost.sum()) / len(cost), len(cost))


def misfit_reason(excess: float, freedom: int) -> str:
    """Say in words that the misfit is too large: excess over its expectation, as a variance."""
    return (
        f'the residuals are {np.sqrt(excess):.3g} times what sigma allows ({freedom} '
        'degrees of freedom), and no single points explain it. Check the lens, the image size, '
        'and the landmarks with their unit'
    )


def noise_sigma(cost: float, rows: int, unknowns: int) -> float:
    """Return the noise of rows of unit weight, more than unknowns, from their sum of squares."""
    return float(np.sqrt(cost / max(rows - unknowns, 1)))


def _consensus_pose(
    model: ForwardModel,
    view: Views,
    own: Views,
    localization: Localization,
    sigma: float,
    tolerance: float,
) -> Localization | None:
    """Return the pose that most points of one view (1,) agree on, residuals NaN for the others.

    own: the view with weights of independent errors.
    """
    used = view.weight > 0
    enough = max(MIN_POINTS + _SPARE_POINTS, _MIN_AGREEMENT * used.sum())
    if (used & model.back_project(view.uv).valid).sum() < enough:
        return None
    limit = _OUTLIER_SIGMAS * tolerance * sigma
    start = consensus_pose(model, own, localization, sigma)
    for _ in range(_ROUNDS):
        inside = _lengths(model, start, own) < limit
        if inside.sum() < enough:
            return None
        kept = view._replace(weight=np.where(inside, view.weight, 0.0))
        solved = localize(model, kept, start)
        if np.array_equal(_lengths(model, solved.pose, own) < limit, inside):
            break
        start = solved.pose
    allowed = (tolerance * sigma) ** 2
    if not solved.converged[0] or misfit_fails(solved.cost[0] / allowed, 2 * inside.sum() - 6):
        return None
    solved.residual[~inside] = np.nan
    return solved


def _suspect(views: Views, localization: Localization, freedom: Array, allowed: float) -> Mask:
    """Return which views fail the test of their misfit, or hold a residual that stands out.

    allowed: variance of a row.
    """
    with np.errstate(divide='ignore', invalid='ignore'):  # where no view has a pose
        largest = np.fmax.reduce(
            np.where(
                views.weight > 0, (localization.residual**2).sum(axis=-1) * views.weight**2, 0.0
            ),
            axis=1,
        )
        mean = localization.cost / np.maximum(freedom, 1)
        stands_out = largest > 2 * _MAX_RESIDUAL_RATIO**2 * mean
        return np.asarray(misfit_fails(localization.cost / allowed, freedom) | stands_out)


def consensus_pose(
    model: ForwardModel, view: Views, localization: Localization, sigma: float
) -> Pose:
    """Return the pose (1,) that the points agree on best, from minimal subsets of them."""
    starts = [
        start.compose(part.place.inverse().broadcast_to(*start.shape))
        for part in model.parts(view)
        if (start := _subset_poses(part.model, part.views)) is not None
    ]
    if not starts:
        return localization.pose
    pose = Pose.concatenate([*starts, localization.pose])
    views = view.take(np.zeros(len(pose.position), dtype=int))
    off = _median(_lengths(model, pose, views), views)
    best = np.argsort(off, kind='stable')[:_KEPT]
    pose, views = pose.take(best), views.take(best)
    for _ in range(_ROUNDS):
        off = np.minimum(_lengths(model, pose, views), _INFINITE)
        scale = np.maximum(sigma, _median(off, views) / _MEDIAN)[:, None]
        fading = 1 / (1 + (off / (_FADE * scale)) ** 2)
        pose = improve_poses(model, views._replace(weight=views.weight * fading), pose)
    worst = (3 * _OUTLIER_SIGMAS * sigma) ** 2
    squares = np.minimum(_lengths(model, pose, views) ** 2, worst)
    score = np.where(views.weight > 0, squares, 0.0).sum(axis=1)
    return pose.take([int(np.argmin(score))])


def _subset_poses(model: ForwardModel, view: Views) -> Pose | None:
    """Return poses (K,) by subsets of the points that one camera sees; None for too few points."""
    rays = model.back_project(view.uv)
    usable = np.flatnonzero((view.weight[0] > 0) & rays.valid[0])
    if len(usable) < MIN_POINTS:
        return None
    # Six points fix a pose without a search among turns, which four of few need.
    enough = len(usable) >= _SUBSET + _SPARE_POINTS
    many, size = (_SUBSETS, _SUBSET) if enough else (_FEW_SUBSETS, MIN_POINTS)
    draws = np.random.default_rng(len(usable)).uniform(size=(many, len(usable)))
    subset = usable[np.argsort(draws, axis=1)[:, :size]]
    return initial_poses(
        view.points[0, subset], rays.direction[0, subset], np.ones(subset.shape), not enough
    )


def _lengths(model: ForwardModel, pose: Pose, views: Views) -> Array:
    """Return whitened residuals (S, N); infinite where there is no image or no weight."""
    off = views.uv - model.predict(pose, views).uv
    length = np.hypot(off[..., 0], off[..., 1]) * views.weight
    return np.where((views.weight > 0) & np.isfinite(length), length, np.inf)


def _median(length: Array, views: Views) -> Array:
    """Return medians (S,) of the points that have a weight; finite."""
    middle = (views.weight > 0).sum(axis=1, keepdims=True) // 2
    median = np.take_along_axis(np.sort(np.minimum(length, _INFINITE), axis=1), middle, axis=1)
    return np.asarray(median[:, 0])


def _noise_from_median(views: Views, localization: Localization) -> Array:
    """Return the noise (S,) that the median residuals speak of; they hide some of it."""
    length = np.where(views.weight > 0, np.linalg.norm(localization.residual, axis=-1), np.inf)
    count = (views.weight > 0).sum(axis=1)
    hidden = np.sqrt(count / np.maximum(count - 3, 1))
    with np.errstate(invalid='ignore'):  # no weight, no residual
        return np.asarray(_median(length * views.weight, views) / _MEDIAN * hidden)


def _tags_reason(choices: TagChoices, residual: Array) -> str:
    """Say which tags are left out; residual (N, 2), px, from the likeliest pose."""
    rejected = choices.rejected
    if len(rejected) > 1:
        names = ' or '.join(' and '.join(map(str, tags)) for tags in rejected[:_MAX_NAMES])
        return (
            f'tags contradict each other: without tag {names}, the others agree. The covariance '
            'covers each choice. Check the tag map'
        )
    size = np.nan_to_num(np.linalg.norm(residual, axis=-1), nan=np.inf)
    largest = [size[choices.views.board[0] == tag].max() for tag in rejected[0]]
    return f'outliers rejected: {_landmark_names(np.array(rejected[0]), np.array(largest), "tag")}'


def _outliers_reason(view: Views, outliers: Mask, residual: Array, tags: bool) -> str:
    size = np.where(outliers, np.nan_to_num(np.linalg.norm(residual, axis=-1), nan=np.inf), 0.0)
    worst = np.argsort(-size, kind='stable')[: outliers.sum()]
    if not len(worst):
        return ''
    number, kind = (view.board, 'tag') if tags else (view.landmark, 'landmark')
    return f'outliers rejected: {_landmark_names(number[0, worst], size[worst], kind)}'


def _landmark_names(landmark: Index, size: Array, kind: str = 'landmark') -> str:
    """Return landmarks, or tags, by name, each with its residual, px; the first of many."""
    names = ', '.join(
        f'{landmark_id} ({px:.3g} px)'
        for landmark_id, px in zip(landmark[:_MAX_NAMES], size[:_MAX_NAMES], strict=True)
    )
    more = f' and {len(landmark) - _MAX_NAMES} more' if len(landmark) > _MAX_NAMES else ''
    return f'{kind}{"s" if len(landmark) > 1 else ""} {names}{more}'


def _place_reasons(views: Views, localization: Localization) -> list[str]:
    away = np.linalg.norm(views.points - localization.pose.position[:, None], axis=-1)
    farthest = np.where(views.weight > 0, away, 0.0).max(axis=1)
    why = f'landmarks lie up to {farthest.max():.0f} m away; check that they are in meters'
    reasons = [why if far > _MAX_RANGE else '' for far in farthest]
    if views.prior is None:
        return reasons
    cost = views.prior.equations(localization.pose)[0]
    why = 'height or tilt of the base is {:.3g} sigma off its plane: check planar_height and mount'
    return [
        _join_reasons(why.format(np.sqrt(row)) if fails else '', reason)
        for row, fails, reason in zip(
            cost, misfit_fails(cost, np.asarray(PRIOR_ROWS)), reasons, strict=True
        )
    ]


def _join_reasons(*reasons: str) -> str:
    return '; '.join(filter(None, reasons))
