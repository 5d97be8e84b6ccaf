"""Rigs of any number of cameras: their poses in the first one, from what they saw together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.optics.lens import Lens, monotone_limit, parameter_values
from fisheye_svp_ros.pose import Pose, identity
from fisheye_svp_ros.scene.observations import Observations, select_cameras, select_shared
from fisheye_svp_ros.solve.bundle_adjustment import Prior, adjust, rig_covariance
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.measured_poses import sigma_known
from fisheye_svp_ros.solve.moving_rig import PlacedBoards, place_boards
from fisheye_svp_ros.solve.outliers import FRAME, find_outliers
from fisheye_svp_ros.solve.reliability import misfit_fails, misfit_reason
from fisheye_svp_ros.solve.rig_state import (
    Linearization,
    RigState,
    RigViews,
    group_by_frame,
)


class RigCalibration(NamedTuple):
    """A rig of C cameras: rig (C,) in the first of them, m.

    covariance (C - 1, 6, 6), m and rad, of the change in `Pose.retract`, of each camera but the
    first; frame (F,); pose (F,) of the first camera in its target; rms_px (C,), and over all:
    total_rms_px; sigma_px: noise of u and v, estimated, None where the observations bring their
    own; shared (C,): frames that a camera shares with others; left_out: frames that no rig
    explains; reason: why it should not be relied on, '' for a reliable one; lenses (C,): fitted
    with the rig; boards (C,): which board each camera sees, where these stand apart and only the
    motion of the rig relates them; empty where all see one.
    """

    cameras: tuple[str, ...]
    rig: Pose
    covariance: Array
    frame: Index
    pose: Pose
    rms_px: Array
    total_rms_px: float
    sigma_px: float | None
    shared: Index
    left_out: tuple[int, ...]
    reason: str
    lenses: tuple[Lens, ...]
    boards: tuple[int, ...] = ()

    def steps(self) -> tuple[Pose, ...]:
        """Return each camera in the next one (C - 1 poses), as rig files have them."""
        return tuple(self.rig.take(i + 1).inverse().compose(self.rig.take(i))
                     for i in range(len(self.cameras) - 1))


def connected_cameras(table: Observations) -> list[tuple[str, ...]]:
    """Return groups of cameras that frames hold together, each in an order in which they do.

    A camera in no group with others never saw the target in the same frame as they did.
    """
    seen = np.zeros((len(table.cameras), len(table.frames)), dtype=bool)
    seen[table.camera, np.searchsorted(table.frames, table.frame)] = True
    shared = seen.astype(int) @ seen.T.astype(int)
    left, groups = list(range(len(table.cameras))), []
    while left:
        group, frames = [left.pop(0)], shared[:, :]
        while near := [camera for camera in left if frames[camera, group].any()]:
            group.append(max(near, key=lambda camera: int(frames[camera, group].max())))
            left.remove(group[-1])
        groups.append(tuple(table.cameras[camera] for camera in group))
    return groups


def calibrate_rig(
    table: Observations, lenses: Mapping[str, Lens], cameras: Sequence[str]
) -> RigCalibration:
    """Fit the rig and the poses of its frames to what the cameras saw, and their lenses.

    What a lens states of its errors is its prior; one that states none stays as it is.
    cameras: connected ones, in the order in which they are wanted; the first is the frame of all.
    Outliers are rejected, and frames in which the cameras contradict each other.
    Cameras that see boards of their own are related by the motion of the rig.
    Raises ObservationError where no rig explains most frames; GeometryError, naming the frame, for
    a view that does not fix a pose, and where the rig is not determined.
    """
    order = connected_cameras(select_cameras(table, cameras))[0]
    ordered = [lenses[name] for name in order]
    placed = place_boards(select_shared(select_cameras(table, order)), ordered)
    rows, torn = _without_outliers(placed)
    data, state = _fit_rig(rows, ordered, placed.boards)
    # Cameras stand in the order in which frames hold them together; the first one stays the first.
    place = [order.index(name) for name in cameras if name in order]
    known = sigma_known(rows)
    free, mean, information = _stated_errors(order, ordered)
    held, freedom = _sum_of_squares(data, state)
    if freedom < 1:
        raise GeometryError(f'{rows.source}: too few points for a rig of {len(order)} cameras')
    if free:
        noise = 1.0 if known else np.sqrt(held / freedom)
        values, vectors = np.linalg.eigh(information)
        root = noise * np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
        state = adjust(data, state, free, Prior(mean, root))
    squared, freedom = _sum_of_squares(data, state)
    fails = known and bool(misfit_fails(np.array(squared), np.array(freedom)))
    sigma = None if known else float(np.sqrt(squared / freedom))
    linear = Linearization(data, state, free)
    covariance = rig_covariance(linear, sigma or 1.0, information)
    squares = ((data.views.uv - linear.linear.uv) ** 2).sum(axis=-1)
    squares = np.where(data.views.used, squares, np.nan)
    return RigCalibration(
        tuple(order[i] for i in place), state.rig.take(place),
        covariance[[i - 1 for i in place[1:]]], rows.frames, state.pose,
        np.array([np.sqrt(np.nanmean(squares[data.camera_of == i])) for i in place]),
        float(np.sqrt(np.nanmean(squares))), sigma,
        np.bincount(data.camera_of, minlength=len(order))[place], torn,
        misfit_reason(squared / freedom, freedom) if fails else '',
        tuple(_within_curve(state.lenses[i]) for i in place),
        tuple(placed.boards[i] for i in place if placed.boards),
    )


def _without_outliers(placed: PlacedBoards) -> tuple[Observations, tuple[int, ...]]:
    """Return the rows without outliers, and the frames that no rig explains."""
    rows = placed.rows
    _, found = find_outliers(placed.data, placed.state)
    torn = {int(rows.frame[row]) for row, why in zip(found.rows, found.why, strict=True)
            if why == FRAME}
    kept = ~np.isin(np.arange(len(rows)), found.rows) & ~np.isin(rows.frame, sorted(torn))
    return select_shared(rows.take(kept)), tuple(sorted(torn))


def _fit_rig(
    rows: Observations, lenses: Sequence[Lens], boards: tuple[int, ...]
) -> tuple[RigViews, RigState]:
    """Return rig, boards of the cameras' own and poses of the frames, fitted, the lenses known."""
    data = group_by_frame(rows)
    start = initial_state(data, lenses[0], lenses[1:])
    rig = Pose.concatenate([start.rig, identity(max(boards, default=0))])
    state = replace(start, rig=rig, lens=lenses[0], others=tuple(lenses[1:]), terms=(),
                    corrected=True, boards=boards)
    return data, adjust(data, state, ())


def _within_curve(lens: Lens) -> Lens:
    """Return the lens with a field of view that its curve, which has moved, still allows."""
    return replace(lens, max_incidence=min(lens.max_incidence, monotone_limit(lens)))


def _sum_of_squares(data: RigViews, state: RigState) -> tuple[float, int]:
    """Return the whitened sum of squares and its degrees of freedom."""
    linear = Linearization(data, state, ())
    freedom = int(linear.row_mask.sum()) - 6 * (data.frames + len(state.rig.position) - 1)
    return float((linear.residual**2).sum()), freedom


def _stated_errors(
    cameras: Sequence[str], lenses: Sequence[Lens]
) -> tuple[list[str], Array, Array]:
    """Return what the lenses state of their errors: names, values (K,) and information (K, K)."""
    from scipy.linalg import block_diag  # not while --help waits

    free: list[str] = []
    mean: list[float] = []
    parts = [np.zeros((0, 0))]
    for name, lens in zip(cameras, lenses, strict=True):
        stated = lens.calibration or {}
        if 'covariance' in stated and 'stderr' in stated:
            free += [f'{name}.{parameter}' for parameter in stated['stderr']]
            mean += parameter_values(lens, list(stated['stderr']))
            parts.append(np.linalg.pinv(np.array(stated['covariance'], dtype=float),
                                        hermitian=True))
    return free, np.array(mean), block_diag(*parts)
