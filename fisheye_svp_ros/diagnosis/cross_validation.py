"""Cross-validation: residuals of frames that were not used, and errors where the truth is known.

Poses are fitted to the frames, all else is predicted from the others or from other data.
Contiguous blocks of the frames are a warning, no decision: a cause that the camera has for part of
the recording only, or that stands in for something else, may make a block worse although it
predicts single frames better.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.diagnosis.fitted_model import FittedModel, PredictedOffsets, refit
from fisheye_svp_ros.diagnosis.null_model import NullModel, border_of
from fisheye_svp_ros.mixed_model import (
    FactoredEquations,
    RandomColumns,
    Variances,
    factor_equations,
    make_equations,
    project_out,
    subtract_fit,
)
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.scene.table_checks import is_another_target
from fisheye_svp_ros.solve.bundle_adjustment import adjust, adjust_poses
from fisheye_svp_ros.solve.initial_rig import localize_frames
from fisheye_svp_ros.solve.outliers import NO_OUTLIERS, Outliers, find_outliers, without_points
from fisheye_svp_ros.solve.rig_checks import has_no_rig, rig_differs, unpair_cameras
from fisheye_svp_ros.solve.rig_state import Linearization, RigState, RigViews, group_by_frame
from fisheye_svp_ros.solve.wrong_landmarks import find_wrong_landmarks

_RESAMPLES = 2000
_PREDICTED_RATIO = 5.0  # times the median frame
_LINEAR_PX = 3.0  # rms: how far a step that is taken to be linear may move image points
BLOCKS = 3
_MIN_FRAMES = 9
_MAX_SQUARE_RATIO = 1.02  # times the sum of squares without: less is chance

Ends = tuple[int, int]  # the first and the last frame of a block


class HeldOut(NamedTuple):
    """Misfit of held-out frames: sums (F,) of squared 2-D residuals, px^2, and counts (F,)."""

    squares: Array
    counts: Array

    @property
    def rms(self) -> float:
        """Root mean square of the 2-D residual norm, px."""
        return float(self.rms_of(np.arange(len(self.squares))))

    @property
    def is_predictable(self) -> Mask:
        """Which frames (F,) are not far worse than most: those show what no other frame does."""
        size = np.sqrt(self.squares / np.maximum(self.counts, 1))
        return np.asarray(size <= _PREDICTED_RATIO * np.median(size))

    def take(self, rows: Index | Mask) -> HeldOut:
        """Return some of the frames."""
        return HeldOut(self.squares[rows], self.counts[rows])

    def rms_of(self, rows: Index) -> Array:
        """Return the rms (...), px, of the frames (..., F) that count."""
        return np.asarray(
            np.sqrt(self.squares[rows].sum(axis=-1) / self.counts[rows].sum(axis=-1))
        )

    def excess(self, noise: float, rows: Index) -> Array:
        """Mean squares (B,) above what noise leaves once each frame has fitted its pose, px^2.

        rows: the frames (B, F) that count.
        """
        squares, counts = self.squares[rows].sum(axis=1), self.counts[rows].sum(axis=1)
        freedom = np.maximum(2 * self.counts - 6, 0)[rows].sum(axis=1)
        return np.asarray((squares - noise**2 * freedom) / counts)


class Comparison(NamedTuple):
    """An error before and after: by how much it is less, and the 95 % interval over frames.

    value: 1 - after / before, of what the function that makes it says, or before - after.
    """

    before: float
    after: float
    value: float
    low: float
    high: float

    @property
    def interval(self) -> dict[str, float]:
        """Return value and interval alone, as diagnosis.json has them."""
        return {'value': self.value, 'low': self.low, 'high': self.high}

    def to_dict(self) -> dict[str, float]:
        """Return what diagnosis.json holds of an error and its gain."""
        return {
            'base': self.before,
            'extended': self.after,
            'gain': self.value,
            'low': self.low,
            'high': self.high,
        }


def rms_reduction(before: HeldOut, after: HeldOut) -> Comparison:
    """Return by how much the rms is less, px, with a bootstrap interval over frames."""
    rows = _resample_frames(len(before.squares))
    low, high = np.quantile(before.rms_of(rows) - after.rms_of(rows), (0.025, 0.975))
    return Comparison(before.rms, after.rms, before.rms - after.rms, float(low), float(high))


def gain_and_confidence(before: HeldOut, after: HeldOut, noise: float) -> tuple[Comparison, float]:
    """Return 1 - (held-out variance above noise after) / (before), with a bootstrap interval.

    And the share of the bootstrap in which it is above zero.  The interval holds the value, also
    where hardly anything is above the noise.
    """
    gains = _excess_gain(before, after, noise, _resample_frames(len(before.squares)))
    low, high = np.quantile(gains, (0.025, 0.975))
    whole = np.arange(len(before.squares))[None]
    value = float(_excess_gain(before, after, noise, whole)[0])
    ends = min(float(low), value), max(float(high), value)
    gain = Comparison(before.rms, after.rms, value, *ends)
    return gain, float((gains > 0).mean())


def compare_errors(base: Array, extended: Array) -> Comparison:
    """Compare the mean errors (F,) of frames, NaN where there is none."""
    known = np.isfinite(base) & np.isfinite(extended)
    both = np.stack([base[known], extended[known]])
    low, high = np.quantile(
        _reduction(*both[:, _resample_frames(both.shape[1])].mean(axis=-1)), (0.025, 0.975)
    )
    first, second = both.mean(axis=1)
    return Comparison(
        float(first), float(second), float(_reduction(first, second)), float(low), float(high)
    )


def _reduction(before: Array, after: Array) -> Array:
    """Return by which shares errors are less; where there was none before, nothing."""
    some = before > 0
    return np.where(some, 1 - after / np.where(some, before, 1.0), 0.0)


def _resample_frames(frames: int) -> Index:
    return np.random.default_rng(0).integers(0, frames, (_RESAMPLES, frames))


def _excess_gain(before: HeldOut, after: HeldOut, noise: float, rows: Index) -> Array:
    base = before.excess(noise, rows)
    # With nothing above the noise there is nothing to gain.
    some = base > 1e-3 * noise**2
    gain = 1 - after.excess(noise, rows) / np.where(some, base, 1.0)
    return np.where(some, np.clip(gain, -1.0, 1.0), 0.0)


def predict_other_data(
    test: RigViews, state: RigState, offsets: PredictedOffsets | None = None
) -> HeldOut:
    """Predict other frames of the same camera and target, from poses in the state."""
    # In px every point counts alike, however noisy it is.
    plain = replace(state, terms=tuple(t for t in state.terms if t.effect.stage != 'noise'))
    data = test if offsets is None else offsets.apply(test)
    fitted = adjust_poses(data, plain)
    if offsets is not None and offsets.views is not None:
        linear = Linearization(data, replace(fitted, terms=state.terms), ())
        repeating = offsets.views.predict(linear)
        data = replace(data, views=data.views._replace(uv=data.views.uv - repeating))
        fitted = adjust_poses(data, fitted)
    linear = Linearization(data, fitted, ())
    return sum_squares(linear, linear.residual)


def fit_without_causes(null: NullModel, names: Sequence[str], free: Sequence[str]) -> RigState:
    """Return the state without some of its effects, the rest fitted anew.

    By one linear step; where that is too long to be linear, step by step.
    """
    linear = null.linear
    kept, change, _ = refit_shared(null, null.information, names)
    shared = np.zeros(null.column_count)
    shared[kept] = change
    moves = (linear.shared_columns @ shared)[linear.row_mask] / linear.row_weight[linear.row_mask]
    if np.sqrt(2 * np.mean(moves**2)) > _LINEAR_PX:
        state = adjust(linear.data, linear.state.without_effects(names), free)
        return refit(linear.data, state, free, null.variances)
    frame = np.zeros((linear.data.frames, 6))
    return linear.state.retract(free, frame, shared).without_effects(names)


def refit_shared(
    null: NullModel, information: Array, names: Collection[str] = (), held: Collection[str] = ()
) -> tuple[Index, Array, Array]:
    """Return the columns that are fitted, their change, and (m,) what is left.

    information (m, m): of what is in the model and, last, the residual; more columns are left
    alone.  names: causes that are gone; held: causes that stay as they are.  The last is the
    combination of the border that is the residual then.
    """
    gone = np.zeros(null.column_count, dtype=bool)
    values = np.zeros(null.column_count)
    for term in null.terms:
        if term.name in names:
            gone[term.columns], values[term.columns] = True, term.values
        elif term.name in held:
            gone[term.columns] = True
    combination = np.zeros(len(information))
    combination[-1] = 1.0
    # Without an effect its displacement comes back into the residual.
    scale = null.scale[: null.column_count]
    combination[: null.column_count] += np.where(gone, values * scale, 0.0)
    kept = np.flatnonzero(~gone)
    left = subtract_fit(information, kept, combination, 1e-13)
    return kept, (combination - left)[kept] / null.scale[kept], left


def cross_validate(
    null: NullModel,
    without: Collection[str] = (),
    offsets: PredictedOffsets | None = None,
    held: Collection[str] = (),
) -> HeldOut:
    """Predict frames left out one by one by a fit to the others (linear in all parameters).

    without: causes that are left out; offsets: random effects to predict, each frame's from the
    others; held: causes that are not fitted anew.
    """
    linear, ratio = null.linear, noise_ratio(null.linear)
    residual = np.zeros_like(linear.residual)
    repeating = np.zeros_like(residual)
    if offsets is not None and offsets.views is not None:
        weight = linear.data.views.weight[..., None]
        repeating = linear.data.blocks(offsets.views.cross_predictions * weight)
    at = null.columns_and_residual(null.included_columns)
    rows = null.fixed.border[..., at] if offsets is None else null.leave_one_out(at).rows
    for frame, information in enumerate(null.information_without_frames(at)):
        _, _, combination = refit_shared(null, information, without, held)
        residual[frame] = rows[frame] @ combination
    near = predictable_rows(linear)
    left = project_out(
        ((residual * ratio - repeating) * near)[..., None],
        linear.frame_columns * (ratio * near)[..., None],
    )
    return sum_squares(linear, left[..., 0] / ratio, near)


def noise_ratio(linear: Linearization) -> Array:
    """Return what takes the weights (F, M) of uneven noise out of whitened rows."""
    weight = linear.data.blocks(linear.data.views.weight[..., None] * np.ones(2))
    own = linear.row_weight
    return np.where(own > 0, weight / np.maximum(own, 1e-300), 1.0)


def predictable_rows(linear: Linearization, block: Index | None = None) -> Mask:
    """Return which rows (F, M) other frames can predict: those no farther from the axis.

    block (F,): frames that are left out together, None for one by one.  Beyond all points of the
    others a lens is extrapolated, and the better model may be the one that is farther off.
    """
    data, views = linear.data, linear.data.views
    block = np.arange(data.frames) if block is None else block
    theta = np.where(views.used, np.nan_to_num(linear.scene.theta), -np.inf)
    farthest = np.full((data.cameras, int(block.max()) + 2), -np.inf)  # the last of no block
    np.maximum.at(farthest, (data.camera_of, block[data.frame_of]), theta.max(axis=1))
    ranked = np.sort(farthest, axis=1)
    limit = np.where(farthest == ranked[:, -1:], ranked[:, -2:-1], ranked[:, -1:])
    limit = np.where(np.isfinite(limit), limit, np.inf)[data.camera_of, block[data.frame_of]]
    near = views.used & (theta <= limit[:, None])
    return np.asarray(data.blocks(near[..., None] * np.ones(2)) > 0)


def sum_squares(linear: Linearization, whitened: Array, counted: Mask | None = None) -> HeldOut:
    """Return the figures of whitened residuals (F, M); counted (F, M): of some of the rows."""
    weight = linear.row_weight
    rows = weight > 0 if counted is None else counted
    px = np.where(rows, whitened / np.maximum(weight, 1e-12), 0.0)
    return HeldOut((px**2).sum(axis=1), rows.sum(axis=1) / 2)


@dataclass(frozen=True)
class HeldOutData:
    """Other frames of the same cameras, posed, without outliers.

    rig_differs: whether the cameras do not stand as in the data, so that each view was posed by
    itself; another_target: whether landmarks of one number stand in other places.
    """

    data: RigViews
    pose: Pose
    outliers: Outliers
    rig_differs: bool
    another_target: bool

    @classmethod
    def prepare(cls, held_out: Observations, model: Linearization) -> HeldOutData:
        """Pose other frames by the extended model, and set outliers aside.

        These are no measure of a model; the same points are left out for all.
        """
        trained = model.data
        another_target = is_another_target(trained.observations, held_out)
        table = group_by_frame(held_out)
        if has_no_rig(trained):
            table = unpair_cameras(table)
        state = valid_state(model.state, table, trained, another_target)
        wrong = find_wrong_landmarks(table.observations, state.model, lambda _: state.model)
        rejected = NO_OUTLIERS.append_landmarks(table.observations, wrong)
        table = without_points(table, np.isin(table.views.row, rejected.rows))
        data, outliers = find_outliers(table, localize_frames(table, state))
        differs = rig_differs(data, state)
        if differs:
            table = unpair_cameras(table)
            data, outliers = find_outliers(table, localize_frames(table, state))
        pose, outliers = localize_frames(data, state).pose, outliers.join(rejected)
        return cls(data, pose, outliers, differs, another_target)


def valid_state(
    state: RigState, test: RigViews, trained: RigViews, another_target: bool
) -> RigState:
    """Return the state without what trained frames or their target had, and the test has not."""
    t, known = test.observations.t, trained.observations.t
    return replace(
        state,
        terms=tuple(
            term
            for term in state.terms
            if term.effect.holds_for(t, known)
            and not (another_target and term.effect.lens_field == 'target')
        ),
    )


def contiguous_blocks(data: RigViews) -> tuple[Index, list[Ends]]:
    """Return the block (F,) of each frame, and the first and the last frame of each block.

    Views of one frame that no rig holds together are in one block.
    """
    numbers, place = np.unique(data.frame_numbers, return_inverse=True)
    of_number = np.arange(len(numbers)) * BLOCKS // len(numbers)
    parts = [numbers[of_number == i] for i in range(BLOCKS)]
    return of_number[place.reshape(-1)], [
        (int(part[0]), int(part[-1])) for part in parts if len(part)
    ]


def split_frames(
    fitted: FittedModel, variances: Variances, out: Mask
) -> tuple[FactoredEquations, RandomColumns]:
    """Return the equations of all frames but some, factored, and the random columns of those.

    out (F,): the frames that are left out.  The border holds the columns of the model, each over
    its scale, and the residual.
    """
    linear, columns = fitted.linear, fitted.random.columns
    height = linear.residual.shape[1]
    row = np.arange(out.size * height).reshape(out.size, height)
    trained, tested = (
        columns._replace(
            group=columns.group[part],
            offset=columns.offset[part],
            unit=columns.unit[part],
            shared=columns.shared[row[part].ravel()],
        )
        for part in (~out, out)
    )
    border = border_of(linear, linear.shared_columns / fitted.scale)
    eq = make_equations(trained, linear.frame_columns[~out], border[~out])
    return factor_equations(eq.with_ridge(1e-9), variances.lam, variances.weight), tested


def misfits(linear: Linearization, out: Mask, rows: Array) -> Array:
    """Return sums of squares (C,), px^2, of whitened rows (F, M, C) of frames, poses refitted.

    out (F,): those frames; rows that the others cannot predict do not count.
    """
    used = predictable_rows(linear, out.astype(np.int64))[out]
    near, weight = used[..., None], linear.row_weight[out]
    left = project_out(rows * near, linear.frame_columns[out] * near)
    return np.asarray(((left[used] / weight[used][:, None]) ** 2).sum(axis=0))


def refuting_blocks(null: NullModel, fitted: FittedModel) -> dict[str, tuple[Ends, ...]]:
    """Return, by lasting effect, the contiguous thirds that the others predict worse with it.

    Nothing of few frames; random effects are not predicted.
    """
    linear, own = null.linear, null.included_columns
    lasting = [
        term for term in null.terms if not (term.effect.per_frame or term.effect.of_recording)
    ]
    block, ends = contiguous_blocks(linear.data)
    if linear.data.frames < _MIN_FRAMES or len(ends) < BLOCKS:
        return {}
    border = border_of(linear, linear.shared_columns / null.scale[own])
    models = [own, *(np.setdiff1d(own, term.columns) for term in lasting)]
    found: dict[str, tuple[Ends, ...]] = {}
    for i, edge in enumerate(ends):
        out = block == i
        information = split_frames(fitted, null.variances, out)[0].information
        predicted = np.stack([_predict(null, information, model) for model in models], axis=-1)
        whole, *without = misfits(linear, out, border[out] @ predicted)
        for term, square in zip(lasting, without, strict=True):
            if whole > _MAX_SQUARE_RATIO * square:
                found[term.name] = (*found.get(term.name, ()), edge)
    return found


def _predict(null: NullModel, information: Array, included: Index) -> Array:
    """Return the residual with some of the model's columns, fitted to other frames.

    As a combination (own + 1,) of the columns of the model and its residual.
    """
    own = null.included_columns
    at = np.append(own, len(null.scale))
    part = null.restrict_information(information, included, at)
    combination = null.residual_combination(included)[at]
    combination[included] -= np.linalg.lstsq(
        part[np.ix_(included, included)], part[included, -1], rcond=1e-13
    )[0]
    return np.asarray(combination)
