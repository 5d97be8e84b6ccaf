"""Tables of image points to poses, of one camera or of a rig: what can be posed, and solved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import GeometryError, ObservationError
from fisheye_svp_ros.io.tag_maps import TagMap, tags_of
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, identity
from fisheye_svp_ros.scene.observations import (
    Observations,
    Views,
    group_frames,
    select_cameras,
)
from fisheye_svp_ros.scene.pose_priors import PlanarPrior
from fisheye_svp_ros.solve.localization import localize
from fisheye_svp_ros.solve.measured_poses import (
    check_inside,
    posable_views,
    rig_lenses,
    sigma_known,
    take_posable,
)
from fisheye_svp_ros.solve.outliers import NO_OUTLIERS, Outliers, WrongLandmark, find_outliers
from fisheye_svp_ros.solve.poses import solve_poses
from fisheye_svp_ros.solve.readout import cover_readouts
from fisheye_svp_ros.solve.rig_checks import is_unrelated, rig_differs
from fisheye_svp_ros.solve.rig_model import RigModel
from fisheye_svp_ros.solve.rig_state import RigState, group_by_frame
from fisheye_svp_ros.solve.solved_poses import SolvedPoses
from fisheye_svp_ros.solve.wrong_landmarks import find_wrong_landmarks

_NOISE_STEPS, _LEAST_NOISE = 8, 0.02  # px: no detector leaves less
_SETTLED = 0.01  # relative


def solve_table(
    table: Observations,
    model: ForwardModel,
    tag_map: TagMap | None = None,
    *,
    readout_time: float = 0.0,
) -> SolvedPoses:
    """Pose every frame of one camera's table that can be posed.

    tag_map: where its landmarks hang, and how well that is known; tags stand or fall as wholes;
    readout_time: of a rolling shutter that the lens does not know, s, see `solve.readout`.
    Raises ObservationError for rows of several cameras, or none of a tag of the map, GeometryError
    where no frame can be posed.
    """
    table, index = _known_rows(table, tag_map)
    wrong = _wrong_landmarks(table, model, tag_map)
    right = ~np.isin(table.landmark, [landmark.number for landmark in wrong])
    views, left_out = posable_views(table, model, right)
    solved = _solve(model, views, table, tag_map, tag_map is not None)
    solved = solved._replace(left_out=left_out, landmarks=wrong)
    return _posed_frames(solved, table.source, index, readout_time)


def solve_rig_table(
    table: Observations,
    lenses: Mapping[str, Lens],
    cameras: Sequence[str],
    rig: Pose,
    tag_map: TagMap | None = None,
    *,
    tags: bool = False,
    prior: PlanarPrior | None = None,
    readout_time: float = 0.0,
) -> SolvedPoses:
    """Pose every frame of a rig from all of its cameras at once: its first camera in the world.

    cameras, rig (C,): names, and where each stands in the first one; tags: the boards of the table
    are tags, which stand or fall as wholes, as those of a map do; prior (F,): of the poses;
    readout_time: as of `solve_table`.
    Raises ObservationError for a camera that the rig does not have, GeometryError where no frame
    can be posed, or no pose explains what the cameras see together.
    """
    missing = [name for name in table.cameras if name not in cameras]
    if missing:
        raise ObservationError(
            f'{table.source}: camera {missing[0] or "without a name"} is not '
            f'in the rig, which has {", ".join(cameras)}'
        )
    table, index = _known_rows(table, tag_map)
    tags = tags or tag_map is not None
    present = [name for name in cameras if name in np.array(table.cameras)[table.camera]]
    table = select_cameras(table, present)
    own = [rig_lenses(table, lenses)[name] for name in present]
    places = rig.take([list(cameras).index(name) for name in present])
    for i, lens in enumerate(own):
        if len(seen := table.take(table.camera == i)):
            check_inside(seen, lens)
    models = ForwardModel(own)
    wrong = _wrong_landmarks(table, models, tag_map)
    kept = ~np.isin(table.landmark, [landmark.number for landmark in wrong])
    checks, rejected = _RigChecks(table, own, places, kept), NO_OUTLIERS
    if not tags:  # which are found out as wholes
        rejected = checks.find_outliers()
        kept[rejected.rows] = False
    views, widths = group_frames(table)
    model = RigModel([models.camera(i) for i in range(len(own))], places, widths)
    weight = np.where(views.used & kept[views.row], views.weight, 0.0)
    views = views._replace(weight=weight, prior=prior)
    views = views.take((weight > 0).any(axis=1))  # the others are outliers as wholes
    views, left_out = take_posable(views, table.source, model)
    solved = _solve(model, views, table, tag_map, tags)
    if not tags or any(solved.reasons):
        solved = solved._replace(contradicted=checks.is_contradicted())
    rejected = rejected._replace(rows=index[rejected.rows])
    solved = solved._replace(left_out=left_out, landmarks=wrong, rejected=rejected)
    return _posed_frames(solved, table.source, index, readout_time)


def _known_rows(table: Observations, tag_map: TagMap | None) -> tuple[Observations, Index]:
    """Return the rows of tags that a map has, where it has them, and which (N,) of all they are.

    Their boards are the tags.  Raises ObservationError where there are none.
    """
    if tag_map is None:
        return table, np.arange(len(table))
    xyz, known = tag_map.landmarks().lookup(table.landmark)
    if not known.any():
        raise ObservationError(
            f'{table.source}: no landmark is a corner of a tag of the map (4 id + 0 to 3)'
        )
    placed = replace(table, xyz=xyz, board=tags_of(table.landmark))
    return placed.take(known), np.flatnonzero(known)


def _solve(
    model: ForwardModel,
    views: Views,
    table: Observations,
    tag_map: TagMap | None,
    tags: bool,
) -> SolvedPoses:
    """Solve the views of a table; what has no weight in them is an outlier, too."""
    noise = 1.0
    if tag_map is not None and tag_map.covariance is not None:
        views = views._replace(landmark_covariance=tag_map.landmark_covariance(views.landmark))
        if not sigma_known(table):
            noise = _noise_beside_map(model, views)
    weighed = views._replace(weight=views.weight / noise)
    solved = solve_poses(model, weighed, known_sigma=sigma_known(table), tags=tags)
    outliers = np.asarray(solved.outliers | views.used & (views.weight == 0))
    sigma = None if solved.sigma is None else solved.sigma * noise
    return solved._replace(views=views, outliers=outliers, sigma=sigma)


def _noise_beside_map(model: ForwardModel, views: Views) -> float:
    """Return the noise, px, that the errors of a map leave of the residuals; weights are of 1 px.

    That by which the median view fits as well as it should.
    """
    freedom = np.maximum(2 * (views.weight > 0).sum(axis=1) - 6, 1)
    exact = localize(model, views._replace(landmark_covariance=None))
    noise, pose = max(_typical_sigma(exact.cost, freedom), _LEAST_NOISE), exact.pose
    for _ in range(_NOISE_STEPS):
        weighed = localize(model, views._replace(weight=views.weight / noise), pose)
        before, pose = noise, weighed.pose
        noise = max(noise * _typical_sigma(weighed.cost, freedom), _LEAST_NOISE)
        if abs(noise / before - 1) < _SETTLED:
            break
    return noise


def _typical_sigma(cost: Array, freedom: Array) -> float:
    return float(np.sqrt(np.median(cost / freedom)))


def _posed_frames(
    solved: SolvedPoses, source: str, index: Index, readout_time: float
) -> SolvedPoses:
    """Return the frames that have a pose, the others being left out; rows are those of a table.

    index (N,): which of its rows were solved.
    """
    views = solved.views
    row = np.where(views.used, index[views.row], -1)
    solved = solved._replace(views=views._replace(row=row))
    fixed = solved.result.converged
    if not fixed.all():
        left_out = tuple(sorted((*solved.left_out, *solved.frame[~fixed].tolist())))
        solved = solved.select(fixed)._replace(left_out=left_out)
    if not len(solved.frame):
        raise GeometryError(f'{source}: no frame has points that determine a pose')
    return cover_readouts(solved, readout_time) if readout_time else solved


def _wrong_landmarks(
    table: Observations, model: ForwardModel, tag_map: TagMap | None
) -> tuple[WrongLandmark, ...]:
    """Return the landmarks that are elsewhere; not by a map, which says how well it knows them."""
    if tag_map is not None and tag_map.covariance is not None:
        return ()
    return find_wrong_landmarks(table, model, lambda _: model)


class _RigChecks:
    """Whether the cameras of a rig see one target, and stand as it says: of views posed alone."""

    def __init__(
        self, table: Observations, lenses: Sequence[Lens], places: Pose, kept: Mask
    ) -> None:
        self._source, posable = table.source, np.zeros(len(table), dtype=bool)
        for camera, lens in enumerate(lenses):
            mine = np.flatnonzero(kept & (table.camera == camera))
            with suppress(GeometryError, ObservationError):  # none, or none that fixes a pose
                views, _ = posable_views(table.take(mine), ForwardModel(lens))
                posable[mine[views.row[views.used]]] = True
        self._rows, self._data = np.flatnonzero(posable), None
        if len(self._rows):
            self._data = data = group_by_frame(table.take(self._rows))
            seen = np.unique(table.camera[self._rows])
            self._state = RigState(
                identity(data.frames),
                places.take(seen),
                lenses[seen[0]],
                (),
                tuple(lenses[i] for i in seen[1:]),
                tuple(table.cameras[i] for i in seen),
                corrected=True,
            )

    def find_outliers(self) -> Outliers:
        """Return the outliers among the rows; raise GeometryError for boards of their own."""
        if self._data is None:
            return NO_OUTLIERS
        if is_unrelated(self._data, self._state):
            raise GeometryError(
                f'{self._source}: no pose of the rig explains what its cameras see at the same '
                'time. They see different boards, or the rig belongs to other cameras. '
                'Localize each camera separately, or calibrate the rig again'
            )
        self._data, found = find_outliers(self._data, self._state)
        return found._replace(rows=self._rows[found.rows])

    def is_contradicted(self) -> bool:
        """Say whether the cameras do not stand as the rig says, by what is no outlier."""
        return self._data is not None and rig_differs(self._data, self._state)
