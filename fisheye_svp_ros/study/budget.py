"""May the viewpoint shift be neglected?  What SVP costs by range and by spread of the landmarks.

A lens looks at landmarks that are spread evenly over a cap of directions about its axis, all at
one range, alone (localization) and as a stereo rig (epipolar lines and depth).  Beside every SVP
error stands what image noise alone causes, and what a lens that knows its own errors
(`uncertainty`) leaves even where it is used as it is.  For a lens behind a port SVP is the lens
in air.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Mask, scatter
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import LensError, ParameterError
from fisheye_svp_ros.optics.camera import back_project, unique_range
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, axis_angle_between, identity
from fisheye_svp_ros.scene.observations import views_of
from fisheye_svp_ros.scene.table_checks import check_noise
from fisheye_svp_ros.solve.localization import localize
from fisheye_svp_ros.solve.stereo_depth import epipolar_offset, triangulate, triangulate_optimally
from fisheye_svp_ros.study.solutions import known_mean

QUANTITIES = ('position', 'axis', 'residual', 'epipolar', 'depth')
UNITS = {'position': 'm', 'axis': 'rad', 'residual': 'px', 'epipolar': 'px', 'depth': 'm'}
_LENS_PARTS = ('parameters', 'misfit')
_LANDMARKS = 48
_CAPS_PER_BLOCK = 24  # caps
_STEREO_CAPS = 4  # of them one for what the lens's own errors do to stereo points
_MIN_SPREAD = np.radians(15.0)
_EDGE = np.radians(1.0)  # how far inside the field of view the widest spread ends
_NEAREST, _FARTHEST = 0.05, 20.0  # m
_BASELINES = (1e-3, _FARTHEST)  # m
_RANGE_FACTOR = 1.5  # unique ranges of the lens that the nearest range keeps


class Setup(NamedTuple):
    """What a user has: lens; rig (left camera in the right one); noise of u and of v, px."""

    lens: Lens
    rig: Pose
    noise: float


class Budget(NamedTuple):
    """SVP errors and what noise causes, by quantity: arrays (A spreads, R ranges), SI and px.

    spreads (A,): largest incidence angle of the landmarks, rad; ranges (R,), m.  position: of the
    camera; axis: of its viewing axis; residual: mean, px; epipolar: mean distance to the epipolar
    curve; depth: mean 3-D distance of stereo points.  NaN where nothing can be solved.
    own: by part (parameters, misfit) and quantity what is wrong with the lens as it stands, of
    position, axis and depth; empty for a lens that does not say.
    """

    spreads: Array
    ranges: Array
    error: dict[str, Array]
    noise: dict[str, Array]
    own: dict[str, dict[str, Array]]


class Point(NamedTuple):
    """One quantity where the user works: error and noise there; limit; whether SVP keeps it.

    kept: None where nothing can be solved, as of stereo points that one camera alone sees.
    nearest_range: from which on SVP keeps the limit at this spread, m; largest_spread: the largest
    at which it keeps it at this range, rad; NaN where it does so nowhere.  parameters, misfit:
    what is wrong with the lens as it stands, see `Budget.own`; NaN where unknown.
    """

    quantity: str
    error: float
    noise: float
    limit: float
    kept: bool | None
    nearest_range: float
    largest_spread: float
    parameters: float
    misfit: float


def widest_spread(lens: Lens) -> float:
    """Return the largest spread of landmarks that a budget covers, rad.

    Through a port it is that of the narrowest side, in the medium.
    """
    if lens.port is None:
        return float(lens.max_incidence - _EDGE)
    turn = np.linspace(0, 2 * np.pi, 17)[:-1, None]
    height, _ = lens.image_height.value_and_slope(np.linspace(0, lens.max_incidence, 181))
    uv = np.stack(
        [lens.cx + lens.fx * height * np.cos(turn), lens.cy + lens.fy * height * np.sin(turn)],
        axis=-1,
    )
    seen = np.arccos(back_project(lens, uv).direction[..., 2])
    return float(np.nanmax(seen, axis=1).min() - _EDGE)


def default_spread(lens: Lens) -> float:
    """Return the spread to be asked about where none is named, rad.

    It is the widest, or the smaller angle up to which the lens was calibrated.
    """
    widest = widest_spread(lens)
    if lens.calibrated_angle is None:
        return widest
    return float(np.clip(lens.calibrated_angle, _MIN_SPREAD, widest))


def nearest_range(lens: Lens) -> float:
    """Return the nearest range that a budget covers, m."""
    return max(_NEAREST, _RANGE_FACTOR * unique_range(lens))


def make_budget(setup: Setup, spreads: int = 10, ranges: int = 22) -> Budget:
    """Tabulate errors and noise over spreads and ranges.

    Raises LensError for a lens without a viewpoint shift, ParameterError for impossible noise and
    for a baseline with which nothing could be measured.
    """
    lens = setup.lens
    if lens.is_svp:
        raise LensError(
            f'lens {lens.name!r} has no viewpoint_shift, so its SVP error is unknown. '
            '`fisheye-svp diagnose` measures the shift: give its extended_lens.yaml'
        )
    check_noise(setup.noise)
    baseline = float(np.linalg.norm(setup.rig.position))
    if not _BASELINES[0] <= baseline <= _BASELINES[1]:
        raise ParameterError(
            f'baseline is {baseline:.4g} m; a budget covers {_BASELINES[0]:g} to '
            f'{_BASELINES[1]:g} m'
        )
    angle = np.linspace(_MIN_SPREAD, widest_spread(lens), spreads)
    distance = np.geomspace(nearest_range(lens), _FARTHEST, ranges)
    points = distance[:, None, None] * _caps(angle)[:, None]
    shape = (spreads, ranges)
    flat = points.reshape(-1, _LANDMARKS, 3)
    rows = [*_localization_errors(setup, flat), *_stereo_errors(setup, flat)]
    error, noise = (
        {name: row[i].reshape(shape) for name, row in zip(QUANTITIES, rows, strict=True)}
        for i in range(2)
    )
    own = {
        part: {name: values.reshape(shape) for name, values in by.items()}
        for part, by in _lens_errors(setup, flat).items()
    }
    return Budget(angle, distance, error, noise, own)


def at_point(
    budget: Budget, spread: float, working_range: float, limits: dict[str, float | None]
) -> list[Point]:
    """Answer for landmarks within `spread`, rad, from `working_range`, m, on.

    limits: by quantity, in SI and px; None: what noise alone causes there.
    Raises ParameterError for a spread or range outside the budget and for an impossible limit.
    """
    _check(np.degrees(spread), np.degrees(budget.spreads), 'spread', 'degrees')
    _check(working_range, budget.ranges, 'range', 'm')
    rows = []
    for quantity in QUANTITIES:
        limit = limits.get(quantity)
        if limit is not None and not (np.isfinite(limit) and limit > 0):
            raise ParameterError(
                f'limit of {quantity} is {limit:.4g} {UNITS[quantity]}; it must be above 0'
            )
        error, noise = budget.error[quantity], budget.noise[quantity]
        allowed = noise if limit is None else np.full_like(noise, limit)
        # The excess in log is linear where both follow powers of the range.
        with np.errstate(divide='ignore'):
            excess = np.log(error / allowed)
        by_range = _interpolate_rows(budget.spreads, excess, spread)
        by_spread = _interpolate_rows(np.log(budget.ranges), excess.T, np.log(working_range))
        at_working_range = np.interp(np.log(working_range), np.log(budget.ranges), by_range)
        lens_parts = [
            budget.own.get(part, {}).get(quantity, np.full_like(noise, np.nan))
            for part in _LENS_PARTS
        ]
        caused, noisy, most, parameters, misfit = (
            _table_value(budget, table, spread, working_range)
            for table in (error, noise, allowed, *lens_parts)
        )
        logs = np.log(budget.ranges)
        rows.append(
            Point(
                quantity,
                caused,
                noisy,
                most,
                None if np.isnan(at_working_range) else bool(at_working_range <= 0),
                # From which range on the limit is kept, and up to which spread
                float(np.exp(_last_crossing(logs, by_range, ~(by_range <= 0), logs[0], np.nan))),
                _last_crossing(
                    budget.spreads, by_spread, by_spread <= 0, np.nan, budget.spreads[-1]
                ),
                parameters,
                misfit,
            )
        )
    return rows


def _localization_errors(setup: Setup, points: Array) -> list[tuple[Array, Array]]:
    """Return error and noise (S,) of position, axis and residual for caps (S, N, 3)."""
    true = identity(len(points))
    seen = ForwardModel(setup.lens).predict(true, views_of(points)).uv
    solved = localize(ForwardModel(setup.lens.svp()), views_of(points, seen), true)
    variance = setup.noise**2 * np.diagonal(solved.covariance, axis1=-2, axis2=-1)
    # A Gaussian in the plane has this mean norm for a deviation of 1 in each direction.
    mean_norm = np.sqrt(np.pi / 2) * setup.noise
    return [
        (np.linalg.norm(solved.pose.position, axis=-1), np.sqrt(variance[:, :3].sum(axis=-1))),
        (axis_angle_between(solved.pose, true), np.sqrt(variance[:, 3:5].sum(axis=-1))),
        (known_mean(np.linalg.norm(solved.residual, axis=-1)), np.full(len(points), mean_norm)),
    ]


def _stereo_errors(setup: Setup, points: Array) -> list[tuple[Array, Array]]:
    """Return error and noise (S,) of epipolar distance and depth for caps (S, N, 3)."""
    true, svp = ForwardModel(setup.lens), ForwardModel(setup.lens.svp())
    right = true.predict(identity(len(points)), views_of(points)).uv
    left = true.predict(setup.rig.broadcast_to(len(points)), views_of(points)).uv
    seen: Mask = np.asarray(np.isfinite(left + right).all(axis=-1))
    pairs = (svp, svp, setup.rig, left[seen], right[seen])
    offset = epipolar_offset(*pairs)
    solved = triangulate(*pairs).points
    true_pairs = (true, true, setup.rig, left[seen], right[seen])
    spread = triangulate_optimally(*true_pairs, setup.noise).covariance
    per_pair = [
        offset.distance,
        np.linalg.norm(solved - points[seen], axis=-1),
        np.sqrt(np.trace(spread, axis1=-2, axis2=-1)),
    ]
    epipolar, depth, depth_noise = (known_mean(scatter(seen, values)) for values in per_pair)
    # Noise of the left point across the curve and of the right point that moves the curve.
    epipolar_noise = np.full(len(points), 2 / np.sqrt(np.pi) * setup.noise)
    return [(epipolar, epipolar_noise), (depth, depth_noise)]


def _lens_errors(setup: Setup, points: Array) -> dict[str, dict[str, Array]]:
    """Return what the lens's own errors do to caps (S, N, 3): (S,) by part and quantity."""
    if setup.lens.uncertainty is None:
        return {}
    from fisheye_svp_ros.diagnosis import LensErrors
    from fisheye_svp_ros.study.trust import depth_errors

    errors, lens = LensErrors.from_lens(setup.lens), ForwardModel(setup.lens)
    some = points[:, ::_STEREO_CAPS]
    left = lens.predict(setup.rig.broadcast_to(len(some)), views_of(some)).uv
    seen: Mask = np.asarray(np.isfinite(left).all(axis=-1))
    depth = depth_errors(errors, errors, setup.rig, some[seen])
    poses = [
        errors.of_poses(views_of(caps), identity(len(caps)))
        for caps in np.array_split(points, -(-len(points) // _CAPS_PER_BLOCK))
    ]
    limits = {}
    for part in _LENS_PARTS:
        variance = np.concatenate(
            [np.diagonal(getattr(pose, part), axis1=-2, axis2=-1) for pose in poses]
        )
        far = np.sqrt(np.trace(getattr(depth, part), axis1=-2, axis2=-1))
        limits[part] = {
            'position': np.sqrt(variance[:, :3].sum(axis=-1)),
            'axis': np.sqrt(variance[:, 3:5].sum(axis=-1)),
            'depth': known_mean(scatter(seen, far)),
        }
    return limits


def _caps(angles: Array) -> Array:
    """Return unit directions (A, N, 3), even over caps of half angle (A,) about z (Fibonacci)."""
    index = np.arange(_LANDMARKS)
    azimuth = index * np.pi * (3 - np.sqrt(5))
    cosine = 1 - (index + 0.5) / _LANDMARKS * (1 - np.cos(angles[:, None]))
    # The last ring is put on the rim, so that the spread is what it says.
    cosine = 1 - (1 - cosine) * (1 - np.cos(angles[:, None])) / (1 - cosine[:, -1:])
    sine = np.sqrt(1 - cosine**2)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], axis=-1)


def _interpolate_rows(places: Array, table: Array, place: float) -> Array:
    """Interpolate the rows of a table (P, K) at a place among `places` (P,)."""
    return np.array([np.interp(place, places, column) for column in table.T])


def _table_value(budget: Budget, table: Array, spread: float, working_range: float) -> float:
    with np.errstate(divide='ignore'):
        by_range = _interpolate_rows(budget.spreads, np.log(table), spread)
    logs = np.log(budget.ranges)
    return float(np.exp(np.interp(np.log(working_range), logs, by_range)))


def _last_crossing(places: Array, excess: Array, side: Mask, none: float, all_: float) -> float:
    """Return where an excess is 0 after the last place on a side of it.

    On the kept side where that is unknown; none, all_: what it is with no place, or the last one,
    on that side.
    """
    rows = np.flatnonzero(side)
    i = int(rows[-1]) if rows.size else -1
    if i in (-1, len(places) - 1):
        return float(none if i < 0 else all_)
    before, two = excess[i : i + 2]
    if not np.isfinite(before - two):
        return float(places[i + 1] if two <= 0 else places[i])
    return float(places[i] + before / (before - two) * (places[i + 1] - places[i]))


def _check(value: float, places: Array, name: str, unit: str) -> None:
    if not places[0] - 1e-9 <= value <= places[-1] + 1e-9:
        raise ParameterError(
            f'{name} is {value:.4g} {unit}; this lens and budget allow {places[0]:.4g} to '
            f'{places[-1]:.4g} {unit}'
        )
