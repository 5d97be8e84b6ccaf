"""What a diagnosis needs of its inputs: views that can be posed, a true pose for each of them."""

from __future__ import annotations

import numpy as np

from fisheye_svp_ros.arrays import Index
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.solve.measured import posable_views


def posable(observations: Observations, lens: Lens) -> tuple[Observations, tuple[int, ...]]:
    """Return the views that fix a pose, and the frames that have others.

    Raises GeometryError where a camera has no view left.
    """
    model = ForwardModel(lens)
    kept = np.ones(len(observations), dtype=bool)
    left_out: set[int] = set()
    for camera in np.unique(observations.camera):
        mine = observations.camera == camera
        _, frames = posable_views(observations.take(mine), model)
        kept[mine & np.isin(observations.frame, frames)] = False
        left_out.update(frames)
    return observations.take(kept), tuple(sorted(left_out))


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
