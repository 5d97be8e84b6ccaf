"""Residuals of frames that were not used: poses are fitted to them, all else is predicted."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.diagnosis.adjustment import fit, fit_poses, moved
from fisheye_svp_ros.diagnosis.evidence import Evidence, pseudo_inverse
from fisheye_svp_ros.diagnosis.model import Data, Linearised, State
from fisheye_svp_ros.diagnosis.refit import Local, refit

_RESAMPLES = 2000
_FAR = 5.0  # times the median frame
_LINEAR = 3.0  # px rms: how far a step that is taken to be linear may move image points


class HeldOut(NamedTuple):
    """Misfit of held-out frames: sums (F,) of squared 2-D residuals, px^2, and counts (F,)."""

    squares: Array
    counts: Array

    @property
    def rms(self) -> float:
        """Root mean square of the 2-D residual norm, px."""
        return float(self.rms_of(np.arange(len(self.squares))))

    @property
    def predicted(self) -> Mask:
        """Which frames (F,) are not far worse than most: those show what no other frame does."""
        size = np.sqrt(self.squares / self.counts)
        return np.asarray(size <= _FAR * np.median(size))

    def take(self, rows: Index | Mask) -> HeldOut:
        """Return some of the frames."""
        return HeldOut(self.squares[rows], self.counts[rows])

    def rms_of(self, rows: Index) -> Array:
        """Return the rms (...), px, of the frames (..., F) that count."""
        return np.asarray(
            np.sqrt(self.squares[rows].sum(axis=-1) / self.counts[rows].sum(axis=-1)))

    def excess(self, noise: float, rows: Index) -> Array:
        """Mean squares (B,) above what noise leaves once each frame has fitted its pose, px^2.

        rows: the frames (B, F) that count.
        """
        squares, counts = self.squares[rows].sum(axis=1), self.counts[rows].sum(axis=1)
        freedom = 2 * counts - 6 * rows.shape[1]
        return np.asarray((squares - noise**2 * freedom) / counts)


class Gain(NamedTuple):
    """1 - (held-out misfit above noise after) / (before), and its 95 % interval over frames."""

    value: float
    low: float
    high: float


class Less(NamedTuple):
    """By how much an rms is less, px, and its 95 % interval over frames."""

    value: float
    low: float
    high: float


def less_between(before: HeldOut, after: HeldOut) -> Less:
    """Return by how much the rms is less, with a bootstrap interval over frames."""
    rows = _resampled(before)
    low, high = np.quantile(before.rms_of(rows) - after.rms_of(rows), (0.025, 0.975))
    return Less(before.rms - after.rms, float(low), float(high))


def _resampled(held_out: HeldOut) -> Index:
    frames = len(held_out.squares)
    return np.random.default_rng(0).integers(0, frames, (_RESAMPLES, frames))


def gain_between(before: HeldOut, after: HeldOut, noise: float) -> Gain:
    """Return the gain with a bootstrap interval over frames."""
    rows = _resampled(before)
    low, high = np.quantile(_ratio(before, after, noise, rows), (0.025, 0.975))
    whole = np.arange(len(before.squares))[None]
    return Gain(float(_ratio(before, after, noise, whole)[0]), float(low), float(high))


def _ratio(before: HeldOut, after: HeldOut, noise: float, rows: Index) -> Array:
    base = before.excess(noise, rows)
    # With nothing above the noise there is nothing to gain.
    some = base > 1e-3 * noise**2
    gain = 1 - after.excess(noise, rows) / np.where(some, base, 1.0)
    return np.where(some, np.clip(gain, -1.0, 1.0), 0.0)


def on_other_data(test: Data, state: State, local: Local | None = None) -> HeldOut:
    """Predict other frames of the same camera and target, from poses in the state."""
    # In px every point counts alike, however noisy it is.
    plain = replace(state, terms=tuple(t for t in state.terms if t[0].stage != 'noise'))
    data = test if local is None else local.applied(test)
    fitted = fit_poses(data, plain)
    if local is not None and local.views is not None:
        repeated = local.views.at(Linearised(data, replace(fitted, terms=state.terms), ()))
        data = replace(data, views=data.views._replace(uv=data.views.uv - repeated))
        fitted = fit_poses(data, fitted)
    linear = Linearised(data, fitted, ())
    return _figures(linear, linear.residual)


def without_causes(evidence: Evidence, names: Sequence[str], free: Sequence[str]) -> State:
    """Return the state without some of its effects, the rest fitted anew.

    By one linear step; where that is too long to be linear, step by step.
    """
    linear = evidence.linear
    kept, change, _ = _refitted(evidence, evidence.information, names, ())
    shared = np.zeros(evidence.own)
    shared[kept] = change
    moves = (linear.shared_columns @ shared)[linear.used] / linear.row_weight[linear.used]
    if np.sqrt(2 * np.mean(moves**2)) > _LINEAR:
        state = fit(linear.data, linear.state.without(names), free)
        return refit(linear.data, state, free, evidence.variances)
    frame = np.zeros((linear.data.frames, 6))
    return moved(linear.data, linear.state, free, frame, shared).without(names)


def _refitted(
    evidence: Evidence, information: Array, names: Collection[str], held: Collection[str]
) -> tuple[Index, Array, Array]:
    """Return the columns that are fitted, their change, and (m,) what is left.

    information (m, m): of what is in the model and, last, the residual; more columns are left
    alone.  names: causes that are gone; held: causes that stay as they are.  The last is the
    combination of the border that is the residual then.
    """
    gone = np.zeros(evidence.own, dtype=bool)
    values = np.zeros(evidence.own)
    for effect, columns, value in evidence.terms:
        if effect.name in names:
            gone[columns], values[columns] = True, value
        elif effect.name in held:
            gone[columns] = True
    way = np.zeros(len(information))
    way[-1] = 1.0
    # Without an effect its displacement comes back into the residual.
    way[: evidence.own] += np.where(gone, values * evidence.scale[: evidence.own], 0.0)
    kept = np.flatnonzero(~gone)
    inverse, _ = pseudo_inverse(information[np.ix_(kept, kept)], 1e-13)
    change = inverse @ (information[kept] @ way)
    way[kept] -= change
    return kept, change / evidence.scale[kept], way


def frames_in_turn(
    evidence: Evidence, without: Collection[str] = (), local: Local | None = None,
    held: Collection[str] = (),
) -> HeldOut:
    """Predict frames left out in turn by a fit to the others (linear in all parameters).

    without: causes that are left out; local: offsets to predict, each frame's from the others;
    held: causes that are not fitted anew.
    """
    linear, even = evidence.linear, _evenly(evidence.linear)
    residual = np.zeros_like(linear.residual)
    repeated = np.zeros_like(residual)
    if local is not None and local.views is not None:
        repeated = linear.data.blocks(local.views.own * linear.data.views.weight[..., None])
    at = evidence.with_residual(np.arange(evidence.own))
    for frame, information in enumerate(evidence.in_turn(at)):
        _, _, way = _refitted(evidence, information, without, held)
        rows = evidence.border if local is None else evidence.left_out.rows
        left, poses = rows[frame][:, at] @ way * even[frame], linear.frame_columns[frame]
        left -= repeated[frame]
        poses = poses * even[frame][:, None]
        residual[frame] = left - poses @ (np.linalg.pinv(poses, rcond=1e-9) @ left)
    return _figures(linear, residual / even)


def _evenly(linear: Linearised) -> Array:
    """Return what takes the weights (F, M) of uneven noise out of whitened rows."""
    weight = linear.data.blocks(linear.data.views.weight[..., None] * np.ones(2))
    own = linear.row_weight
    return np.where(own > 0, weight / np.maximum(own, 1e-300), 1.0)


def _figures(linear: Linearised, whitened: Array) -> HeldOut:
    weight = linear.row_weight
    px = np.where(weight > 0, whitened / np.maximum(weight, 1e-12), 0.0)
    return HeldOut((px**2).sum(axis=1), (weight > 0).sum(axis=1) / 2)
