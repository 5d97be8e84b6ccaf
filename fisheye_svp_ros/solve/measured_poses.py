"""Measured views: which of them can be posed, and by which lenses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import GeometryError, ObservationError
from fisheye_svp_ros.optics.lens import Lens, inside_image
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Observations, Views, group_views
from fisheye_svp_ros.scene.table_checks import remove_copies
from fisheye_svp_ros.solve.localization import MIN_POINTS

_OUTSIDE_SHARE = 0.02  # of the points of a camera: more than single outliers
_LINE = 1e-6  # width of a point set relative to its length, below which it is a line


def posable_views(
    observations: Observations, model: ForwardModel | None = None, right: Mask | None = None
) -> tuple[Views, tuple[int, ...]]:
    """Group one camera's table into views; return those that fix a pose, and the other frames.

    A pose needs MIN_POINTS points that are not on one line, inside the field of view of the model
    if one is given.  right: the rows that count; the others are without weight in the views.
    Raises ObservationError for rows of several cameras, GeometryError where no frame is left.
    """
    cameras = np.unique(observations.camera)
    if len(cameras) > 1:
        names = ', '.join(observations.cameras[i] for i in cameras)
        raise ObservationError(
            f'{observations.source}: it holds the cameras {names}; keep the rows of one of them'
        )
    views = group_views(observations)
    if right is not None:
        counts = views.used & right[views.row]
        views = views._replace(weight=np.where(counts, views.weight, 0.0))
    return take_posable(views, observations.source, model)


def take_posable(
    views: Views, source: str, model: ForwardModel | None = None
) -> tuple[Views, tuple[int, ...]]:
    """Return the views that fix a pose, and the frames of the others; see `posable_views`."""
    posable = _fix_poses(views, model)
    if not posable.any():
        where = '' if model is None else f', inside the field of view of lens {model.lens.name!r}'
        raise GeometryError(
            f'{source}: no frame can be posed; each needs {MIN_POINTS} points that '
            f'are not on one line{where}'
        )
    return views.take(posable), tuple(views.frame[~posable].tolist())


def _fix_poses(views: Views, model: ForwardModel | None = None) -> Mask:
    """Say which views (S,) have MIN_POINTS points that count, not on one line, and in sight."""
    usable = views.weight > 0
    usable = usable if model is None else usable & model.back_project(views.uv).valid
    count = usable.sum(axis=1)
    inside = usable[..., None]
    center = (views.points * inside).sum(axis=1) / np.maximum(count, 1)[:, None]
    centerd = np.where(inside, views.points - center[:, None], 0.0)
    extent = np.linalg.eigvalsh(np.swapaxes(centerd, -1, -2) @ centerd)
    return np.asarray((count >= MIN_POINTS) & (extent[:, 1] > _LINE**2 * extent[:, 2]))


def sigma_known(observations: Observations) -> bool:
    """Say whether every row brings the noise it was measured with."""
    return not np.isnan(observations.sigma).any()


def rms_px(residual: Array) -> float:
    """Return the root mean square of the 2-D norm of residuals (..., 2), px, NaN left out."""
    norm2 = (residual**2).sum(axis=-1)
    return float(np.sqrt(norm2[np.isfinite(norm2)].mean()))


def rig_lenses(observations: Observations, lens: Lens | Mapping[str, Lens]) -> dict[str, Lens]:
    """Return the lens of each camera by name, or the one of all under ''.

    Raises ObservationError for a camera of the observations without a lens.
    """
    if isinstance(lens, Lens):
        return {'': lens}
    missing = [name for name in observations.cameras if name not in lens]
    if missing:
        raise ObservationError(f'{observations.source}: camera {missing[0]!r} has no lens')
    return {name: lens[name] for name in observations.cameras}


class UsableObservations(NamedTuple):
    """The rows that a diagnosis is asked about; the frames that have others, for either reason."""

    observations: Observations
    not_posable: tuple[int, ...]
    copies: tuple[int, ...]


def usable_observations(
    observations: Observations, lens: Lens | Mapping[str, Lens]
) -> UsableObservations:
    """Return the views that fix a pose and repeat no earlier frame; raise what either does."""
    posable, left_out = posable_observations(observations, lens)
    distinct, copies = remove_copies(posable)
    return UsableObservations(distinct, left_out, copies)


def posable_observations(
    observations: Observations, lens: Lens | Mapping[str, Lens]
) -> tuple[Observations, tuple[int, ...]]:
    """Return the views that fix a pose, and the frames that have others.

    Raises GeometryError where a camera has no view left, ObservationError where image points lie
    outside the images that its lens is of.
    """
    lenses = list(rig_lenses(observations, lens).values())
    models = [ForwardModel(one) for one in lenses]
    kept = np.ones(len(observations), dtype=bool)
    left_out: set[int] = set()
    for camera in np.unique(observations.camera):
        mine = observations.camera == camera
        which = int(camera) if len(models) > 1 else 0
        check_inside(observations.take(mine), lenses[which])
        _, frames = posable_views(observations.take(mine), models[which])
        kept[mine & np.isin(observations.frame, frames)] = False
        left_out.update(frames)
    return observations.take(kept), tuple(sorted(left_out))


def check_inside(observations: Observations, lens: Lens) -> None:
    """Raise ObservationError where image points lie outside the images that a lens is of."""
    if np.mean(~inside_image(lens, observations.uv)) > _OUTSIDE_SHARE:
        raise ObservationError(
            f'{observations.source}: image points lie outside the {lens.width}x{lens.height} px '
            f'of lens {lens.name!r}; check that it is the lens of this camera'
        )


def poses_by_frame(
    observations: Observations, known: dict[int, Pose], source: str
) -> dict[int, Pose]:
    """Return known poses by frame; raise ObservationError for a frame of a table without one."""
    for number in observations.frames.tolist():
        if number not in known:
            raise ObservationError(
                f'{source}: frame {number} of {observations.source} has no pose in it; add it, or '
                'leave the poses out'
            )
    return known
