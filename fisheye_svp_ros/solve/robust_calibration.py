"""A lens calibrated without outliers: wrong landmarks first, then points, round by round."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.scene.table_checks import check_frames_differ
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.lens_calibration import Calibration, refit_without_outliers
from fisheye_svp_ros.solve.outliers import NO_OUTLIERS, Outliers, find_outliers
from fisheye_svp_ros.solve.rig_state import group_by_frame
from fisheye_svp_ros.solve.wrong_landmarks import find_wrong_landmarks

_MAX_ROUNDS = 4
_FEW_OUTLIERS = 0.02  # of the rows: a lens that they were fitted with is near that without them


def calibrate_without_outliers(
    observations: Observations,
    calibrate: Callable[[Observations], Calibration],
    starts: Sequence[Lens] = (),
) -> tuple[Calibration, Observations, Outliers]:
    """Calibrate a lens of one camera anew for as long as outliers are found.

    calibrate: fits a lens to some of the rows; starts: rough lenses, to find wrong landmarks with
    where it fails.  Returns the last lens, the rows that it is of, and those that are rejected.
    """
    check_frames_differ(observations)
    result = _fit_if_possible(calibrate, observations)
    wrong = find_wrong_landmarks(
        observations,
        result and ForwardModel(result.adjusted.lens),
        lambda some: ForwardModel(calibrate(some).adjusted.lens),
        map(ForwardModel, starts),
    )
    rejected, rounds = NO_OUTLIERS.append_landmarks(observations, wrong), 0
    rows = np.delete(np.arange(len(observations)), rejected.rows)
    while True:
        if result is None or rounds or wrong:
            fewer = observations.take(rows)
            near = result and len(rejected.rows) <= _FEW_OUTLIERS * len(observations)
            result = (result and near and refit_without_outliers(result, fewer)) or calibrate(
                fewer
            )
        rows = rows[~np.isin(observations.frame[rows], result.left_out)]
        table = observations.take(rows)
        data = group_by_frame(table)
        outliers = find_outliers(data, initial_state(data, result.adjusted.lens))[1]
        rounds += 1
        if not len(outliers.rows) or rounds == _MAX_ROUNDS:
            return result, table, rejected
        rejected = rejected.join(outliers._replace(rows=rows[outliers.rows]))
        rows = np.delete(rows, outliers.rows)


def _fit_if_possible(
    calibrate: Callable[[Observations], Calibration], observations: Observations
) -> Calibration | None:
    """Return a lens of all rows; None where wrong landmarks, perhaps, leave none to fit."""
    try:
        return calibrate(observations)
    except GeometryError:
        return None
