"""The image field of the lens that is written.

The image field is what every frame shows alike in the image and no cause holds: predicted random
effects of the image, with those of frames and target beside them in the model.  It is written only
where it predicts frames that took no part: every fourth frame is left out in turn.  Contiguous
thirds that it predicts worse are a warning.  The variances stay as they are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.diagnosis.averaging import AveragedModel
from fisheye_svp_ros.diagnosis.cross_validation import (
    Ends,
    contiguous_blocks,
    misfits,
    split_frames,
)
from fisheye_svp_ros.diagnosis.effect_forms import bump_values
from fisheye_svp_ros.diagnosis.fitted_model import FittedModel
from fisheye_svp_ros.diagnosis.random_effects import ImageGrid
from fisheye_svp_ros.mixed_model import (
    Variances,
    map_in_threads,
    posterior_covariance,
    predict_rows,
    solve_equations,
)
from fisheye_svp_ros.optics.image_field import MAX_NODES, MIN_NODES, ImageField
from fisheye_svp_ros.optics.lens import Lens

FOLDS = 4  # every fourth frame
MIN_GAIN = 0.01  # of the rms of frames that are left out
_PITCH, _EDGE = 0.6, 2.0  # of the finest grid's: that of the spline, what lies around the bumps
_DIGITS = 6  # px


class CameraField(NamedTuple):
    """The field of a camera and how well it is known.

    grids: of the bumps that it is made of; root (2 Q, C): of the covariance of their coefficients,
    px, u and v of each bump in turn; shared (K, C): of that of the model's shared parameters.
    """

    field: ImageField
    grids: tuple[ImageGrid, ...]
    root: Array
    shared: Array

    def bumps_at(self, uv: Array) -> Array:
        """Return the values (N, Q) of its bumps at image points (N, 2), px."""
        every = np.ones(len(uv), dtype=bool)
        return np.concatenate(
            [bump_values(uv, every, grid.centers, grid.pitch).toarray() for grid in self.grids],
            axis=1,
        )


@dataclass(frozen=True)
class WrittenField:
    """The image fields of the cameras, by their number, and rms px of frames left out.

    before, after: without and with it; refuted: frames, first and last of each contiguous third,
    that the others predict worse with it; fields: none where it is not written.
    """

    before: float
    after: float
    refuted: tuple[Ends, ...]
    fields: Mapping[int, CameraField]

    @classmethod
    def from_model(cls, averaged: AveragedModel, fitted: FittedModel) -> WrittenField | None:
        """Return what frames left out say of the predicted field.

        None where there is nothing to predict, or several cameras have one lens.
        """
        data, lenses = fitted.linear.data, fitted.linear.state.lenses
        if not fitted.random.grids or data.frames < 2 * FOLDS or data.cameras > len(lenses):
            return None
        variances, order = averaged.posterior.null.variances, np.arange(data.frames)
        squares = _hold_out(fitted, variances, order % FOLDS)
        before, after = np.sqrt(2 * squares.sum(axis=0) / fitted.linear.row_mask.sum()).tolist()
        if not after < (1 - MIN_GAIN) * before:
            return cls(before, after, (), {})
        block, ends = contiguous_blocks(data)
        squares = _hold_out(fitted, variances, block)
        refuted = tuple(
            edge
            for edge, (without, with_field) in zip(ends, squares, strict=True)
            if with_field > without
        )
        return cls(before, after, refuted, _fields(averaged, fitted))

    def add_to(self, lens: Lens, camera: int) -> Lens:
        """Return the lens of a camera with its field."""
        known = self.fields.get(camera)
        return lens if known is None else replace(lens, image_field=known.field)

    def to_dict(self) -> dict[str, Any]:
        """Return what diagnosis.json holds."""
        return {
            'written': bool(self.fields),
            'without_px': self.before,
            'with_px': self.after,
            'refuted_by_frames': [list(ends) for ends in self.refuted],
            'rms_px': max((camera.field.rms for camera in self.fields.values()), default=0.0),
        }


def _hold_out(fitted: FittedModel, variances: Variances, fold: Index) -> Array:
    """Return squares (K, 2), px^2, of each fold of the frames, as the other folds predict them.

    Without the field and with it; poses are fitted to the frames, the target is as predicted.
    fold (F,): that of each frame.
    """
    linear = fitted.linear

    def hold_out(out: Mask) -> Array:
        whole, field = _predict(fitted, variances, out)
        left = linear.residual[out] - whole
        return misfits(linear, out, np.stack([left + field, left], axis=-1))

    folds = np.arange(int(fold.max()) + 1)
    products = len(folds) * fitted.factored.products
    return np.array(map_in_threads(lambda k: hold_out(fold == k), folds, products))


def _predict(fitted: FittedModel, variances: Variances, out: Mask) -> tuple[Array, Array]:
    """Return what the other frames predict of the rows (F, M) of some, and the field's part."""
    linear = fitted.linear
    kept, tested = split_frames(fitted, variances, out)
    solution = solve_equations(kept)
    _, unit, shared = kept.equations.split(solution.e[..., None], solution.r[:, None])
    group = np.zeros((int(out.sum()), 6 + tested.group.shape[2], 1))
    of_field = (np.arange(len(shared)) < fitted.random.grid_columns)[:, None]
    whole, field = (
        predict_rows(
            tested, linear.frame_columns[out], group, offsets, values, kept.equations.units
        )[..., 0]
        for offsets, values in (
            (unit, shared),
            (np.zeros_like(unit), np.where(of_field, shared, 0.0)),
        )
    )
    fixed = linear.shared_columns[out] @ (solution.values / fitted.scale)
    return whole + fixed, field


def _fields(averaged: AveragedModel, fitted: FittedModel) -> dict[int, CameraField]:
    """Return the predicted field of each camera, with what its lens has already."""
    random, sigma = fitted.random, averaged.posterior.null.variances.sigma
    values = _shared_coefficients(averaged)
    posterior = posterior_covariance(fitted.factored)
    count = fitted.solution.e.size
    root = (
        sigma
        * fitted.factored.equations.split(
            posterior.root[:count].reshape(*fitted.solution.e.shape, -1), posterior.root[count:]
        )[2]
    )
    shared = sigma * posterior.shared / fitted.scale[:, None]
    fields, camera_of = (
        {},
        np.concatenate([np.full(2 * len(grid.centers), grid.camera) for grid in random.grids]),
    )
    for camera in np.unique(camera_of).tolist():
        grids = tuple(grid for grid in random.grids if grid.camera == camera)
        mine = np.flatnonzero(camera_of == camera)
        known = fitted.linear.state.lenses[camera].image_field
        fields[camera] = CameraField(
            _field(grids, values[mine], root[mine], known), grids, root[mine], shared
        )
    return fields


def _shared_coefficients(averaged: AveragedModel) -> Array:
    """Return the shared random coefficients (Q,) beside the mean of all models."""
    null = averaged.posterior.null
    e, r = null.factorization.coefficients(averaged.combination)
    return null.equations.split(e, r)[2]


def _field(
    grids: Sequence[ImageGrid], values: Array, root: Array, known: ImageField | None
) -> ImageField:
    """Return the field of bumps: coefficients (2 Q,), root of covariance; known: added to it."""
    finest = min(grid.pitch for grid in grids)
    low = np.min([grid.centers.min(axis=0) - _EDGE * grid.pitch for grid in grids], axis=0)
    high = np.max([grid.centers.max(axis=0) + _EDGE * grid.pitch for grid in grids], axis=0)
    if known is not None:
        low, high = np.minimum(low, known.nodes[0, 0]), np.maximum(high, known.nodes[-1, -1])
    low = np.round(low)
    columns, rows = (np.ceil((high - low) / (_PITCH * finest)).astype(int) + 1).clip(
        MIN_NODES, MAX_NODES
    )
    pitch = np.full(2, round(_PITCH * finest, _DIGITS))
    nodes = ImageField(low, pitch, np.zeros((rows, columns, 2))).nodes
    bumps = sparse.hstack(
        [
            bump_values(nodes, np.ones(nodes.shape[:2], dtype=bool), grid.centers, grid.pitch)
            for grid in grids
        ],
        format='csr',
    )
    there = (bumps @ values.reshape(-1, 2)).reshape(nodes.shape)
    spread = (bumps @ root.reshape(bumps.shape[1], -1)).reshape(rows, columns, 2, -1)
    if known is not None:
        there = there + known.displacement(nodes)
    stderr = np.sqrt((spread**2).sum(axis=-1).mean(axis=-1))
    field = ImageField.interpolate(low, pitch, there, np.round(stderr, _DIGITS))
    return replace(field, values=np.round(field.values, _DIGITS))
