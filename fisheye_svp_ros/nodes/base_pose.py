"""The pose of a robot's base from that of its camera, as robot_localization and Nav2 take it."""

from __future__ import annotations

from collections import deque

from geometry_msgs.msg import PoseWithCovarianceStamped

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.base import BaseNode
from fisheye_svp_ros.nodes.frame_listener import FrameListener
from fisheye_svp_ros.nodes.quality import TRANSFORMS
from fisheye_svp_ros.nodes.transforms import Transforms
from fisheye_svp_ros.pose import Pose, carried_pose
from fisheye_svp_ros.study.settings import RobotSettings

_MAX_WAITING = 30  # poses that wait for odometry of their time


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
        self._waiting: deque[tuple[Pose, int, str]] = deque(maxlen=_MAX_WAITING)
        if not base:
            return
        topics = [topic for topic in TRANSFORMS if odom or topic == '/tf_static']
        self._frames.listen('base_frame', topics)
        self._publisher = node.announce(PoseWithCovarianceStamped, '~/base_pose')
        self._transforms = Transforms(node, bool(odom))

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
            if len(self._waiting) == _MAX_WAITING:
                self._node.warn(
                    f'no transform to {self._odom!r} (odom_frame): /tf has no {self._base!r} in '
                    f'it at the time of the images; check the odometry'
                )
            self._waiting.append((base, stamp, world))
            self._publish_odometry()

    def _publish_odometry(self) -> None:
        """Publish where the odometry stands in the world, for each pose that has odometry."""
        for _ in range(len(self._waiting)):
            base, stamp, world = self._waiting.popleft()
            there = self._frames.find(self._odom, self._base, stamp)
            if there is None:
                self._waiting.append((base, stamp, world))
            else:
                self._transforms.publish(base.compose(there.inverse()), stamp, world, self._odom)
