"""Measured views: which of them can be posed, where they are, how noisy they are."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import GeometryError, ObservationError
from fisheye_svp_ros.scene.observations import Observations, Views, group_views
from fisheye_svp_ros.solve.localization import MIN_POINTS, Localization, localize
from fisheye_svp_ros.solve.reliability import examine

_LINE = 1e-6  # width of a point set relative to its length, below which it is a line


class MeasuredPoses(NamedTuple):
    """The views of a table that can be posed, and their poses.

    result: covariances for the noise of the data; sigma: noise of u and of v, px, estimated from
    the residuals, None where the observations bring their own; left_out: frames whose points do
    not fix a pose; gross (V, N): observations left out as gross errors; reasons (V,): why a pose
    should not be relied on, '' where nothing speaks against it.
    """

    views: Views
    result: Localization
    sigma: float | None
    left_out: tuple[int, ...]
    gross: Mask
    reasons: tuple[str, ...]

    @property
    def inlier_residual(self) -> Array:
        """Residuals (V, N, 2), px, without those of gross errors."""
        return np.where(self.gross[..., None], np.nan, self.result.residual)


def localize_measured(model: ForwardModel, observations: Observations) -> MeasuredPoses:
    """Pose every frame of one camera's table that can be posed.

    Raises ObservationError for rows of several cameras, GeometryError where no frame can be posed.
    """
    views, left_out = posable_views(observations, model)
    checked = examine(model, views, localize(model, views), sigma_known(observations))
    result, gross, reasons = checked.result, checked.gross, checked.reasons
    fixed = result.converged
    if not fixed.all():
        left_out = tuple(sorted((*left_out, *views.frame[~fixed].tolist())))
        views, result, gross = views.take(fixed), result.take(fixed), gross[fixed]
        reasons = tuple(np.array(reasons, dtype=object)[fixed])
    if not len(views.frame):
        raise GeometryError(f'{observations.source}: the points of no frame fix a pose')
    return MeasuredPoses(views, result, checked.sigma, left_out, gross, reasons)


def posable_views(
    observations: Observations, model: ForwardModel | None = None
) -> tuple[Views, tuple[int, ...]]:
    """Group one camera's table into views; return those that fix a pose, and the other frames.

    A pose needs MIN_POINTS points that are not on one line, inside the field of view of the model
    if one is given.
    Raises ObservationError for rows of several cameras, GeometryError where no frame is left.
    """
    cameras = np.unique(observations.camera)
    if len(cameras) > 1:
        names = ', '.join(observations.cameras[i] for i in cameras)
        raise ObservationError(
            f'{observations.source}: it holds the cameras {names}; keep the rows of one of them'
        )
    views = group_views(observations)
    usable = views.used if model is None else views.used & model.back_project(views.uv).valid
    count = usable.sum(axis=1)
    inside = usable[..., None]
    centre = (views.points * inside).sum(axis=1) / np.maximum(count, 1)[:, None]
    centred = np.where(inside, views.points - centre[:, None], 0.0)
    extent = np.linalg.eigvalsh(np.swapaxes(centred, -1, -2) @ centred)
    posable = (count >= MIN_POINTS) & (extent[:, 1] > _LINE**2 * extent[:, 2])
    if not posable.any():
        where = '' if model is None else f', inside the field of view of lens {model.lens.name!r}'
        raise GeometryError(
            f'{observations.source}: no frame can be posed; each needs {MIN_POINTS} points that '
            f'are not on one line{where}'
        )
    return views.take(posable), tuple(views.frame[~posable].tolist())


def sigma_known(observations: Observations) -> bool:
    """Say whether every row brings the noise it was measured with."""
    return not np.isnan(observations.sigma).any()


def rms_px(residual: Array) -> float:
    """Return the root mean square of the 2-D norm of residuals (..., 2), px, NaN left out."""
    norm2 = (residual**2).sum(axis=-1)
    return float(np.sqrt(norm2[np.isfinite(norm2)].mean()))
