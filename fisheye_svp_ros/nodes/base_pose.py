"""The pose of a robot's base from that of its camera, as robot_localization and Nav2 take it."""

from __future__ import annotations

import time
from collections import deque
from typing import NamedTuple

from geometry_msgs.msg import PoseWithCovarianceStamped

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.base import BaseNode
from fisheye_svp_ros.nodes.quality import TRANSFORMS
from fisheye_svp_ros.nodes.transforms import FrameListener, TransformPublisher
from fisheye_svp_ros.pose import Pose, carried_pose
from fisheye_svp_ros.study.settings import RobotSettings

_MAX_WAITING = 30  # poses that wait for odometry of their time
_LONGEST_WAIT = 2.0  # s that a pose does


class _Waiting(NamedTuple):
    """The pose of a base in its world, the stamp, ns, and since when it waits, s."""

    base: Pose
    stamp: int
    world: str
    since: float


class BasePose:
    """Publishes `~/base_pose` and, with an odometry frame, map -> odom on /tf as amcl does.

    The camera in the base is looked up on /tf_static.  Raises ParameterError for frames that
    cannot belong together, and where tf2_msgs is not installed.
    """

    def __init__(self, node: BaseNode, settings: RobotSettings) -> None:
        base, odom = settings.base_frame, settings.odom_frame
        if odom and not base:
            raise ParameterError(f'odom_frame is {odom!r} without base_frame; name the base, too')
        if base and settings.publish_tf:
            raise ParameterError(
                f'publish_tf with base_frame {base!r}: the camera would have two parents on /tf; '
                'set publish_tf:=false'
            )
        self._node, self._base, self._odom = node, base, odom
        self._frames = FrameListener(node, self._publish_odometry)
        self._waiting: deque[_Waiting] = deque(maxlen=_MAX_WAITING)
        if not base:
            return
        topics = [topic for topic in TRANSFORMS if odom or topic == '/tf_static']
        self._frames.listen('base_frame', topics)
        self._publisher = node.announce(PoseWithCovarianceStamped, '~/base_pose')
        self._transforms = TransformPublisher(node, bool(odom))

    def publish(
        self, camera_pose: Pose, covariance: Array, stamp: int, world: str, camera: str
    ) -> None:
        """Publish the base that carries a camera; covariance (6, 6) of the camera, m and rad."""
        if not self._base:
            return
        mount = self._frames.find(camera, self._base, stamp)
        if mount is None:
            self._node.warn(
                f'no base_pose: /tf_static has no chain from {self._base!r} (base_frame) to '
                f'{camera!r}; publish it, e. g. with robot_state_publisher'
            )
            return
        base, covariance = carried_pose(camera_pose, covariance, mount)
        self._publisher.publish(
            messages.pose_with_covariance_message(base, covariance, stamp, world)
        )
        if self._odom:
            self._drop_expired()
            self._waiting.append(_Waiting(base, stamp, world, time.monotonic()))
            self._publish_odometry()

    def _drop_expired(self) -> None:
        """Drop the pose that has waited too long, or is one too many, and tell of it."""
        now, expired = time.monotonic(), len(self._waiting) == _MAX_WAITING
        while self._waiting and now - self._waiting[0].since > _LONGEST_WAIT:
            self._waiting.popleft()
            expired = True
        if expired:
            self._node.warn(
                f'no transform to {self._odom!r} (odom_frame): /tf has no {self._base!r} in '
                f'it at the time of the images; check the odometry'
            )

    def _publish_odometry(self) -> None:
        """Publish where the odometry stands in the world, for each pose that has odometry."""
        for _ in range(len(self._waiting)):
            one = self._waiting.popleft()
            base, stamp, world, _ = one
            there = self._frames.find(self._odom, self._base, stamp)
            if there is None:
                self._waiting.append(one)
            else:
                self._transforms.publish(base.compose(there.inverse()), stamp, world, self._odom)
