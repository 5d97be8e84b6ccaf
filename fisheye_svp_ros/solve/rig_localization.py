"""Localization of a rig: one pose per frame from all of its cameras, lenses and rig known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import GeometryError, ObservationError
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, identity
from fisheye_svp_ros.scene.observations import Observations, select_cameras
from fisheye_svp_ros.solve.initial_rig import localize_frames
from fisheye_svp_ros.solve.measured_poses import posable_observations, rig_lenses, sigma_known
from fisheye_svp_ros.solve.outliers import Outliers, find_outliers
from fisheye_svp_ros.solve.reliability import noise_sigma
from fisheye_svp_ros.solve.rig_checks import is_unrelated, rig_differs
from fisheye_svp_ros.solve.rig_state import Linearization, RigState, RigViews, group_by_frame
from fisheye_svp_ros.solve.wrong_landmarks import find_wrong_landmarks


class RigLocalization(NamedTuple):
    """Poses of a rig's first camera.

    table: the rows that were used, and outliers among these; frame, pose, covariance (F, 6, 6), m
    and rad, for the noise of the data; data: views without outliers, with residual (S, N, 2), px,
    NaN for padding; sigma: noise of u and of v, px, estimated, None where the observations bring
    their own; left_out: frames with a view that fixes no pose by itself; contradicted: whether the
    cameras do not stand as the rig says.
    """

    table: Observations
    outliers: Outliers
    frame: Index
    pose: Pose
    covariance: Array
    data: RigViews
    residual: Array
    sigma: float | None
    left_out: tuple[int, ...]
    contradicted: bool


def localize_rig(
    table: Observations, lenses: Mapping[str, Lens], cameras: Sequence[str], rig: Pose
) -> RigLocalization:
    """Pose every frame of a rig from all of its cameras at once.

    cameras, rig (C,): names, and where each stands in the first one, whose poses are returned.
    Raises ObservationError for a camera that the rig does not have, GeometryError where no frame
    can be posed, or no pose explains what the cameras see together.
    """
    missing = [name for name in table.cameras if name not in cameras]
    if missing:
        raise ObservationError(
            f'{table.source}: camera {missing[0] or "without a name"} is not '
            f'in the rig, which has {", ".join(cameras)}'
        )
    rows, left_out = posable_observations(table, lenses)
    models = ForwardModel(list(rig_lenses(rows, lenses).values()))
    if wrong := find_wrong_landmarks(rows, models, lambda _: models):
        right = ~np.isin(table.landmark, [landmark.number for landmark in wrong])
        rows, left_out = posable_observations(table.take(right), lenses)
    present = [name for name in cameras if name in np.array(rows.cameras)[rows.camera]]
    rows = select_cameras(rows, present)
    own = [lenses[name] for name in present]
    data, place = group_by_frame(rows), rig.take([list(cameras).index(name) for name in present])
    state = RigState(
        identity(data.frames), place, own[0], (), tuple(own[1:]), tuple(present), corrected=True
    )
    if is_unrelated(data, state):
        raise GeometryError(
            f'{table.source}: no pose of the rig explains what its cameras see at the same time: '
            'they see boards of their own, or the rig is of other cameras; localize each camera '
            'by itself, or calibrate the rig again'
        )
    data, outliers = find_outliers(data, state)
    state = localize_frames(data, state)
    linear = Linearization(data, state, ())
    information = np.swapaxes(linear.frame_columns, -1, -2) @ linear.frame_columns
    if (
        not np.isfinite(linear.residual).all()
        or (np.linalg.eigvalsh(information)[:, 0] <= 0).any()
    ):
        raise GeometryError(
            f'{table.source}: the rig does not determine the pose of a frame; '
            'check that lenses, rig and observations belong together, and that '
            'all cameras see one target'
        )
    sigma = (
        None
        if sigma_known(rows)
        else noise_sigma(linear.sum_of_squares, int(linear.row_mask.sum()), 6 * data.frames)
    )
    covariance = np.asarray((sigma or 1.0) ** 2 * np.linalg.inv(information))
    return RigLocalization(
        rows,
        outliers._replace(landmarks=wrong),
        np.unique(data.views.frame),
        state.pose,
        covariance,
        data,
        linear.residual_px,
        sigma,
        left_out,
        rig_differs(data, state),
    )
