"""The gain on data that was not used to find it, with an interval clustered by frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.diagnosis.held_out import frame_folds, predicted_residuals, splits
from fisheye_svp_ros.diagnosis.model import Data, Linearised, State, fit, start_poses, survey_of

_RESAMPLES = 2000


class HeldOut(NamedTuple):
    """Misfit of held-out frames: sums (F,) of squared 2-D residuals, px^2, and counts (F,)."""

    squares: Array
    counts: Array
    frames: int

    @property
    def rms(self) -> float:
        """Root mean square of the 2-D residual norm, px."""
        return float(np.sqrt(self.squares.sum() / self.counts.sum()))

    def excess(self, noise: float) -> float:
        """Mean square above what noise alone leaves once each frame has fitted its pose, px^2."""
        freedom = 2 * self.counts.sum() - 6 * self.frames
        return float((self.squares.sum() - noise**2 * freedom) / self.counts.sum())


class Gain(NamedTuple):
    """1 - (held-out misfit above noise after) / (before), and its 95 % interval."""

    value: float
    low: float
    high: float


def held_out(data: Data, state: State, free: Sequence[str], test: Data | None) -> HeldOut:
    """Predict other frames (`test`), or frames of the same table in turn, after a fit."""
    if test is not None:
        return _figures(test, Linearised(test, start_poses(test, state), ()).residual)
    linear = Linearised(data, state, free)
    if survey_of(state.terms) is None:
        folds = np.broadcast_to(frame_folds(data)[:, None], linear.residual.shape)
        return _figures(data, predicted_residuals(linear, linear.shared_columns, folds))
    parts = [
        _figures(other, Linearised(other, start_poses(other, trained), ()).residual)
        for trained, other in (
            (fit(train, part, free), other) for part, train, other in splits(data, state, 3)
        )
    ]
    squares, counts = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
    return HeldOut(squares, counts, data.frames)


def gain_between(before: HeldOut, after: HeldOut, noise: float) -> Gain:
    """Return the gain with a bootstrap interval over frames."""
    rng = np.random.default_rng(0)
    rows = rng.integers(0, len(before.squares), (_RESAMPLES, len(before.squares)))
    ratios = [
        _ratio(_resampled(before, row), _resampled(after, row), noise) for row in rows
    ]
    low, high = np.quantile(ratios, (0.025, 0.975))
    return Gain(_ratio(before, after, noise), float(low), float(high))


def _ratio(before: HeldOut, after: HeldOut, noise: float) -> float:
    base = before.excess(noise)
    # With nothing above the noise there is nothing to gain.
    if base <= 1e-3 * noise**2:
        return 0.0
    return float(np.clip(1 - after.excess(noise) / base, -1.0, 1.0))


def _resampled(part: HeldOut, rows: Array) -> HeldOut:
    return HeldOut(part.squares[rows], part.counts[rows], part.frames)


def _figures(data: Data, whitened: Array) -> HeldOut:
    weight = data.blocks(data.views.weight[..., None] * np.ones(2))
    px = np.where(weight > 0, whitened / np.maximum(weight, 1e-12), 0.0)
    counts = (weight > 0).sum(axis=1) / 2
    return HeldOut((px**2).sum(axis=1), counts, data.frames)
