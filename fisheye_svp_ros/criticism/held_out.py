"""Prediction of what was held out: frames, landmarks and range bands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.criticism.model import Data, Linearised, State, fit, is_shared, start_poses
from fisheye_svp_ros.effects.base import Effect

FRAME_FOLDS = 5
LANDMARK_FOLDS = 5
RANGE_BANDS = 3


def held_out_gain(
    data: Data, linear: Linearised, free: Sequence[str], effect: Effect
) -> dict[str, float]:
    """Return by how much (whitened squares) an effect lowers the misfit of held-out data.

    Keys frames, landmarks, range_bands.  Linear in all parameters; free landmarks stay at their
    estimates, and an effect that frees them is judged by nonlinear fits on frames alone.
    """
    if not is_shared(effect):
        return {'frames': _survey_gain(data, linear.state, free, effect)}
    extra = linear.effect_columns(effect)
    frames = np.broadcast_to(frame_folds(data)[:, None], linear.residual.shape)
    landmarks = np.unique(linear.rows.landmark, return_inverse=True)[1] % LANDMARK_FOLDS
    both = [linear.shared_columns, np.concatenate([linear.shared_columns, extra], axis=-1)]
    gains = {}
    for name, folds, whole_frames in (
        ('frames', frames, True),
        ('landmarks', landmarks.reshape(frames.shape), False),
        ('range_bands', _range_bands(linear), False),
    ):
        before, after = (
            float((predicted_residuals(linear, columns, folds, whole_frames) ** 2).sum())
            for columns in both
        )
        gains[name] = before - after
    return gains


def frame_folds(data: Data) -> Index:
    """Return the fold (F,) of each frame."""
    return np.asarray(np.arange(data.frames) % min(FRAME_FOLDS, data.frames))


def _range_bands(linear: Linearised) -> Index:
    distance = np.linalg.norm(
        linear.scene.pose.into_body(linear.data.views.points), axis=-1
    )
    blocks = linear.data.blocks(distance[..., None] * np.ones(2))
    edges = np.quantile(blocks[linear.rows.used], np.arange(1, RANGE_BANDS) / RANGE_BANDS)
    return np.searchsorted(edges, blocks)


def predicted_residuals(
    linear: Linearised, columns: Array, folds: Index, whole_frames: bool
) -> Array:
    """Return residuals (F, M) of rows in turn held out, the rest fitted, whitened.

    whole_frames: held-out frames fit their own pose (all else fixed); otherwise every frame's
    pose comes from the rows that were kept.
    """
    predicted = np.zeros_like(linear.residual)
    stacked = np.concatenate([columns, linear.residual[..., None]], axis=-1)
    clean = _less_poses(linear, stacked, np.ones(folds.shape, dtype=bool))
    for fold in np.unique(folds[linear.rows.used]):
        kept = folds != fold
        if not whole_frames:
            clean = _less_poses(linear, stacked, kept)
        train, test = clean[kept & linear.rows.used], clean[~kept]
        norms = np.maximum(np.sqrt((train[:, :-1] ** 2).sum(axis=0)), 1e-12)
        scaled = train[:, :-1] / norms
        gram = np.linalg.pinv(scaled.T @ scaled, rcond=1e-12, hermitian=True)
        values = gram @ (scaled.T @ train[:, -1]) / norms
        predicted[~kept] = test[:, -1] - test[:, :-1] @ values
    return predicted


def _less_poses(linear: Linearised, columns: Array, kept: Mask) -> Array:
    poses = linear.frame_columns
    inverse = np.linalg.pinv(poses * kept[..., None], rcond=1e-9)
    return np.asarray(columns - poses @ (inverse @ (columns * kept[..., None])))


def misfit(test: Data, trained: State) -> float:
    """Whitened misfit of other frames: their poses are fitted, all else is as trained."""
    return float((Linearised(test, start_poses(test, trained), ()).residual ** 2).sum())


def splits(data: Data, state: State, count: int) -> list[tuple[State, Data, Data]]:
    """Return, for frames held out in turn, the state of the others, the others, the held out."""
    folds = np.arange(data.frames) % min(count, data.frames)
    parts = []
    for fold in range(int(folds.max()) + 1):
        kept = np.flatnonzero(folds != fold)
        part = replace(state, pose=state.pose.take(kept))
        parts.append((part, _chosen(data, folds != fold), _chosen(data, folds == fold)))
    return parts


def _survey_gain(data: Data, state: State, free: Sequence[str], effect: Effect) -> float:
    gain = 0.0
    for part, train, test in splits(data, state, 3):
        term = (effect, np.zeros(len(effect.parameters)))
        extended = replace(part, terms=(*part.terms, term))
        gain += misfit(test, fit(train, part, free)) - misfit(test, fit(train, extended, free))
    return gain


def _chosen(data: Data, frames: Mask) -> Data:
    views = frames[data.frame_of]
    frame_of = np.unique(data.frame_of[views], return_inverse=True)[1].reshape(-1)
    poses = None if data.poses is None else data.poses.take(frames)
    return Data(
        data.observations, data.views.take(views), frame_of, data.camera_of[views], poses
    )
