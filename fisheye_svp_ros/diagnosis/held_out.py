"""Prediction of what was held out: frames, landmarks and range bands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.diagnosis.model import (
    Data,
    Linearised,
    State,
    fit,
    flat_rows,
    is_shared,
    start_poses,
)
from fisheye_svp_ros.diagnosis.projection import Nuisance
from fisheye_svp_ros.effects.base import Effect

FRAME_FOLDS = 5
LANDMARK_FOLDS = 5
RANGE_BANDS = 3


def held_out_gain(
    data: Data, linear: Linearised, nuisance: Nuisance, free: Sequence[str], effect: Effect
) -> dict[str, float]:
    """Return by how much (whitened squares) an effect lowers the misfit of held-out data.

    Keys frames, landmarks, range_bands.  Linear in all parameters; free landmarks stay at their
    estimates, and an effect that frees them is judged by nonlinear fits on frames alone.
    """
    if not is_shared(effect):
        return {'frames': _survey_gain(data, linear.state, free, effect)}
    extra = linear.effect_columns(effect)
    frames = np.broadcast_to(frame_folds(data)[:, None], linear.residual.shape)
    both = [linear.shared_columns, np.concatenate([linear.shared_columns, extra], axis=-1)]
    before, after = (
        float((predicted_residuals(linear, columns, frames) ** 2).sum()) for columns in both
    )
    landmarks = np.unique(linear.rows.landmark, return_inverse=True)[1] % LANDMARK_FOLDS
    parts = {
        'landmarks': landmarks.reshape(linear.residual.shape), 'range_bands': _range_bands(linear)
    }
    return {'frames': before - after} | {
        name: _part_gain(linear, nuisance, effect, extra, folds) for name, folds in parts.items()
    }


def _part_gain(
    linear: Linearised, nuisance: Nuisance, effect: Effect, extra: Array, folds: Index
) -> float:
    """Predict parts of the rows (F, M) by an effect as it comes out of the other parts.

    extra: its columns (F, M, P).  All else stays as all parts together have it: a part of a frame
    leaves its pose too open, and one range the intrinsics.
    """
    used = linear.rows.used
    columns = flat_rows(nuisance.outside(extra)[used])
    residual, folds = nuisance.residual[used], folds[used]
    # What the other parts do not tell stays within a size that would be large.
    prior = np.diag([1 / parameter.large**2 for parameter in effect.parameters])
    gain = 0.0
    for fold in np.unique(folds):
        train, test, left = columns[folds != fold], columns[folds == fold], residual[folds == fold]
        values = np.linalg.solve(train.T @ train + prior, train.T @ residual[folds != fold])
        gain += float((left**2).sum() - ((left - test @ values) ** 2).sum())
    return gain


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


def predicted_residuals(linear: Linearised, columns: Array, folds: Index) -> Array:
    """Return residuals (F, M) of frames in turn held out, whitened.

    Held-out frames fit their own pose; all else, the columns (F, M, K), is fitted to the others.
    """
    predicted = np.zeros_like(linear.residual)
    stacked = np.concatenate([columns, linear.residual[..., None]], axis=-1)
    poses = linear.frame_columns
    clean = stacked - poses @ (np.linalg.pinv(poses, rcond=1e-9) @ stacked)
    # Over all frames, so that what shows in the held-out ones alone is nothing in the others.
    norms = np.maximum(np.sqrt((clean[..., :-1] ** 2).sum(axis=(0, 1))), 1e-12)
    for fold in np.unique(folds[linear.rows.used]):
        kept = folds != fold
        train, test = clean[kept & linear.rows.used], clean[~kept]
        scaled = train[:, :-1] / norms
        gram = np.linalg.pinv(scaled.T @ scaled, rcond=1e-12, hermitian=True)
        values = gram @ (scaled.T @ train[:, -1]) / norms
        predicted[~kept] = test[:, -1] - test[:, :-1] @ values
    return predicted


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
    return replace(
        data, views=data.views.take(views), frame_of=frame_of, camera_of=data.camera_of[views],
        poses=poses,
    )
