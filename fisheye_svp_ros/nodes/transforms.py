"""Transforms on /tf and /tf_static: poses published there, and frames that others publish."""

from __future__ import annotations

import functools
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from rclpy.serialization import deserialize_message

from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.io.decoding import read_transform, stamp_of
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.base import BaseNode
from fisheye_svp_ros.nodes.quality import LATCHED, TRANSFORMS
from fisheye_svp_ros.pose import Pose, identity

_MIN_CHANGE = 1e-6  # m, and of a quaternion, of a static transform
_MAX_SENT = 100  # transforms by which those that come back may be late
_MAX_LENGTH = 1000  # poses of a moving frame that are kept, 10 s at 100 Hz


class TransformPublisher:
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
        if self._static and not self._differs_from_latest(transform):
            return
        self._sent.append(transform)
        self._children.add(child)
        self._publisher.publish(self._kind(transforms=[transform]))

    def _differs_from_latest(self, transform: Any) -> bool:
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


@dataclass
class _Frame:
    """A frame: its parent, and its poses in it by stamp, ns; a fixed one has no stamps."""

    parent: str
    poses: list[Pose] = field(default_factory=list)
    stamps: list[int] = field(default_factory=list)

    def add(self, stamp: int, pose: Pose) -> None:
        if self.stamps and stamp <= self.stamps[-1]:
            if stamp == self.stamps[-1]:
                return
            self.stamps, self.poses = [], []  # a recording that starts over
        self.stamps.append(stamp)
        self.poses.append(pose)
        del self.stamps[:-_MAX_LENGTH], self.poses[:-_MAX_LENGTH]

    def pose_at(self, stamp: int) -> Pose | None:
        if not self.stamps:
            return self.poses[-1]
        after = bisect_left(self.stamps, stamp)
        if after < len(self.stamps) and self.stamps[after] == stamp:
            return self.poses[after]
        if not 0 < after < len(self.stamps):
            return None
        first, second = self.stamps[after - 1 : after + 1]
        before, behind = self.poses[after - 1 : after + 1]
        change = behind.difference(before) * (stamp - first) / (second - first)
        return Pose(*before.retract(change))


class FrameTree:
    """What /tf and /tf_static have told so far."""

    def __init__(self) -> None:
        self._frames: dict[str, _Frame] = {}

    def add(self, parent: str, child: str, pose: Pose, stamp: int | None) -> None:
        """Take in where a frame stands in its parent; stamp: ns, None for what is fixed."""
        known = self._frames.get(child)
        if known is None or known.parent != parent or (stamp is None and known.stamps):
            known = self._frames[child] = _Frame(parent)
        if stamp is None:
            known.poses = [pose]
        else:
            known.add(stamp, pose)

    def find(self, frame: str, child: str, stamp: int) -> Pose | None:
        """Return the pose of one frame in another at a time, ns; None where it is not known."""
        up, down = self._ancestors(frame), self._ancestors(child)
        common = next((one for one in down if one in up), None)
        if common is None:
            return None
        mine, other = (
            self._in_ancestor(frame, common, stamp),
            self._in_ancestor(child, common, stamp),
        )
        return None if mine is None or other is None else mine.inverse().compose(other)

    def _ancestors(self, frame: str) -> list[str]:
        chain = [frame]
        while chain[-1] in self._frames and self._frames[chain[-1]].parent not in chain:
            chain.append(self._frames[chain[-1]].parent)
        return chain

    def _in_ancestor(self, frame: str, ancestor: str, stamp: int) -> Pose | None:
        pose = identity()
        while frame != ancestor:
            own = self._frames[frame].pose_at(stamp)
            if own is None:
                return None
            pose, frame = own.compose(pose), self._frames[frame].parent
        return pose


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
