"""What a diagnosis needs of its inputs: views that can be posed, a true pose for each of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations

import numpy as np

from fisheye_svp_ros.arrays import Index
from fisheye_svp_ros.diagnosis.model import intrinsic_names
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Observations, rig_cameras
from fisheye_svp_ros.solve.measured import posable_views

_OUTSIDE = 0.02  # of the points of a camera: more than single gross errors
_AGAIN = 0.5  # of the image points: no two photographs have so many alike to the last digit
_ELSEWHERE = 1e-3  # of a target's extent: more than places that are written less exactly
ROUNDING = 1e-7  # px: what is simulated without noise scatters by less, nothing measured does
_MANY, _FEWEST = 1500, 24  # points of a thinned table, and of a view that stays whole


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


def of_rig(table: Observations, cameras: tuple[str, ...]) -> Observations:
    """Return other observations of a rig with its cameras in the order of these.

    Raises ObservationError where they are of other cameras.
    """
    if len(cameras) == 1:
        return table
    if set(table.cameras) != set(cameras):
        held = ', '.join(filter(None, table.cameras)) or 'one without a name'
        raise ObservationError(f'{table.source}: its cameras ({held}) are not those of the rig, '
                               + ', '.join(cameras))
    order = np.array([cameras.index(name) for name in table.cameras])
    return replace(table, cameras=cameras, camera=order[table.camera])


def right_first(table: Observations) -> Observations:
    """Return observations of a rig with its right camera first: true poses are of that one."""
    names = rig_cameras(table.cameras)
    if names is None or len(np.unique(table.camera)) < 2:
        return table
    return of_rig(table, (names[1], *(name for name in table.cameras if name != names[1])))


def check_other(observations: Observations, other: Observations) -> None:
    """Raise ObservationError where most of other observations are these once more."""
    seen, again = (set(zip(table.landmark.tolist(), *table.uv.T.tolist(), strict=True))
                   for table in (observations, other))
    if len(seen & again) > _AGAIN * len(again):
        raise ObservationError(f'{other.source}: these image points are those of '
                               f'{observations.source}; other photographs are needed')


def another_target(observations: Observations, other: Observations) -> bool:
    """Whether landmarks of one number stand in different places of two tables."""
    one, there = observations.landmarks(), other.landmarks()
    _, mine, theirs = np.intersect1d(one.ids, there.ids, return_indices=True)
    apart = np.abs(one.points[mine] - there.points[theirs])
    return bool(apart.max(initial=0.0) > _ELSEWHERE * np.ptp(one.points, axis=0).max())


def dithered(table: Observations) -> Observations:
    """Return observations with noise that nobody can measure, the same every time.

    Where nothing else is left over, as of simulated points without noise, rounding is: it depends
    on place and frame, and would be taken for a cause.
    """
    noise = 10 * ROUNDING * np.random.default_rng(0).standard_normal(table.uv.shape)
    return replace(table, uv=table.uv + noise)


def without_copies(observations: Observations) -> tuple[Observations, tuple[int, ...]]:
    """Return the frames whose image points no earlier one has, to the last digit, and the others.

    A copy knows nothing new, and what is noise in it seems to come again.
    """
    table = observations
    order = np.lexsort((table.landmark, table.camera, table.frame))
    rows = np.column_stack([table.camera, table.landmark, table.uv])[order]
    seen: set[bytes] = set()
    again = []
    for part in np.split(np.arange(len(order)), np.flatnonzero(np.diff(table.frame[order])) + 1):
        points = rows[part].tobytes()
        if points in seen:
            again.append(int(table.frame[order[part[0]]]))
        seen.add(points)
    return table.take(~np.isin(table.frame, again)), tuple(again)


def check_cameras(observations: Observations) -> None:
    """Raise ObservationError where two cameras of a rig hold the same image points."""
    tables = [replace(observations.take(observations.camera == camera),
                      source=f'{observations.source}, camera {name}')
              for camera, name in enumerate(observations.cameras)]
    for one, other in combinations(tables, 2):
        check_other(one, other)


def free_names(lenses: Mapping[str, Lens], free: bool | None = None) -> tuple[str, ...]:
    """Return the intrinsics that are fitted, those of a rig with the camera's name before them.

    free: of all lenses or of none; None asks each lens whether a calibration made it.
    """
    return tuple(
        f'{camera}.{name}' if camera else name for camera, lens in lenses.items()
        if (lens.calibration is not None if free is None else free)
        for name in intrinsic_names(lens)
    )


def posable(
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
        _check_inside(observations.take(mine), lenses[which])
        _, frames = posable_views(observations.take(mine), models[which])
        kept[mine & np.isin(observations.frame, frames)] = False
        left_out.update(frames)
    return observations.take(kept), tuple(sorted(left_out))


def _check_inside(observations: Observations, lens: Lens) -> None:
    outside = (observations.uv < 0) | (observations.uv > (lens.width, lens.height))
    if outside.any(axis=1).mean() > _OUTSIDE:
        raise ObservationError(
            f'{observations.source}: image points lie outside the {lens.width}x{lens.height} px '
            f'of lens {lens.name!r}; is it the lens of this camera?')


def thinned(observations: Observations) -> Observations:
    """Return about _MANY points of more: every second landmark, every third ...

    A view that would be left with less than _FEWEST stays whole.
    """
    step = max(len(observations) // _MANY, 1)
    views = np.stack([observations.frame, observations.camera])
    _, view, points = np.unique(views, axis=1, return_inverse=True, return_counts=True)
    place = np.unique(observations.landmark, return_inverse=True)[1].reshape(-1)
    whole = points[view.reshape(-1)] < _FEWEST * step
    return observations.take(whole | (place % step == 0))


def poses_by_frame(
    observations: Observations, frame: Index, pose: Pose, source: str
) -> dict[int, Pose]:
    """Return the true pose of each frame of a table, of poses (P,) of the frames (P,).

    Raises ObservationError, naming the source, for a frame without one.
    """
    known = {number: pose.take(i) for i, number in enumerate(frame.tolist())}
    for number in observations.frames.tolist():
        if number not in known:
            raise ObservationError(
                f'{source}: frame {number} of {observations.source} has no pose in it; add it, or '
                'leave the poses out'
            )
    return known
