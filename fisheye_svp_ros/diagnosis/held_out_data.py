"""Other frames of the cameras, on which a model is measured."""

from __future__ import annotations

from dataclasses import dataclass, replace

from fisheye_svp_ros.diagnosis.selection import Selection
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.scene.table_checks import is_another_target
from fisheye_svp_ros.solve.initial_rig import localize_frames
from fisheye_svp_ros.solve.outliers import Outliers, find_outliers
from fisheye_svp_ros.solve.rig_checks import has_no_rig, rig_differs, unpair_cameras
from fisheye_svp_ros.solve.rig_state import (
    RigState,
    RigViews,
    group_by_frame,
)


@dataclass(frozen=True)
class HeldOutData:
    """Other frames of the same cameras, posed, without outliers.

    rig_differs: whether the cameras do not stand as in the data, so that each view was posed by
    itself; another_target: whether landmarks of one number stand in other places.
    """

    data: RigViews
    pose: Pose
    outliers: Outliers
    rig_differs: bool
    another_target: bool

    @classmethod
    def prepare(cls, held_out: Observations, selection: Selection) -> HeldOutData:
        """Pose other frames by the extended model, and set outliers aside.

        These are no measure of a model; the same points are left out for all.
        """
        trained = selection.null.linear.data
        another_target = is_another_target(trained.observations, held_out)
        table = group_by_frame(held_out)
        if has_no_rig(trained):
            table = unpair_cameras(table)
        state = valid_state(selection.state, table, trained, another_target)
        data, outliers = find_outliers(table, localize_frames(table, state))
        differs = rig_differs(data, state)
        if differs:
            table = unpair_cameras(table)
            data, outliers = find_outliers(table, localize_frames(table, state))
        return cls(data, localize_frames(data, state).pose, outliers, differs, another_target)


def valid_state(
    state: RigState, test: RigViews, trained: RigViews, another_target: bool
) -> RigState:
    """Return the state without what trained frames or their target had, and the test has not."""
    t, known = test.observations.t, trained.observations.t
    return replace(state, terms=tuple(
        term for term in state.terms if term[0].holds_for(t, known)
        and not (another_target and term[0].place == 'target')))
