"""What a lens is judged by: the lens file on held-out frames, bounds, ray errors, its offset."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isclose
from pathlib import Path

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask, flat_rows
from fisheye_svp_ros.diagnosis.checks.medium import InAir, stated_parameters
from fisheye_svp_ros.diagnosis.cross_validation import (
    HeldOut,
    gain_and_confidence,
    noise_ratio,
    predictable_rows,
    sum_squares,
)
from fisheye_svp_ros.diagnosis.decision import (
    RAY_RATIO,
    EffectBound,
    FileFigure,
    LensOffset,
    least_likely_offset,
)
from fisheye_svp_ros.diagnosis.evaluation import Evaluation
from fisheye_svp_ros.diagnosis.model_errors import count_rig_columns, mask_shared
from fisheye_svp_ros.diagnosis.null_model import NullModel
from fisheye_svp_ros.diagnosis.uncertainty import LensCovariance
from fisheye_svp_ros.effects.base import Effect
from fisheye_svp_ros.mixed_model import project_out, pseudo_inverse, solve_lower
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.solve.ray_errors import (
    RANGES,
    RayError,
    RayMap,
    RayModel,
    map_rays,
    points_on_rays,
    ray_model,
    typical_points,
    without_motion,
)
from fisheye_svp_ros.solve.rig_state import Linearization, RigState

_BOUNDED_EFFECTS = ('viewpoint_shift', 'sensor_tilt', 'decentering')
_NORMAL_95 = 1.96
_EDGE = 0.9  # of the points by incidence angle: beyond is the edge
_FLOOR = 0.1  # of the noise: what an angle may differ by without a reason
_LINEARITY = 0.05  # of a change: beyond it, its columns are no measure
_DIRECTIONS = 64  # more than a lens has parameters
_NEGLIGIBLE = 1e-8  # of a variance
_SAME_RMS = 1e-3  # relative
_ROUNDING = 1e-10  # of the variance of an angle: below it, a covariance has no root
_BOUND_QUANTILE = 0.95
_BISECTIONS = 20
_NEAR_RANGE = 1  # of ray_errors.RANGES: 1 m


def lens_columns(linear: Linearization) -> Mask:
    """Return which of what is shared (K,) goes into a lens file: intrinsics, lasting effects."""
    return mask_shared(linear, lambda effect: effect.stage != 'target' and not effect.of_recording)


def compare_lens_files(evaluation: Evaluation) -> FileFigure:
    """Predict frames left out one by one with the lens as given and the extended one.

    The target and the offsets of its landmarks are those that the other frames predict with the
    extended lens, for both lenses; that favors the extended one.  An image field that is written
    is of the extended lens alone.  A lens that was calibrated from these data has learned from the
    frame, too: both are fitted without it.
    """
    if evaluation.medium is not None:  # the lens as given is one in air
        gain = evaluation.gains['named']
        return FileFigure(
            gain.before, gain.after, gain.value, gain.low, gain.high, float(gain.low > 0)
        )
    kept = evaluation.counted_frames
    before, after = (prediction.take(kept) for prediction in _predict_with_files(evaluation))
    gain, sure = gain_and_confidence(before, after, evaluation.noise_px)
    return FileFigure(before.rms, after.rms, gain.value, gain.low, gain.high, sure)


def _predict_with_files(evaluation: Evaluation) -> tuple[HeldOut, HeldOut]:
    null, averaged = evaluation.null, evaluation.averaged_model
    linear, ratio, at = null.linear, noise_ratio(null.linear), averaged.border
    now, given = _shared_values(evaluation)
    whole = averaged.refit(null.information[np.ix_(at, at)])
    of_lens = averaged.columns_of_lens.copy()
    of_lens[: len(now)] = lens_columns(linear)
    always = np.isin(np.arange(len(now)), averaged.posterior.fixed)
    before = np.zeros(len(at) - 1)
    before[: len(now)] = (np.where(always, now, 0.0) - given) * null.scale[: len(now)]
    refit_rig = _rig_response(null, at[:-1])
    residual = np.zeros((*linear.residual.shape, 2))
    _, rows, fields = null.leave_one_out(at)
    has_field = evaluation.written_field is not None and bool(evaluation.written_field.fields)
    lenses = evaluation.problem.inputs.lenses.values()
    both_change = all(_is_of_these_data(evaluation, lens) for lens in lenses)
    for frame, information in enumerate(null.information_without_frames(at)):
        left = averaged.refit(information)
        # Without the frame, a lens that was fitted to it changes as the extended one does.
        off = before + left.values
        if both_change:
            off[left.always] -= left.with_effects_of(whole) - whole.values[left.always]
        off = np.where(of_lens, off, 0.0)
        off[: len(refit_rig)] -= refit_rig @ off
        residual[frame] = (rows[frame] @ left.combination)[:, None]
        residual[frame, :, 0] += null.fixed.border[frame][:, at[:-1]] @ off
        if has_field:
            residual[frame, :, 0] += fields[frame] @ left.combination
    near, even = predictable_rows(linear), ratio[..., None]
    kept = near[..., None] * even
    left_over = project_out(residual * kept, linear.frame_columns * kept) / even
    before_px, after_px = (sum_squares(linear, left_over[..., i], near) for i in (0, 1))
    return before_px, after_px


def _rig_response(null: NullModel, at: Index) -> Array:
    """Return by how much (6 (C - 1), m) the rig moves for each of some columns (m,).

    As the poses of the frames, those of the cameras on the rig are fitted with either lens:
    otherwise a center that the rig would absorb counts as an error of the lens as given.
    """
    count = count_rig_columns(null.linear)
    left = flat_rows(project_out(null.fixed.border[..., at], null.linear.frame_columns))
    products = left[:, :count].T @ left
    return pseudo_inverse(products[:, :count]) @ products


def _shared_values(evaluation: Evaluation) -> tuple[Array, Array]:
    """Return what is shared (K,), zeros for the rig, as it was found and as the lenses have it."""
    null, problem = evaluation.null, evaluation.problem
    start, free = count_rig_columns(null.linear), null.linear.free
    now = np.append(np.zeros(start), null.linear.state.shared_values(free))
    stated, given = stated_parameters(problem.inputs.lenses), now.copy()
    given[start : start + len(free)] = [stated[name][0] for name in free]
    before = {term.name: term.values for term in problem.base.terms}
    for term in null.terms:
        held = before.get(term.name)
        given[term.columns] = 0.0 if held is None or len(held) != len(term.values) else held
    return now, given


def find_bounds(null: NullModel, more: Sequence[str] = ()) -> list[EffectBound]:
    """Return how large effects that are not in the model may be, the target free as well.

    more: effects beside those that are always bounded.
    """
    columns, prior = [null.included_columns], [np.zeros(null.column_count)]
    smallest: dict[str, tuple[Effect, Index]] = {}
    for form, effect in enumerate(null.fixed.forms.effects):
        mine = null.form_columns(form)
        if effect.budget_stage() == 'target':
            columns.append(mine)
            prior.append(null.prior_precision(mine, effect))
        elif (
            effect.name in (*_BOUNDED_EFFECTS, *more)
            and not null.effect_kinds & set(effect.kinds)
            and (effect.name not in smallest or len(mine) < len(smallest[effect.name][1]))
        ):
            smallest[effect.name] = effect, mine
    return [
        _effect_bound(
            null,
            effect,
            mine,
            np.concatenate([*columns, mine]),
            np.concatenate([*prior, null.prior_precision(mine, effect)]),
        )
        for effect, mine in smallest.values()
    ]


def _effect_bound(
    null: NullModel, effect: Effect, mine: Index, every: Index, prior: Array
) -> EffectBound:
    information, count, scale = null.information, len(mine), null.scale[mine]
    inverse = pseudo_inverse(information[np.ix_(every, every)] + np.diag(prior), 1e-13)
    value = (inverse @ information[every, -1])[-count:] / scale
    covariance = inverse[-count:, -count:] / np.outer(scale, scale)
    spread, vectors = np.linalg.eigh(covariance)
    size, error = float(np.linalg.norm(value)), float(np.sqrt(max(spread[-1], 0.0)))
    z = float(np.sqrt(max(value @ np.linalg.pinv(covariance) @ value / count, 0.0)))
    largest = size + _NORMAL_95 * error
    way = value / size if size > error else vectors[:, -1]
    cost = _edge_cost(null, (null.fixed.border[..., mine] * scale) @ (largest * way))
    return EffectBound(effect.name, largest, effect.parameters[0].unit, z, *cost)


def _edge_cost(
    null: NullModel, moves: Array
) -> tuple[float, float, tuple[float, float], tuple[float, float]]:
    """Return what whitened moves (F, M) are at the edge once poses took up theirs, px and mrad.

    Then the incidence angles, rad, and the ranges, m, that this is of.
    """
    linear = null.linear
    left = project_out(moves[..., None], linear.frame_columns)[..., 0]
    weight = np.where(linear.row_weight > 0, linear.row_weight, np.inf)
    px = np.hypot(*np.moveaxis((left / weight).reshape(len(left), -1, 2), -1, 0))
    theta = linear.data.blocks(np.nan_to_num(linear.scene.theta)[..., None] * np.ones(2))[:, ::2]
    seen = linear.row_mask[:, ::2]
    edge = seen & (theta >= np.quantile(theta[seen], _EDGE))
    cost = float(np.sqrt((px[edge] ** 2).mean()))
    lens = linear.state.lens
    slope = lens.fx * float(np.mean(lens.image_height.value_and_slope(theta[edge])[1]))
    away = np.linalg.norm(linear.linear.image.points, axis=-1)[linear.data.views.used]
    angles = float(theta[edge].min()), float(theta[edge].max())
    return cost, 1e3 * cost / max(slope, 1e-9), angles, (float(away.min()), float(away.max()))


def find_lens_rays(
    evaluation: Evaluation, lenses: Mapping[str, Lens]
) -> tuple[dict[str, dict[str, list[RayError]]], LensOffset | None]:
    """Compare the rays of lenses as given, by camera, and as extended.

    Returns the ray errors of both, by range (the one that the user asks for comes last), of the
    lenses of which something is fitted, and the least likely offset.
    """
    if evaluation.medium is not None:
        return {}, None
    known = evaluation.lens_covariance
    fresh = evaluation.extended_lenses(_generalized_state(evaluation.selection.first))
    views = known.linear.data.views
    errors, offsets, asked = {}, [], evaluation.problem.options.range_m
    for number, (name, given) in enumerate(lenses.items()):
        mine = views.used & ((views.camera == number) | (len(lenses) == 1))[:, None]
        uv = typical_points(views.uv[mine])
        model, there = _written_rays(evaluation, known, number, name, uv)
        if not model.columns.any():
            continue  # nothing of this lens is fitted: nothing is known of its errors
        off = _difference(model, points_on_rays(given, uv[there]))
        errors[name] = {'given': model.errors(off), 'extended': model.errors()}
        if asked is not None and asked not in RANGES:
            wider, near = _written_rays(evaluation, known, number, name, uv, (*RANGES, asked))
            more = _difference(wider, points_on_rays(given, uv[near], wider.ranges))
            errors[name]['given'].append(wider.errors(more)[-1])
            errors[name]['extended'].append(wider.errors()[-1])
        if _is_of_these_data(evaluation, given):
            continue  # a fresh calibration is this one
        new = _difference(model, points_on_rays(fresh[name], uv[there]))
        one = _offset(model, off, new, given, uv[there], evaluation.noise_px)
        offsets.append(one._replace(camera=name if len(lenses) > 1 else ''))
    return errors, least_likely_offset(offsets)


def map_lens_rays(evaluation: Evaluation) -> dict[str, RayMap]:
    """Return how well the rays of each lens that is written are known, over its image.

    Of those lenses of which something is fitted.
    """
    if evaluation.medium is not None:
        return {}
    known = evaluation.lens_covariance
    if not lens_columns(known.linear).any():
        return {}
    views, lenses = known.linear.data.views, evaluation.problem.inputs.lenses
    maps = {}
    for number, (name, lens) in enumerate(lenses.items()):

        def rays_of(
            uv: Array,
            ranges: tuple[float, ...],
            datum: int,
            number: int = number,
            name: str = name,
        ) -> tuple[RayModel, Mask]:
            return _written_rays(evaluation, known, number, name, uv, ranges, datum)

        mine = views.used & ((views.camera == number) | (len(lenses) == 1))[:, None]
        found = map_rays(rays_of, views.uv[mine], (lens.width, lens.height))
        if np.nanmax(found.sd, initial=0.0) > 0:
            maps[name] = found
    return maps


def _generalized_state(null: NullModel) -> RigState:
    """Return the state that generalized least squares finds: nearly what `calibrate` writes."""
    own, linear = null.included_columns, null.linear
    inverse = pseudo_inverse(null.information[np.ix_(own, own)], 1e-13)
    step = inverse @ null.information[own, -1] / null.scale[own]
    return linear.state.retract(linear.free, np.zeros((linear.data.frames, 6)), step)


def _is_of_these_data(evaluation: Evaluation, lens: Lens) -> bool:
    """Whether a lens was calibrated on the table that is diagnosed, by its name and size.

    Generalized least squares keeps away from the fit without causes, and is not off for it.
    """
    block, table = lens.calibration or {}, evaluation.problem.observations
    if block.get('frames') != len(table.frames):
        return False
    name = Path(str(block.get('source', ''))).name
    if name != Path(Observations.source).name:
        return name == Path(table.source).name
    # Arrays have no name of their own: least squares leaves the same of the same data.
    left = block.get('least_squares_rms_px', block.get('rms_px'))
    return bool(left and isclose(left, evaluation.figures.base.rms_px, rel_tol=_SAME_RMS))


def _written_rays(
    evaluation: Evaluation,
    known: LensCovariance,
    camera: int,
    name: str,
    uv: Array,
    ranges: tuple[float, ...] = RANGES,
    datum: int | None = None,
) -> tuple[RayModel, Mask]:
    """Return the rays of the lens of a camera that is written, and which points (G,) have some."""
    linear, written = known.linear, evaluation.written_field
    of_lens, frames = lens_columns(linear), np.zeros((linear.data.frames, 6))

    def extend_lens(step: Array) -> Lens:
        shared = np.zeros(len(of_lens))
        shared[of_lens] = step
        lens = evaluation.extended_lenses(linear.state.retract(linear.free, frames, shared))[name]
        return lens if written is None else written.add_to(lens, camera)

    covariance = known.covariance[np.ix_(of_lens, of_lens)]
    model, there = ray_model(
        extend_lens, covariance, uv, ranges, known.others[of_lens], known.freedom, datum
    )
    field = None if written is None else written.fields.get(camera)
    if field is None:
        return model, there
    covariance, cross = known.with_field(field)
    lens = extend_lens(np.zeros(int(of_lens.sum())))
    return model.with_field(
        lens, uv[there], field.bumps_at(uv[there]), covariance, cross[of_lens]
    ), there


def _difference(model: RayModel, points: Array) -> Array:
    """Return by what angles (R, G, 3), rad, other rays differ; 0 where there are none."""
    change = points - model.points
    there = np.isfinite(change).all(axis=(0, 2))
    found = np.zeros_like(change)
    found[:, there] = without_motion(model.points[:, there], change[:, there])
    return found


def _offset(
    model: RayModel, off: Array, fresh: Array, given: Lens, uv: Array, noise: float
) -> LensOffset:
    """Return how far a lens is off the written one, and how often chance does as much.

    By the covariance of what both may be off: a small change counts where it is known well.
    off, fresh (R, G, 3), rad: of the lens, and of a fresh calibration, to the written one; noise:
    px; angles far below it, and what a large change is by more than linear, do not count.
    """
    near, errors = off[_NEAR_RANGE], model.sample(_NEAR_RANGE)
    expected = errors
    stated = _stated_sample(given, uv)
    if stated is not None and stated.shape == expected.shape:
        expected = expected + stated
    focal = float(np.sqrt(given.fx * given.fy))
    floor = float(np.hypot(_FLOOR * noise / focal, _LINEARITY * _rms(near)))
    distance, drawn = _distances(near, expected, floor)
    p_value = float((1 + (drawn >= distance).sum()) / (1 + len(drawn)))
    ratio = distance / max(float(np.sqrt((drawn**2).mean())), 1.0)
    least = _least_size(near, errors)
    # Over all ranges together, as likely models have it.
    squares = [(model.draw_sizes(one) ** 2).mean(axis=0) for one in (off, fresh)]
    better = float((squares[0] >= RAY_RATIO**2 * squares[1]).mean())
    return LensOffset(
        1e3 * least, ratio, p_value, least * focal, stated is not None, better=better
    )


def _least_size(off: Array, errors: Array) -> float:
    """Return the rms of the least multiple of angles (G, 3) that these do not exclude (95 %).

    What is seen beside a true difference d is d + e; errors (G, 3, S): drawn ones.  The least d
    along the angles is that beside which the rms of 95 % of d + e is below what is seen.
    """
    square = _rms(off) ** 2
    across = (off[..., None] * errors).sum(axis=(0, 1)) / len(off)
    own = (errors**2).sum(axis=(0, 1)) / len(off)

    def is_excluded(share: float) -> bool:
        seen = share**2 * square + 2 * share * across + own
        return bool(np.quantile(seen, _BOUND_QUANTILE) < square)

    low, high = 0.0, 1.0
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        low, high = (middle, high) if is_excluded(middle) else (low, middle)
    return float(low * np.sqrt(square))


def _distances(off: Array, samples: Array, floor: float) -> tuple[float, Array]:
    """Return the Mahalanobis distance of angles (G, 3) and of samples (G, 3, S) of their errors.

    floor: rms of angles, rad, that counts as one standard deviation beside their covariance.
    Source: Mahalanobis, On the generalized distance in statistics (1936).
    """
    flat = samples.reshape(-1, samples.shape[-1])
    variance = float((flat**2).sum()) / flat.size
    least = floor**2 * len(flat) / 3 + _ROUNDING * variance  # rounding of data without noise
    within, rest = _reduce_rank(flat, off.ravel(), least)
    covariance: Array = within[:, 1:] @ within[:, 1:].T / flat.shape[1]
    covariance[np.diag_indices_from(covariance)] += least
    root = np.asarray(np.linalg.cholesky(covariance))
    distances = np.sqrt((solve_lower(root, within) ** 2).sum(axis=0))
    distances[0] = np.hypot(distances[0], rest / np.sqrt(least))
    return float(distances[0]), distances[1:]


def _reduce_rank(samples: Array, off: Array, least: float) -> tuple[Array, float]:
    """Return angles and samples (K, 1 + S) in a basis, and how far the angles are off it.

    Errors of a few parameters span a few directions: some samples tell which.  All directions
    where what the others have beyond those, squared, is not far below `least`, a variance.
    """
    basis = np.linalg.qr(samples[:, :_DIRECTIONS])[0]
    both = np.column_stack([off, samples])
    within = basis.T @ both
    beyond = ((both - basis @ within) ** 2).sum(axis=0)
    if (beyond[1:] > _NEGLIGIBLE * least).any():
        return both, 0.0
    return within, float(np.sqrt(beyond[0]))


def _rms(angles: Array) -> float:
    return float(np.sqrt((angles**2).sum(axis=-1).mean()))


def _stated_sample(lens: Lens, uv: Array) -> Array | None:
    """Return ray errors (G, 3, samples), rad, at 1 m as a lens file states; None for nothing."""
    stated = InAir.from_lens(lens)
    if stated is None:
        return None
    known = {'f': lens.fx, **lens.parameters}
    values = np.array([known[name] for name in stated.names])

    def perturb_lens(step: Array) -> Lens:
        return lens.with_parameters(stated.names, [*(values + step).tolist()])

    return ray_model(perturb_lens, stated.covariance, uv)[0].sample(_NEAR_RANGE, seed=1)
