"""Lens calibration: a lens and the poses of its views together, from targets, without starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import GeometryError, LensError, ObservationError
from fisheye_svp_ros.optics.camera import back_project, incidence, project
from fisheye_svp_ros.optics.curves import IMAGE_HEIGHTS, VIEWPOINT_SHIFTS
from fisheye_svp_ros.optics.lens import (
    INTRINSICS,
    PORT,
    Lens,
    check_lens,
    field_of_view,
    monotone_limit,
    parameter_values,
)
from fisheye_svp_ros.optics.ports import Port
from fisheye_svp_ros.pose import Pose, identity
from fisheye_svp_ros.scene.observations import Observations, Views, frame_name, views_of
from fisheye_svp_ros.solve.bundle_adjustment import AdjustedLens, adjust_lens, adjust_lens_from
from fisheye_svp_ros.solve.hand_eye import HandEye, fit_hand_eye, flange_poses
from fisheye_svp_ros.solve.initial_pose import initial_poses
from fisheye_svp_ros.solve.localization import Localization, localize
from fisheye_svp_ros.solve.measured_poses import posable_views, rms_px, sigma_known
from fisheye_svp_ros.solve.reliability import noise_sigma
from fisheye_svp_ros.solve.rig_state import Linearization, RigState, RigViews

MAX_OUTSIDE = 0.1  # of its size; how far outside the image a point may be, as tags cut off are
MAX_WILD_SHARE = 0.05  # of the rows: more of them outside, and the image has another size
FOCAL_UNCERTAINTY = 0.1  # a focal length that is known no better than this is not known
_CANDIDATES = 4
_START_ITERATIONS = 40
_ROUNDS = 4
# Incidence angles between which the farthest image corner is looked for, rad, and in how many
# steps; neighboring focal lengths differ by less than a fifth.
_CORNER_ANGLES = np.geomspace(np.radians(4.0), np.radians(160.0), 24)
_VIEWS, _POINTS = 20, 60  # enough for a start
_ROUGH_STEP = 3  # of those focal lengths
_GOLDEN = (np.sqrt(5) - 1) / 2
_LOST, _FEW_LOST = 6.0, 0.2  # times the median view; of the views


class Calibration(NamedTuple):
    """A calibrated lens.

    adjusted: the lens with its `calibration` block and its views, covariances for the noise of
    the data; sigma: noise of u and of v, px, estimated, None where the observations bring their
    own; views: the views used; left_out: frames that cannot be posed; beyond: how many
    observations lie past `max_incidence`, where the fitted curve turns back; reached: the largest
    incidence angle of an observation, rad, past which the curve is extrapolated.
    """

    adjusted: AdjustedLens
    sigma: float | None
    views: Views
    left_out: tuple[int, ...]
    beyond: int
    reached: float


def calibrate(
    observations: Observations,
    model: str,
    image_size: tuple[int, int],
    free: Sequence[str] | None = None,
    name: str = 'lens',
    port: Port | None = None,
) -> Calibration:
    """Fit a lens to image points of planar or 3-D targets; neither poses nor a start are needed.

    model: a name in IMAGE_HEIGHTS; image_size: width, height, px; free: parameters to fit, among
    them f, or fx and fy (fx, fy, cx, cy and the model's coefficients by default); a coefficient of
    a viewpoint shift gives the lens that shift.  What is not freed stays neutral: the center in
    the middle of the image, coefficients at 0.  port: what the camera looked through; where it is
    is fitted too, whatever it says.
    Raises LensError for an impossible model, image size or name; ObservationError for rows of
    several cameras or far outside the image; GeometryError where the views do not determine the
    lens.  Where only a few views with points in another order stand in the way, it is fitted
    without them.
    """
    start = replace(start_lens(model, image_size, free or (), name), port=port)
    names = (*INTRINSICS, *start.image_height.coefficient_names) if free is None else tuple(free)
    names += tuple(n for n in placed_names(start) if n not in names)
    _check_free_names(start, names)
    _check_image_size(observations, image_size)
    views, left_out = posable_views(observations)
    _check_row_count(observations.source, views, names)
    try:
        return _as_calibration(observations, fit_lens(start, views, names), views, left_out)
    except GeometryError:
        lost = lost_views(start.svp(), select_points(views, len(views.frame)))
        if not lost.any():
            raise
    views = views.take(np.flatnonzero(~lost))
    _check_row_count(observations.source, views, names)
    return _as_calibration(observations, fit_lens(start, views, names), views, left_out)


def refit_without_outliers(
    calibration: Calibration, observations: Observations
) -> Calibration | None:
    """Fit a calibrated lens anew to nearly all rows that it was fitted to, from where that ended.

    None where it is not fitted from there: behind a port, or where its views are other ones.
    Raises GeometryError where the rows do not determine it.
    """
    lens, names = calibration.adjusted.lens, calibration.adjusted.names
    views, left_out = posable_views(observations)
    if lens.port is not None or not np.array_equal(views.frame, calibration.views.frame):
        return None
    _check_row_count(observations.source, views, names)
    adjusted = _adjust_until_stable(lens, views, names)
    return _as_calibration(observations, adjusted, views, left_out)


def calibrate_port(
    observations: Observations, lens: Lens, port: Port, free: Sequence[str] | None = None
) -> Calibration:
    """Fit where a port is, to image points that a camera calibrated in air took through it.

    free: parameters to fit in place of those, `port_medium_index` and intrinsics among them if
    asked for.  Raises as `calibrate` does.
    """
    _check_image_size(observations, (lens.width, lens.height))
    lens = replace(lens, port=port)
    names = placed_names(lens) if free is None else tuple(free)
    _check_known(lens, names)
    views, left_out = posable_views(observations)
    _check_row_count(observations.source, views, names)
    adjusted = _fit_port(lens, select_points(views), views, names)
    return _as_calibration(observations, adjusted, views, left_out)


def calibrate_hand_eye(
    calibration: Calibration,
    observations: Observations,
    poses: dict[int, Pose],
    covariance: Array | None = None,
) -> tuple[Calibration, HandEye]:
    """Fit a calibrated lens anew, together with the robot that carried the camera, or the target.

    calibration: of the observations without poses; poses: of the flange, by frame; a
    frame may have none; covariance (K, K): of the parameters of the calibration, where these are
    not those of least squares.
    Raises ObservationError where these do not determine the hand-eye transform, or fit none.
    """
    adjusted, views = calibration.adjusted, calibration.views
    data = replace(RigViews.of_one_camera(views), table=observations)
    state = RigState(adjusted.pose, identity(1), adjusted.lens, (), corrected=True)
    names = adjusted.names
    try:
        state, hand_eye = fit_hand_eye(data, state, names, *flange_poses(data, poses), covariance)
    except GeometryError as cause:
        raise ObservationError(
            f'{observations.source}: the given poses are not those of a flange '
            f'that carries the camera or the target: {cause}'
        ) from cause
    linear = Linearization(data, state, names)
    # The covariances stay those of the images alone, which are no smaller.
    adjusted = adjusted._replace(lens=state.lens, pose=state.pose, residual=linear.residual_px)
    return _with_figures(calibration, adjusted, hand_eye=hand_eye.to_dict()), hand_eye


def with_values(found: Calibration, values: Sequence[float], **figures: Any) -> Calibration:
    """Return a calibration with other values of its parameters, its views posed anew.

    figures: more of the `calibration` block.  Raises LensError where these are no lens.
    """
    adjusted = found.adjusted
    block = adjusted.lens.calibration or {}
    lens = _with_corner(adjusted.lens.with_parameters(adjusted.names, list(values)))
    lens = replace(lens, calibration=block)
    solved = localize(ForwardModel(lens), found.views, adjusted.pose)
    adjusted = adjusted._replace(
        lens=lens,
        pose=solved.pose,
        residual=solved.residual,
        cost=solved.cost,
        converged=adjusted.converged and bool(np.all(solved.converged)),
    )
    moved = _with_figures(found, adjusted, **figures)
    return moved._replace(
        adjusted=moved.adjusted._replace(lens=check_lens(moved.adjusted.lens, lens.name)),
        beyond=int(
            (_incidence_angles(adjusted, found.views) > moved.adjusted.lens.max_incidence).sum()
        ),
    )


def _with_figures(found: Calibration, adjusted: AdjustedLens, **more: Any) -> Calibration:
    """Return a calibration with another fit of its views, and the figures of that."""
    theta = _incidence_angles(adjusted, found.views)
    block = {
        **(adjusted.lens.calibration or {}),
        'rms_px': rms_px(adjusted.residual),
        **more,
        'reached_deg': float(np.degrees(theta.max())),
    }
    lens = replace(_with_field(adjusted, theta), calibration=block)
    return found._replace(adjusted=adjusted._replace(lens=lens), reached=float(theta.max()))


def rough_lenses(model: str, image_size: tuple[int, int]) -> list[Lens]:
    """Return lenses without distortion, of fields of view that differ by half, likely ones first.

    To begin with where wrong landmarks or image points lead every fit astray.
    """
    start = start_lens(model, image_size, (), 'start')
    focals = _focal_lengths(start)[::_ROUGH_STEP]
    order = np.argsort(np.abs(np.arange(len(focals)) - len(focals) / 3), kind='stable')
    lenses = [replace(start, fx=focal, fy=focal) for focal in focals[order].tolist()]
    return [_with_corner(lens) for lens in lenses]


def placed_names(lens: Lens) -> tuple[str, ...]:
    """Return the parameters of a lens that say where its port is."""
    return () if lens.port is None else tuple(f'{PORT}_{name}' for name in lens.port.placed)


def _check_row_count(source: str, views: Views, names: Sequence[str]) -> None:
    rows, unknowns = _counts(views, names)
    if rows <= unknowns:
        raise GeometryError(
            f'{source}: {rows // 2} image points in {len(views.frame)} frames do not '
            f'determine {len(names)} lens parameters and the poses; add frames or points'
        )


def _counts(views: Views, names: Sequence[str]) -> tuple[int, int]:
    return 2 * int(views.used.sum()), 6 * len(views.frame) + len(names)


def _as_calibration(
    observations: Observations, adjusted: AdjustedLens, views: Views, left_out: tuple[int, ...]
) -> Calibration:
    """Return the calibration with its covariances, field and figures."""
    rows, unknowns = _counts(views, adjusted.names)
    sigma = None
    if not sigma_known(observations):
        sigma = noise_sigma(adjusted.cost.sum(), rows, unknowns)
        adjusted = adjusted._replace(
            covariance=adjusted.covariance * sigma**2,
            pose_covariance=adjusted.pose_covariance * sigma**2,
        )
    _check_focal(adjusted, observations.source)
    theta = _incidence_angles(adjusted, views)
    lens = _with_field(adjusted, theta)
    block = {
        'rms_px': rms_px(adjusted.residual),
        'observations': rows // 2,
        'frames': len(views.frame),
        'source': observations.source,
        'reached_deg': float(np.degrees(theta.max())),
    }
    lens = check_lens(replace(lens, calibration=block, uncertainty=None), observations.source)
    beyond = int((theta > lens.max_incidence).sum())
    adjusted = adjusted._replace(lens=lens)
    return Calibration(adjusted, sigma, views, left_out, beyond, float(theta.max()))


def _incidence_angles(adjusted: AdjustedLens, views: Views) -> Array:
    """Return the incidence angles (P,) of all observations, rad."""
    local = adjusted.pose.into_body(views.points)
    return incidence(adjusted.lens, local, limited=False).theta[views.used]


def start_lens(model: str, image_size: tuple[int, int], free: Sequence[str], name: str) -> Lens:
    """Return the lens that a fit begins with: neutral, its center in the middle of the image."""
    if model not in IMAGE_HEIGHTS:
        raise LensError(f'model {model!r} is unknown; choose from {", ".join(IMAGE_HEIGHTS)}')
    width, height = image_size
    if min(width, height) < 1:
        raise LensError(f'image size is {width}x{height}; both must be above 0')
    shifts = (
        kind.neutral()
        for kind in VIEWPOINT_SHIFTS.values()
        if set(kind.coefficient_names) & set(free)
    )
    lens = Lens(
        name=name,
        width=width,
        height=height,
        fx=float(width),
        fy=float(width),
        cx=(width - 1) / 2,
        cy=(height - 1) / 2,
        image_height=IMAGE_HEIGHTS[model](),
        max_incidence=1.0,
        viewpoint_shift=next(shifts, None),
    )
    return _with_corner(lens)


def _check_free_names(lens: Lens, names: tuple[str, ...]) -> None:
    _check_known(lens, names)
    if ('f' in names) == ('fx' in names) or ('fx' in names) != ('fy' in names):
        raise LensError('free must name f, or fx and fy: a calibration starts without them')


def _check_known(lens: Lens, names: tuple[str, ...]) -> None:
    lens.with_parameters(names, [1.0] * len(names))
    if len(set(names)) < len(names):
        raise LensError(f'free names a parameter twice: {", ".join(names)}')


def _check_image_size(table: Observations, image_size: tuple[int, int]) -> None:
    """Raise ObservationError for rows far outside the image, or an image that is not theirs."""
    outside = (np.maximum(-table.uv, table.uv - image_size) / image_size).max(axis=1)
    rows = np.flatnonzero(outside > MAX_OUTSIDE)
    if not len(rows):
        return
    image = f'an image of {image_size[0]}x{image_size[1]}'
    if len(rows) > MAX_WILD_SHARE * len(table):
        exchanged = bool((table.uv <= image_size[::-1]).all())
        raise ObservationError(
            f'{table.source}: {len(rows)} of {len(table)} image points lie far outside {image}; '
            f'check the image size{", and that u and v are not exchanged" * exchanged}'
        )
    first = int(rows[0])
    u, v = table.uv[first]
    camera = table.cameras[table.camera[first]] or None
    more = f', and {len(rows) - 1} more points do' if len(rows) > 1 else ''
    raise ObservationError(
        f'{table.source}: {frame_name(table, int(table.frame[first]), camera)}, landmark '
        f'{table.landmark[first]}: u, v = {u:g}, {v:g} px lies far outside {image}{more}; correct '
        'or remove the row, or check the image size'
    )


def fit_lens(start: Lens, views: Views, names: tuple[str, ...]) -> AdjustedLens:
    """Scan the focal length, adjust the best candidates to few points, then to everything."""
    shift = start.viewpoint_shift
    port_names = tuple(name for name in names if name in start.port_names)
    names_beyond = (*port_names, *(() if shift is None else shift.coefficient_names))
    svp_names = tuple(name for name in names if name not in names_beyond)
    few = select_points(views)
    focals, pose = focal_candidates(start.svp(), few, _CANDIDATES)
    values = np.tile(parameter_values(start, svp_names), (len(focals), 1))
    values[:, [name in ('f', 'fx', 'fy') for name in svp_names]] = focals[:, None]
    best = adjust_lens_from(start.svp(), few, pose, values, svp_names, _START_ITERATIONS)
    adjusted = _adjust_until_stable(best, views, svp_names)
    if start.port is not None:
        air, larger = adjusted.lens, start.port.magnification
        if larger > 1:
            # What a port does to the focal length is known, the rest of the curve is begun anew.
            air = replace(
                air, fx=air.fx / larger, fy=air.fy / larger, image_height=start.image_height
            )
        adjusted = _fit_port(replace(air, port=start.port), few, views, (*svp_names, *port_names))
    if shift is None:
        return adjusted
    lens = _with_corner(replace(adjusted.lens, viewpoint_shift=shift))
    return adjust_lens(lens, views, adjusted.pose, names)


def _fit_port(lens: Lens, few: Views, views: Views, names: tuple[str, ...]) -> AdjustedLens:
    """Adjust a lens from several places of its port."""
    assert lens.port is not None
    lenses = [replace(lens, port=port) for port in lens.port.starts()]
    pose = Pose.stack([localize_views(one, few).pose for one in lenses])
    values = np.array([parameter_values(one, names) for one in lenses])
    best = adjust_lens_from(lens, few, pose, values, names, _START_ITERATIONS)
    return _adjust_until_stable(best, views, names)


def _adjust_until_stable(lens: Lens, views: Views, names: tuple[str, ...]) -> AdjustedLens:
    """Pose every view and adjust, until no view fits better when it is posed afresh."""
    pose = localize_views(lens, views).pose
    for _ in range(_ROUNDS):
        adjusted = adjust_lens(lens, views, pose, names)
        lens, pose = adjusted.lens, adjusted.pose
        if not adjusted.converged:
            break
        fresh = localize_views(lens, views)
        better = fresh.cost < adjusted.cost * (1 - 1e-6)
        if not better.any():
            break
        pose = fresh.pose.where(better, pose)
    return adjusted


def localize_views(lens: Lens, views: Views) -> Localization:
    """Pose every view from what lies inside the field of view, however little that is."""
    lens = _with_corner(lens)
    rays = back_project(lens, views.uv)
    start = initial_poses(views.points, rays.direction, np.where(rays.valid, views.weight, 0.0))
    return localize(ForwardModel(lens), views, start)


def _with_corner(lens: Lens) -> Lens:
    return replace(lens, max_incidence=field_of_view(lens))


def _with_field(adjusted: AdjustedLens, theta: Array) -> Lens:
    """Return the lens with its `max_incidence`; theta: of the observations, rad."""
    held = set(adjusted.names) <= set(adjusted.lens.port_names)
    lens = adjusted.lens if held else _with_corner(adjusted.lens)
    seen = min(float(theta.max()), monotone_limit(lens))
    return replace(lens, max_incidence=max(lens.max_incidence, seen))


def _check_focal(adjusted: AdjustedLens, source: str) -> None:
    for i, name in enumerate(adjusted.names):
        if name in ('f', 'fx', 'fy'):
            relative = float(np.sqrt(adjusted.covariance[i, i])) / adjusted.lens.fx
            if not relative < FOCAL_UNCERTAINTY:
                raise GeometryError(
                    f'{source}: {name} is known only to {100 * relative:.0f} %, rms '
                    f'{rms_px(adjusted.residual):.3g} px. Add views in which the target is '
                    'tilted and covers the image. Check that image points and landmarks belong '
                    'together: order, units, axes (u to the right, v down, x, y, z '
                    'right-handed)'
                )


def focal_candidates(lens: Lens, views: Views, keep: int) -> tuple[Array, Pose]:
    """Return the best focal lengths (C,), px, of a scan and the poses (C, V) under each.

    The image height is that of `lens` with the coefficients it has (kannala_brandt without any is
    equidistant), the center is the lens's.  Candidates are ranked by what their poses leave over.
    """
    focals, pose, rms = _scan_focal_lengths(lens, views)
    # A sum of root mean squares forgives one lost view.
    best = np.argsort(rms.sum(axis=1))[:keep]
    return focals[best], pose.take(best)


def lost_views(lens: Lens, views: Views) -> Mask:
    """Return which views (V,) are far worse than most at the focal length that suits most.

    No pose goes with their points, as those are in another order, say.  None where a fifth or
    more of the views are: then it is another lens that is wanted.
    """
    rms = _scan_focal_lengths(lens, views)[2]
    middle = np.median(rms, axis=1)
    best = int(np.argmin(middle))
    lost: Mask = rms[best] > _LOST * middle[best]
    return lost if lost.mean() < _FEW_LOST else np.zeros_like(lost)


def _focal_lengths(lens: Lens) -> Array:
    """Return the focal lengths (C,), px, ascending, that a scan tries."""
    corner = np.hypot(lens.width, lens.height) / 2
    heights, _ = lens.image_height.value_and_slope(
        np.minimum(_CORNER_ANGLES, monotone_limit(lens))
    )
    return np.unique(corner / heights)


def _scan_focal_lengths(lens: Lens, views: Views) -> tuple[Array, Pose, Array]:
    """Return focal lengths (C,), px, the poses (C, V) under each, and rms of each view, px."""
    focals = _focal_lengths(lens)
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
    center = (views.uv * used).sum(axis=1, keepdims=True) / count[:, None, None]
    spread = ((views.uv - center) ** 2 * used).sum(axis=(1, 2)) / count
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
