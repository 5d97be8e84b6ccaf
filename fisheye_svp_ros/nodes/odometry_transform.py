"""Where the odometry stands in the world, on /tf, as amcl publishes it."""

from __future__ import annotations

from fisheye_svp_ros.nodes.base import BaseNode
from fisheye_svp_ros.nodes.transforms import FrameListener, TransformPublisher
from fisheye_svp_ros.pose import Pose

_CHECK_PERIOD = 0.05  # s between two looks at whether a transform is to be sent again
_USABLE = 0.8  # of the tolerance: a transform that is dated less far ahead is sent again
_STEP = 10**6  # ns between stamps: tf2 takes no second transform of a stamp
_RESTART = 2 * 10**9  # ns by which an image is older than the one before: a recording starts over
_REMEDY = (
    'let one node publish it: leave odom_frame out here, or set tf_broadcast:=false in amcl, '
    'publish_tf:=false in robot_localization'
)


class OdometryTransform:
    """Publishes world -> odometry, dated ahead by a tolerance, and again while no pose comes.

    tf2 answers for now only where a transform is dated later.  The stamps are those of images and
    of odometry, never of a clock, so that a recording is served as well.
    tolerance: s; base, odom: frames.  Raises ParameterError where tf2_msgs is not installed.
    """

    def __init__(
        self, node: BaseNode, base: str, odom: str, frames: FrameListener, tolerance: float
    ) -> None:
        self._base, self._odom, self._tree = base, odom, frames.tree
        self._tolerance = round(1e9 * tolerance)
        self._transforms = TransformPublisher(node, True, remedy=_REMEDY)
        self._latest: tuple[Pose, str] | None = None
        self._image = self._sent = 0  # stamps of the latest image and transform, ns
        node.start_timer(_CHECK_PERIOD, self._repeat)

    def publish(self, pose: Pose, stamp: int, world: str) -> None:
        """Publish the odometry's pose in the world at the stamp of an image, ns."""
        if self._latest is None or stamp < self._image - _RESTART:
            self._send(pose, stamp, world)  # tf2 knows nothing before the first of all
        elif stamp <= self._image:
            return  # of an image that had to wait, while a later one had not
        self._image, self._latest = stamp, (pose, world)
        if self._tolerance:
            self._send(pose, max(stamp + self._tolerance, self._sent + _STEP), world)
        elif stamp > self._sent:
            self._send(pose, stamp, world)

    def _send(self, pose: Pose, stamp: int, world: str) -> None:
        self._sent = stamp
        self._transforms.publish(pose, stamp, world, self._odom)

    def _repeat(self) -> None:
        """Send the latest again before odometry passes its stamp."""
        newest = self._tree.latest(self._odom, self._base)
        if self._latest is None or newest is None:
            return
        if newest + _USABLE * self._tolerance > self._sent:
            pose, world = self._latest
            self._send(pose, newest + self._tolerance, world)
