"""Contiguous blocks of the frames, each predicted from the others: a warning, no decision.

A cause that the camera has for part of the recording only, or that stands in for something else,
may make a block worse although it predicts single frames better.
"""

from __future__ import annotations

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.diagnosis.fitted_model import FittedModel
from fisheye_svp_ros.diagnosis.null_model import NullModel
from fisheye_svp_ros.mixed_model import (
    FactoredEquations,
    RandomColumns,
    Variances,
    factor_equations,
    make_equations,
)
from fisheye_svp_ros.solve.rig_state import Linearization, RigViews

BLOCKS = 3
_MIN_FRAMES = 9
_MAX_SQUARE_RATIO = 1.02  # times the sum of squares without: less is chance

Ends = tuple[int, int]  # the first and the last frame of a block


def contiguous_blocks(data: RigViews) -> tuple[Index, list[Ends]]:
    """Return the block (F,) of each frame, and the first and the last frame of each block.

    Views of one frame that no rig holds together are in one block.
    """
    first = np.unique(data.frame_of, return_index=True)[1]
    numbers, place = np.unique(data.views.frame[first], return_inverse=True)
    of_number = np.arange(len(numbers)) * BLOCKS // len(numbers)
    parts = [numbers[of_number == i] for i in range(BLOCKS)]
    return of_number[place.reshape(-1)], [
        (int(part[0]), int(part[-1])) for part in parts if len(part)]


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
    trained, tested = (columns._replace(
        group=columns.group[part], offset=columns.offset[part], unit=columns.unit[part],
        shared=columns.shared[row[part].ravel()]) for part in (~out, out))
    border = np.concatenate(
        [linear.shared_columns / fitted.scale, linear.residual[..., None]], axis=-1)
    eq = make_equations(trained, linear.frame_columns[~out], border[~out])
    return factor_equations(eq.with_ridge(1e-9), variances.lam, variances.weight), tested


def misfits(linear: Linearization, out: Mask, rows: Array) -> Array:
    """Return sums of squares (C,), px^2, of whitened rows (F, M, C) of frames, poses refitted."""
    poses, weight = linear.frame_columns[out], linear.row_weight[out]
    left = rows - poses @ (np.linalg.pinv(poses, rcond=1e-9) @ rows)
    used = weight > 0
    return np.asarray(((left[used] / weight[used][:, None]) ** 2).sum(axis=0))


def refuting_blocks(null: NullModel, fitted: FittedModel) -> dict[str, tuple[Ends, ...]]:
    """Return, by lasting effect, the contiguous thirds that the others predict worse with it.

    Nothing of few frames; random effects are not predicted.
    """
    linear, own = null.linear, null.included_columns
    lasting = [term for term in null.terms if not (term[0].per_frame or term[0].of_recording)]
    if linear.data.frames < _MIN_FRAMES or not lasting:
        return {}
    models = [own, *(np.setdiff1d(own, columns) for _, columns, _ in lasting)]
    found: dict[str, tuple[Ends, ...]] = {}
    block, ends = contiguous_blocks(linear.data)
    if len(ends) < BLOCKS:
        return {}
    for i, edge in enumerate(ends):
        out = block == i
        information = split_frames(fitted, null.variances, out)[0].information
        predicted = np.stack([_predict(null, information, model) for model in models], axis=-1)
        border = np.concatenate([linear.shared_columns[out] / null.scale[own],
                                 linear.residual[out][..., None]], axis=-1)
        whole, *without = misfits(linear, out, border @ predicted)
        for (effect, _, _), square in zip(lasting, without, strict=True):
            if whole > _MAX_SQUARE_RATIO * square:
                found[effect.name] = (*found.get(effect.name, ()), edge)
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
        part[np.ix_(included, included)], part[included, -1], rcond=1e-13)[0]
    return np.asarray(combination)
