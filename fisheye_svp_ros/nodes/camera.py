"""What both cameras share: the topics of one camera, and the scenario that tags each set."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import CameraInfo, PointCloud2

from fisheye_svp_ros import messages
from fisheye_svp_ros.arrays import Index
from fisheye_svp_ros.lens import Lens
from fisheye_svp_ros.nodes.base import LATCHED, BaseNode
from fisheye_svp_ros.observations import Observations
from fisheye_svp_ros.pose import Pose

WORLD = 'world'


class CameraTopics:
    """The topics of one camera; name: its namespace, empty for the only camera."""

    def __init__(self, node: BaseNode, name: str) -> None:
        prefix = f'{name}/' if name else ''
        self.frame = f'{name}_camera_optical_frame' if name else 'camera_optical_frame'
        self._info = node.announce(CameraInfo, f'{prefix}camera_info', LATCHED)
        self._pose = node.announce(PoseStamped, f'{prefix}true_pose')
        self._points = node.announce(PointCloud2, f'{prefix}image_points', wait=True)

    def publish(
        self, stamp: int, seen: Observations, pose: Pose | None, lens: Lens | None
    ) -> None:
        """Publish one set: image points, and what is known of pose and lens."""
        if lens is not None:
            self._info.publish(messages.camera_info_message(lens, stamp, self.frame))
        if pose is not None:
            self._pose.publish(messages.pose_message(pose, stamp, WORLD))
        self._points.publish(
            messages.image_points_message(seen.landmark, seen.uv, stamp, self.frame)
        )


class CameraNode(BaseNode):
    """A node that publishes landmarks, scenarios and what one or two cameras see."""

    def __init__(self) -> None:
        super().__init__()
        self._landmarks = self.announce(PointCloud2, 'landmarks', LATCHED)
        self._scenario = self.announce(DiagnosticArray, 'scenario')
        self._cameras: dict[str, CameraTopics] = {}
        self._last_stamp = 0

    def camera(self, name: str) -> CameraTopics:
        """Return the topics of a camera."""
        if name not in self._cameras:
            self._cameras[name] = CameraTopics(self, name)
        return self._cameras[name]

    def tag(self, stamp: int, values: Mapping[str, Any], text: str = '') -> None:
        """Say which scenario the set of a stamp belongs to."""
        self._scenario.publish(messages.key_values_message('scenario', values, stamp, text))

    def publish_landmarks(self, landmarks: Any, stamp: int) -> None:
        """Publish landmarks; stamp 0: they hold for every set."""
        self._landmarks.publish(messages.landmarks_message(landmarks, stamp, WORLD))

    def new_stamp(self) -> int:
        """Return the time, ns, never the same twice."""
        self._last_stamp = max(self.get_clock().now().nanoseconds, self._last_stamp + 1)
        return self._last_stamp


def rows_by_frame(observations: Observations) -> dict[tuple[int, str], Index]:
    """Return which rows belong to each frame of each camera, by frame and camera name."""
    order = np.lexsort((observations.camera, observations.frame))
    keys = np.stack([observations.frame, observations.camera], axis=-1)[order]
    starts = np.flatnonzero(np.any(np.diff(keys, axis=0, prepend=keys[:1] - 1), axis=1))
    groups = np.split(order, starts[1:]) if len(order) else []
    frame, camera = observations.frame, observations.camera
    return {(int(frame[r[0]]), observations.cameras[camera[r[0]]]): r for r in groups}
