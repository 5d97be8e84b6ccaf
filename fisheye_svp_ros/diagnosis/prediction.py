"""Residuals of frames that were not used: poses are fitted to them, all else is predicted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.evidence import Evidence, frame_folds, pseudo_inverse
from fisheye_svp_ros.diagnosis.model import Data, Linearised, State, fit_poses, moved
from fisheye_svp_ros.diagnosis.refit import Local

_RESAMPLES = 2000


class HeldOut(NamedTuple):
    """Misfit of held-out frames: sums (F,) of squared 2-D residuals, px^2, and counts (F,)."""

    squares: Array
    counts: Array

    @property
    def rms(self) -> float:
        """Root mean square of the 2-D residual norm, px."""
        return float(np.sqrt(self.squares.sum() / self.counts.sum()))

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


def gain_between(before: HeldOut, after: HeldOut, noise: float) -> Gain:
    """Return the gain with a bootstrap interval over frames."""
    rng = np.random.default_rng(0)
    rows = rng.integers(0, len(before.squares), (_RESAMPLES, len(before.squares)))
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
    data = test if local is None else local.applied(test)
    # In px every point counts alike, however noisy it is.
    plain = replace(state, terms=tuple(t for t in state.terms if t[0].stage != 'noise'))
    linear = Linearised(data, fit_poses(data, plain), ())
    return _figures(linear, linear.residual)


def without_causes(evidence: Evidence, names: Sequence[str], free: Sequence[str]) -> State:
    """Return the state without some of its effects, the rest fitted anew (one linear step)."""
    linear = evidence.linear
    kept, change, _ = _refitted(evidence, evidence.factored.information, names)
    shared = np.zeros(evidence.own)
    shared[kept] = change
    state = linear.state
    frame = np.zeros((linear.data.frames, 6))
    state = moved(linear.data, state, free, frame, shared)
    return replace(state, terms=tuple(t for t in state.terms if t[0].name not in names))


def _refitted(
    evidence: Evidence, information: Array, names: Sequence[str]
) -> tuple[Index, Array, Array]:
    """Return the columns that stay without some causes, their change, and (X + 1,) what is left.

    The last is the combination of the border that is the residual once the causes are gone.
    """
    gone = np.zeros(evidence.own, dtype=bool)
    values = np.zeros(evidence.own)
    for name, columns, value in placed_terms(evidence):
        if name in names:
            gone[columns], values[columns] = True, value
    way = np.zeros(len(information))
    way[-1] = 1.0
    # Without an effect its displacement comes back into the residual.
    way[: evidence.own] += np.where(gone, values * evidence.scale[: evidence.own], 0.0)
    kept = np.flatnonzero(~gone)
    inverse, _ = pseudo_inverse(information[np.ix_(kept, kept)], 1e-13)
    change = inverse @ (information[kept] @ way)
    way[kept] -= change
    return kept, change / evidence.scale[kept], way


def placed_terms(evidence: Evidence) -> list[tuple[str, Index, Array]]:
    """Return name, columns among what is shared, and values of each effect in the model."""
    terms = [t for t in evidence.linear.state.terms if t[0].stage != 'noise']
    start = evidence.own - sum(len(values) for _, values in terms)
    placed = []
    for effect, values in terms:
        placed.append((effect.name, np.arange(start, start + len(values)), values))
        start += len(values)
    return placed


def frames_in_turn(
    evidence: Evidence, without: Sequence[str] = (), local: bool = False
) -> HeldOut:
    """Predict frames left out in turn by a fit to the others (linear in all parameters)."""
    linear, part = evidence.linear, frame_folds(evidence.linear.data.frames)
    residual = np.zeros_like(linear.residual)
    for fold, f in enumerate(evidence.folds):
        mine = np.flatnonzero(part == fold)
        _, _, way = _refitted(evidence, f.information, without)
        left = evidence.border[mine] @ way
        if local:
            left = left - _local_rows(evidence, *f.coefficients(way), mine)
        even = _evenly(linear)[mine]
        left, poses = left * even, linear.frame_columns[mine] * even[..., None]
        fitted = np.linalg.pinv(poses, rcond=1e-9) @ left[..., None]
        residual[mine] = (left - (poses @ fitted)[..., 0]) / even
    return _figures(linear, residual)


def _evenly(linear: Linearised) -> Array:
    """Return what takes the weights (F, M) of uneven noise out of whitened rows."""
    weight, own = (linear.data.blocks(w[..., None] * np.ones(2))
                   for w in (linear.data.views.weight, linear.weight))
    return np.where(own > 0, weight / np.maximum(own, 1e-300), 1.0)


def _local_rows(evidence: Evidence, e: Array, r: Array, frames: Index) -> Array:
    """Return what offsets of landmarks and of the image do in some frames (f, M), whitened."""
    eq = evidence.equations
    random = evidence.design.kept(evidence.variances.alive)
    _, landmark, shared = eq.sorted(e, r)
    offset = np.zeros((len(random.landmark) + 1, 3))
    offset[eq.landmarks] = np.where(random.landmark_label[eq.landmarks] >= 0, landmark, 0.0)
    rows = (random.place[frames] @ offset[random.slot[frames]][..., None])[..., 0]
    height = evidence.linear.residual.shape[1]
    everywhere = (random.shared @ shared).reshape(-1, height)
    return np.asarray(rows.reshape(len(frames), height) + everywhere[frames])


def _figures(linear: Linearised, whitened: Array) -> HeldOut:
    weight = linear.data.blocks(linear.weight[..., None] * np.ones(2))
    px = np.where(weight > 0, whitened / np.maximum(weight, 1e-12), 0.0)
    return HeldOut((px**2).sum(axis=1), (weight > 0).sum(axis=1) / 2)
