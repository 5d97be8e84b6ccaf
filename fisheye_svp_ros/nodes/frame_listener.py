"""Where frames stand in each other, as /tf and /tf_static tell a node."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from contextlib import suppress

from rclpy.serialization import deserialize_message

from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.io.decoding import read_transform, stamp_of
from fisheye_svp_ros.nodes.base import BaseNode
from fisheye_svp_ros.nodes.frame_tree import FrameTree
from fisheye_svp_ros.nodes.quality import TRANSFORMS
from fisheye_svp_ros.nodes.transforms import message_class
from fisheye_svp_ros.pose import Pose


class FrameListener:
    """Takes in transforms from `listen` on; moved: is called when there is something on /tf."""

    def __init__(self, node: BaseNode, moved: Callable[[], None] | None = None) -> None:
        self.tree = FrameTree()
        self._node, self._moved = node, moved
        self._listens = False

    def listen(self, needed_by: str, topics: Sequence[str] = tuple(TRANSFORMS)) -> None:
        """Subscribe; raise ParameterError, naming who needs it, where tf2_msgs is missing."""
        self._kind, self._listens = message_class(needed_by), True
        for topic in topics:
            hear = functools.partial(self._hear, topic == '/tf_static')
            self._node.create_subscription(
                self._kind, topic, self._node.guard_callback(hear), TRANSFORMS[topic], raw=True
            )

    def find(self, frame: str, child: str, stamp: int) -> Pose | None:
        """Return the pose of one frame in another at a time, ns; None where it is not known.

        The first question is the first that anybody needs to hear of: a robot tells much on /tf.
        """
        if not self._listens:
            with suppress(ParameterError):
                self.listen('frames')
            self._listens = True
        return self.tree.find(frame.lstrip('/'), child.lstrip('/'), stamp)

    def _hear(self, fixed: bool, data: bytes) -> None:
        for transform in deserialize_message(data, self._kind).transforms:
            stamp = None if fixed else stamp_of(transform)
            frames = transform.header.frame_id.lstrip('/'), transform.child_frame_id.lstrip('/')
            self.tree.add(*frames, read_transform(transform, '/tf'), stamp)
        if not fixed and self._moved is not None:
            self._moved()
