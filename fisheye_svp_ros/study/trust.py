"""How far a lens, poses and stereo points may be trusted: by their errors, or by the truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import special

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis import (
    Comparison,
    ErrorParts,
    LensErrors,
    NullModel,
    compare_errors,
    errors_of_named_models,
    noise_px,
    standard_errors,
)
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import FisheyeSvpError
from fisheye_svp_ros.io.tag_maps import TagMap
from fisheye_svp_ros.mixed_model import FactoredEquations, factor_equations, pseudo_inverse
from fisheye_svp_ros.optics.lens import Lens, parameter_values
from fisheye_svp_ros.pose import Pose, axis_angle_between, identity
from fisheye_svp_ros.scene.observations import Observations, views_of
from fisheye_svp_ros.solve.bundle_adjustment import adjust, adjust_poses
from fisheye_svp_ros.solve.initial_rig import initial_state, localize_cameras
from fisheye_svp_ros.solve.lens_calibration import Calibration, with_values
from fisheye_svp_ros.solve.measured_poses import rms_px
from fisheye_svp_ros.solve.rig_state import Linearization, RigState, RigViews, group_by_frame
from fisheye_svp_ros.solve.solved_poses import SolvedPoses
from fisheye_svp_ros.solve.stereo_depth import triangulate
from fisheye_svp_ros.solve.table_poses import solve_table

_SHIFT_NAMES = ('s0', 'e0', 'e1', 'e2', 'thickness')
_INTERVAL_SIGMAS = 2.0  # standard errors of an interval
_MAX_POINTS = 500  # stereo points
_FOLDS = 3
_TARGET_SHARES = (0.0, 0.03, 0.1, 0.3, 1.0)  # of what is large for an error of the target
_MAX_RMS_RATIO = 2.0  # residuals over those of least squares: beyond, nothing is linear


@dataclass(frozen=True)
class Admissible:
    """A parameter of a lens over all targets that the data admit.

    low, high: of 95 % intervals with the target as it is said to be and with its shape, scale and
    boards free; settled: whether the two agree, for a viewpoint shift also that it is not zero.
    """

    low: float
    high: float
    settled: bool


@dataclass(frozen=True)
class LensTrust:
    """Standard errors of parameters, the target as it is said to be, and their ranges, by name.

    moved (K,): from the values of least squares to those of generalized least squares, the target
    as far from what it is said to be as the data make likely; covariance (K, K): of these;
    noise_px: of one coordinate of a point, by the data.
    """

    stderr: dict[str, float]
    admissible: dict[str, Admissible]
    moved: Array
    covariance: Array
    noise_px: float

    @property
    def doubtful_shift(self) -> dict[str, Admissible]:
        """The coefficients of a viewpoint shift that a target of another shape can explain."""
        return {
            name: range_
            for name, range_ in self.admissible.items()
            if name in _SHIFT_NAMES and not range_.settled
        }


class SharedTrust(NamedTuple):
    """What the null model says of cameras that were fitted together.

    lenses (C,): of each; moved (K,), covariance (K, K): of all that is shared, as of `LensTrust`:
    cameras but the first, boards but the first (6 each, the change in `Pose.retract`), lenses.
    """

    lenses: tuple[LensTrust, ...]
    moved: Array
    covariance: Array

    def rig_covariance(self) -> Array:
        """Return the covariances (C - 1, 6, 6) of the cameras but the first, m and rad."""
        ends = [slice(6 * i, 6 * i + 6) for i in range(len(self.lenses) - 1)]
        return np.array([self.covariance[block, block] for block in ends]).reshape(-1, 6, 6)


def assess_lens(observations: Observations, lens: Lens, names: Sequence[str]) -> LensTrust:
    """Return what the null model says of a lens fitted to one camera's views, names being free."""
    data = group_by_frame(observations)
    state = adjust(data, initial_state(data, lens), names)
    return assess_cameras(data, state, names).lenses[0]


def assess_cameras(data: RigViews, state: RigState, names: Sequence[str]) -> SharedTrust:
    """Return what the null model says of a rig of cameras, or of one, and of their lenses.

    The random parts of target and frames are the same for all cameras.  state: fitted to the data
    by least squares; names: of what was free of the lenses, as the state calls it.
    """
    null = NullModel.estimate(data, state, names)
    start = 6 * (len(state.rig.position) - 1)
    count = start + len(names)
    # What else a lens has, its corrections, is fitted along and follows them.
    between_frames = standard_errors(null)
    errors = np.hypot(between_frames, errors_of_named_models(null))[:count]
    targets = _fit_targets(null, count)
    moved, covariance = _average_fits([_fit_without_random_parts(null, targets[0]), *targets])
    # What frames left out say of the errors holds for any target.
    errors_of_noise = np.sqrt(np.diag(targets[0].covariance))
    larger = np.nan_to_num(between_frames[:count])
    # A broad image field turns a camera on the rig; of one by itself the poses take that up.
    larger[:start] = np.nan_to_num(errors[:start])
    larger = np.maximum(larger, errors_of_noise) / np.maximum(errors_of_noise, 1e-300)
    covariance = covariance * np.outer(larger, larger)
    free, lenses, end = targets[-1], [], start
    spread = np.sqrt(np.diag(free.covariance))
    for lens, own in zip(state.lenses, state.lens_names(names), strict=True):
        at, end = slice(end, end + len(own)), end + len(own)
        parameters = zip(
            own, parameter_values(lens, own), errors[at], free.step[at], spread[at], strict=True
        )
        lenses.append(
            LensTrust(
                dict(zip(own, errors[at].tolist(), strict=True)),
                {
                    name: _admissible(name, (value, error), (value + step, width))
                    for name, value, error, step, width in parameters
                },
                moved[at],
                covariance[at, at],
                noise_px(null),
            )
        )
    return SharedTrust(tuple(lenses), moved, covariance)


def generalize_rig(
    data: RigViews, state: RigState, names: Sequence[str], trusted: SharedTrust
) -> RigState:
    """Return a state at the values of generalized least squares, the poses of its frames by them.

    As it is where these are no lenses, or ones that are not near: the equations are linear.
    """
    ported = any(lens.port is not None for lens in state.lenses)
    if ported or not np.isfinite(trusted.moved).all():
        return state
    moved = state.retract(names, np.zeros((data.frames, 6)), trusted.moved)
    if any(lens.check() for lens in moved.lenses):
        return state
    moved = adjust_poses(data, moved)
    before, after = (Linearization(data, variant, ()).rms_px for variant in (state, moved))
    return moved if after < _MAX_RMS_RATIO * before else state


def generalize(calibration: Calibration, trusted: LensTrust) -> Calibration:
    """Return a calibration of one camera at the values of generalized least squares.

    As it is where these are no lens, or one that is not near: the equations are linear.
    """
    adjusted = calibration.adjusted
    if adjusted.lens.port is not None or not np.isfinite(trusted.moved).all():
        return calibration
    values = np.array(parameter_values(adjusted.lens, adjusted.names)) + trusted.moved
    try:
        moved = with_values(
            calibration, values.tolist(), least_squares_rms_px=rms_px(adjusted.residual)
        )
    except FisheyeSvpError:
        return calibration
    near = moved.adjusted.converged and rms_px(moved.adjusted.residual) < (
        _MAX_RMS_RATIO * rms_px(adjusted.residual)
    )
    return moved if near else calibration


def with_covariance(lens: Lens, trusted: LensTrust) -> Lens:
    """Return a calibrated lens whose `calibration` says how sure its numbers are, any target.

    stderr: one each, by name; covariance: of all, in the same order.
    """
    errors = np.sqrt(np.diag(trusted.covariance)).tolist()
    return replace(
        lens,
        calibration={
            **(lens.calibration or {}),
            'stderr': dict(zip(trusted.stderr, errors, strict=True)),
            'covariance': trusted.covariance.tolist(),
        },
    )


class _ParameterFit(NamedTuple):
    """Steps (K,) of parameters and their covariance (K, K), and the log evidence of a model."""

    step: Array
    covariance: Array
    evidence: float


def _fit_targets(null: NullModel, count: int) -> list[_ParameterFit]:
    """Return how parameters move for a target as it is said to be, and for ones that err more.

    The errors of the target are normal, with a share of what is large for each as their standard
    deviation, from none to all; larger ones are no target that anybody would take for exact.
    count: of these parameters, the first of what is in the model.
    """
    included, information = null.included_columns, null.information
    columns, precision = [included], [np.zeros(null.column_count)]
    for form, effect in enumerate(null.fixed.forms.effects):
        if effect.budget_stage() == 'target':
            columns.append(null.form_columns(form))
            precision.append(null.prior_precision(columns[-1], effect))
    every, prior = np.concatenate(columns), np.concatenate(precision)
    scale, fits = null.scale[:count], []
    for share in _TARGET_SHARES:
        columns_in_use = every if share else included
        more = prior[: len(columns_in_use)] / share**2 if share else np.zeros(len(included))
        inside = information[np.ix_(columns_in_use, columns_in_use)] + np.diag(more)
        inverse, score = pseudo_inverse(inside, 1e-13), information[columns_in_use, -1]
        sign, determinant = np.linalg.slogdet(inside)
        # Singular but for rounding, in data without noise: nothing tells such targets apart.
        evidence = score @ inverse @ score - determinant if sign > 0 else -np.inf
        evidence += np.log(more[len(included) :]).sum()
        block = inverse[:count, :count] / np.outer(scale, scale)
        fits.append(_ParameterFit((inverse @ score)[:count] / scale, block, float(evidence) / 2))
    return fits


def _fit_without_random_parts(null: NullModel, other: _ParameterFit) -> _ParameterFit:
    """Return the fit of least squares, which does not move; other: with random parts as they are.

    Evidence by the restricted likelihood; a variance counts as a parameter (BIC): in data without
    anything of its own, chance calls for a small one.
    """
    included, plain = null.included_columns, np.zeros_like(null.variances.alive)
    bare = factor_equations(null.full.select(plain), null.variances.lam, null.variances.weight)

    def likelihood(f: FactoredEquations) -> float:
        noise = null.remaining_information(f.information, included)[-1, -1] / null.freedom
        determinant = np.linalg.slogdet(f.information[np.ix_(included, included)])[1]
        return -float(f.log_determinant + determinant + null.freedom * np.log(noise)) / 2

    cost = int(null.variances.alive.sum()) * np.log(null.full.rows) / 2
    gain = likelihood(null.factorization) - likelihood(bare) - cost
    return _ParameterFit(np.zeros_like(other.step), other.covariance, other.evidence - gain)


def _average_fits(fits: Sequence[_ParameterFit]) -> tuple[Array, Array]:
    """Return the mean step (K,) and its covariance (K, K), each model weighted by its evidence.

    Source: Hoeting et al., Bayesian model averaging: a tutorial, Statistical Science 14 (1999).
    """
    weight = special.softmax([fit.evidence for fit in fits])
    steps = np.array([fit.step for fit in fits])
    mean = weight @ steps
    within = np.einsum('t,tkl->kl', weight, np.array([fit.covariance for fit in fits]))
    return mean, within + (steps - mean).T @ (weight[:, None] * (steps - mean))


def _admissible(name: str, *found: tuple[float, float]) -> Admissible:
    """Return the range of a parameter from values and standard errors, by target said and free."""
    (value, stderr), (moved, spread) = found
    ends = [
        middle + sign * _INTERVAL_SIGMAS * error for middle, error in found for sign in (-1, 1)
    ]
    sure = name not in _SHIFT_NAMES or min(ends) > 0 or max(ends) < 0
    near = abs(moved - value) < _INTERVAL_SIGMAS * np.hypot(stderr, spread)
    return Admissible(min(ends), max(ends), bool(sure and near))


def localize_with_errors(
    errors: LensErrors,
    observations: Observations,
    tag_map: TagMap | None = None,
    *,
    readout_time: float = 0.0,
) -> tuple[SolvedPoses, ErrorParts]:
    """Pose every frame of one camera's table that can be posed, and say how far off each may be.

    Raises ObservationError and GeometryError as `solve_table` does.
    """
    allowed = replace(observations, sigma=np.asarray(errors.inflate_sigma(observations.sigma)))
    solved = solve_table(allowed, ForwardModel(errors.lens), tag_map, readout_time=readout_time)
    kept = solved.views._replace(weight=np.where(solved.outliers, 0.0, solved.views.weight))
    parts = errors.of_solved_poses(kept, solved.result, solved.sigma)
    return solved._replace(result=solved.result._replace(covariance=parts.total)), parts


def depth_errors(
    left: LensErrors, right: LensErrors, rig: Pose, points: Array, sigma: float = 0.0
) -> ErrorParts:
    """Return covariances (N, 3, 3), m^2, of stereo points (N, 3), m, in the right camera.

    Of points of least reprojection error; rig: left camera in the right one, taken as it is;
    sigma: noise of the image points, px, where it is more than that of the lenses.  NaN where a
    point is NaN or a camera does not see it.
    """
    noise = [max(errors.noise, sigma) for errors in (left, right)]
    totals = [np.full((len(points), 3, 3), np.nan) for _ in ErrorParts._fields]
    finite = np.flatnonzero(np.isfinite(points).all(axis=1))
    for rows in (finite[i : i + _MAX_POINTS] for i in range(0, len(finite), _MAX_POINTS)):
        views = views_of(points[rows, None], np.zeros((len(rows), 1, 2)))
        pairs = [
            (errors, errors.linearize(views, pose))
            for errors, pose in ((left, rig.broadcast_to(len(rows))), (right, identity(len(rows))))
        ]
        by = [
            linear.whiten(linear.linear.d_target) / px
            for px, (_, linear) in zip(noise, pairs, strict=True)
        ]
        seen = np.asarray(np.isfinite(by[0] + by[1]).all(axis=(1, 2)))
        by = [np.where(seen[:, None, None], one, np.eye(2, 3)) for one in by]
        rows_of_both = np.concatenate(by, axis=1)
        information = np.swapaxes(rows_of_both, -1, -2) @ rows_of_both
        information[~seen] = np.eye(3)
        for px, (errors, linear), one in zip(noise, pairs, by, strict=True):
            maps = np.linalg.solve(information * px, np.swapaxes(one, -1, -2))
            parts = errors.model.propagate(linear, np.asarray(maps))
            parts = parts._replace(noise=parts.noise * px**2)
            for whole, part in zip(totals, parts, strict=True):
                whole[rows] = np.nan_to_num(whole[rows]) + part
        for whole in totals:
            whole[rows[~seen]] = np.nan
    return ErrorParts(*totals)


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
    doubtful = any(term.effect.stage in ('target', 'pose') for term in after.state.terms)
    if after.data.cameras == 2 and not doubtful:
        measured['depth_error_m'] = _depth_errors
    pairs = [list(_train_folds(linear, free)) for linear in (before, after)] if measured else []
    comparisons = {
        name: [
            np.concatenate([errors(held_out, state) for held_out, state in folds])
            for folds in pairs
        ]
        for name, errors in measured.items()
    }
    return {
        name: compare_errors(*both)
        for name, both in comparisons.items()
        if np.isfinite(both[0] + both[1]).any()
    }


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


def _known_poses(data: RigViews) -> Pose:
    assert data.poses is not None
    return data.poses.take(data.frame_of[_first_camera(data)])


def _position_errors(held_out: RigViews, state: RigState) -> Array:
    off = state.pose.position - _known_poses(held_out).position
    return np.asarray(np.linalg.norm(off, axis=-1))


def _axis_errors(held_out: RigViews, state: RigState) -> Array:
    return axis_angle_between(state.pose, _known_poses(held_out))


def _depth_errors(held_out: RigViews, state: RigState) -> Array:
    """Return the mean error of each frame, m; NaN where the cameras share no landmark."""
    first, second = (state.model.camera(camera) for camera in (0, 1))
    place = state.pose if held_out.poses is None else _known_poses(held_out)
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
    partner = np.flatnonzero((data.frame_of == data.frame_of[view]) & (data.camera_of == 1))
    ids = np.where(data.views.used, data.views.landmark, -1 - data.camera_of[:, None])
    _, i, j = np.intersect1d(ids[view], ids[partner], return_indices=True)
    uv = data.views.uv
    return data.views.points[view, i], uv[view, i], uv[partner].reshape(-1, 2)[j]
