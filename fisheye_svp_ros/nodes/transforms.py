"""Poses as transforms on /tf and /tf_static, for whoever asks tf2 where a frame is."""

from __future__ import annotations

from typing import Any

from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.base import BaseNode
from fisheye_svp_ros.nodes.quality import LATCHED, RELIABLE
from fisheye_svp_ros.pose import Pose


class Transforms:
    """What one node tells tf2, if it is to; static: what holds until it is told anew.

    A frame has one parent (REP 105): two nodes must not tell of the same child.
    Raises ParameterError where it is to and tf2_msgs is not installed.
    """

    def __init__(self, node: BaseNode, wanted: bool, static: bool = False) -> None:
        self._node = node
        self._publisher = None
        if wanted:
            topic, qos = ('/tf_static', LATCHED) if static else ('/tf', RELIABLE)
            self._kind = _message_class()
            self._publisher = node.announce(self._kind, topic, qos)

    def publish(self, pose: Pose, stamp: int, frame: str, child: str) -> None:
        """Publish the pose of a frame in its parent; warn where frame ids cannot be used."""
        if self._publisher is None:
            return
        if not frame or not child or frame == child:
            self._node.get_logger().warning(
                f'no transform: frame_id {frame!r} cannot be the parent of {child!r}',
                throttle_duration_sec=10.0)
            return
        transform = messages.transform_message(pose, stamp, frame, child)
        self._publisher.publish(self._kind(transforms=[transform]))


def _message_class() -> Any:
    """Return TFMessage, which is in a package of its own and not in every installation."""
    try:
        from tf2_msgs.msg import TFMessage
    except ImportError as cause:
        raise ParameterError(
            'publish_tf: tf2_msgs is not installed; source a ROS 2 that has it (apt install '
            'ros-jazzy-tf2-msgs; it has no wheel), or leave publish_tf at false') from cause
    return TFMessage
