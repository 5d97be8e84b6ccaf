"""Poses as transforms on /tf and /tf_static, for whoever asks tf2 where a frame is."""

from __future__ import annotations

from collections import deque
from typing import Any

from rclpy.serialization import deserialize_message

from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.base import BaseNode
from fisheye_svp_ros.nodes.quality import LATCHED, TRANSFORMS
from fisheye_svp_ros.pose import Pose

_MIN_CHANGE = 1e-6  # m, and of a quaternion, of a static transform
_MAX_SENT = 100  # transforms by which those that come back may be late


class Transforms:
    """What one node tells tf2, if it is to; static: what holds until it is told anew.

    A frame has one parent (REP 105): where another node publishes the same child, it is said.
    Raises ParameterError where it is to and tf2_msgs is not installed.
    """

    def __init__(self, node: BaseNode, wanted: bool, static: bool = False) -> None:
        self._node, self._static = node, static
        self._publisher = None
        self._sent: deque[Any] = deque(maxlen=_MAX_SENT)
        self._children: set[str] = set()
        if wanted:
            self._kind = message_class('publish_tf')
            self._publisher = (
                node.announce(self._kind, '/tf_static', LATCHED)
                if static
                else node.announce(self._kind, '/tf')
            )
            for topic, asked in TRANSFORMS.items():
                node.create_subscription(
                    self._kind, topic, node.guard_callback(self._compare), asked, raw=True
                )

    def publish(self, pose: Pose, stamp: int, frame: str, child: str) -> None:
        """Publish the pose of a frame in its parent; warn where frame ids cannot be used."""
        if self._publisher is None:
            return
        if not frame or not child or frame == child:
            self._node.warn(f'no transform: frame_id {frame!r} cannot be the parent of {child!r}')
            return
        transform = messages.transform_message(pose, stamp, frame, child)
        if self._static and not self._has_changed(transform):
            return
        self._sent.append(transform)
        self._children.add(child)
        self._publisher.publish(self._kind(transforms=[transform]))

    def _has_changed(self, transform: Any) -> bool:
        """Say whether a transform is another than the latest of its child: by 1e-6 m or so."""
        child = transform.child_frame_id
        last = next((one for one in reversed(self._sent) if one.child_frame_id == child), None)
        if last is None or last.header.frame_id != transform.header.frame_id:
            return True
        before, after = (_numbers(one.transform) for one in (last, transform))
        return any(abs(a - b) > _MIN_CHANGE for a, b in zip(before, after, strict=True))

    def _compare(self, data: bytes) -> None:
        """Warn of what others tell of the frames of this node."""
        if not any(child.encode() in data for child in self._children):
            return  # a robot tells of many frames, many times a second
        for transform in deserialize_message(data, self._kind).transforms:
            child = transform.child_frame_id
            if child in self._children and transform not in self._sent:
                self._node.warn(
                    f'/tf: another node also publishes {child!r}, with parent '
                    f'{transform.header.frame_id!r}; set another camera_frame in one of them, or '
                    'publish_tf:=false'
                )


def _numbers(transform: Any) -> list[float]:
    place, turn = transform.translation, transform.rotation
    return [place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w]


def message_class(parameter: str) -> Any:
    """Return TFMessage, which is in a package of its own and not in every installation.

    parameter: that needs it.
    """
    try:
        from tf2_msgs.msg import TFMessage
    except ImportError as cause:
        raise ParameterError(
            f'{parameter}: tf2_msgs is not installed; source a ROS 2 that has it (apt install '
            'ros-jazzy-tf2-msgs; it has no wheel), or '
            + ('set publish_tf:=false' if parameter == 'publish_tf' else 'leave it out')
        ) from cause
    return TFMessage
