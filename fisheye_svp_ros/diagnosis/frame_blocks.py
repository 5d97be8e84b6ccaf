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
_WORSE = 1.02  # times the sum of squares without: less is chance

Ends = tuple[int, int]  # the first and the last frame of a block


def contiguous_blocks(data: RigViews) -> tuple[Index, list[Ends]]:
    """Return the block (F,) of each frame, and the first and the last frame of each block."""
    block = np.arange(data.frames) * BLOCKS // data.frames
    numbers = np.unique(data.views.frame)
    parts = [numbers[block == i] for i in range(BLOCKS)]
    return block, [(int(part[0]), int(part[-1])) for part in parts if len(part)]


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


def misfit(linear: Linearization, out: Mask, rows: Array) -> float:
    """Return the sum of squares, px^2, of whitened rows (F, M) of some frames, poses refitted."""
    poses, weight = linear.frame_columns[out], linear.row_weight[out]
    fitted = poses @ (np.linalg.pinv(poses, rcond=1e-9) @ rows[..., None])
    left = rows - fitted[..., 0]
    return float(((left[weight > 0] / weight[weight > 0]) ** 2).sum())


def refuting_blocks(null: NullModel, fitted: FittedModel) -> dict[str, tuple[Ends, ...]]:
    """Return, by lasting effect, the contiguous thirds that the others predict worse with it.

    Nothing of few frames; random effects are not predicted.
    """
    linear, own = null.linear, null.included_columns
    lasting = [term for term in null.terms if not (term[0].per_frame or term[0].of_recording)]
    if linear.data.frames < _MIN_FRAMES or not lasting:
        return {}
    found: dict[str, tuple[Ends, ...]] = {}
    block, ends = contiguous_blocks(linear.data)
    at = np.append(own, len(null.scale))
    for i, edge in enumerate(ends):
        out = block == i
        information = split_frames(fitted, null.variances, out)[0].information

        def predict(included: Index, information: Array = information, out: Mask = out) -> float:
            part = null.restrict_information(information, included, at)
            change = np.zeros(len(own))
            change[included] = np.linalg.lstsq(
                part[np.ix_(included, included)], part[included, -1], rcond=1e-13)[0]
            combination = null.residual_combination(included)[at]
            combination[:-1] -= change
            border = np.concatenate([linear.shared_columns[out] / null.scale[own],
                                     linear.residual[out][..., None]], axis=-1)
            return misfit(linear, out, border @ combination)

        whole = predict(own)
        for effect, columns, _ in lasting:
            if whole > _WORSE * predict(np.setdiff1d(own, columns)):
                found[effect.name] = (*found.get(effect.name, ()), edge)
    return found
