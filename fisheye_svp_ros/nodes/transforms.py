"""Transforms on /tf and /tf_static: poses published there, and frames that others publish."""

from __future__ import annotations

import functools
import time
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, NamedTuple

import numpy as np
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
_RESTART = 2 * 10**9  # ns by which a stamp is older than the latest: a recording starts over
_MAX_GAP = 1 << 62  # ns: any
_WARNING_INTERVAL = 0.5  # s between two of the same
_REMEDY = 'set another camera_frame in one of them, or publish_tf:=false'


class TransformSubscription:
    """Transforms on a topic, also those that the executor has not brought yet (`take`).

    A robot tells much on /tf: one message for each set that is solved would be ever later.
    """

    def __init__(
        self, node: BaseNode, kind: Any, topic: str, hear: Callable[[bytes], None]
    ) -> None:
        self._kind, self._hear = kind, node.guard_callback(hear)
        self._of_rclpy = node.create_subscription(
            kind, topic, self._hear, TRANSFORMS[topic], raw=True
        )
        node.unread.append(self)

    def take(self) -> bool:
        """Take in a message, if there is one; say whether there was."""
        with self._of_rclpy.handle:
            message = self._of_rclpy.handle.take_message(self._kind, True)
        if message is not None:
            self._hear(message[0])
        return message is not None


def publishers_of(node: BaseNode, topic: str) -> str:
    """Return the names of the other nodes that publish a topic, as words of a sentence."""
    own = node.get_name(), node.get_namespace()
    infos = node.get_publishers_info_by_topic(topic)
    names = {one.node_name for one in infos if (one.node_name, one.node_namespace) != own}
    return f'{topic} is published by {", ".join(sorted(names)) or "nobody else"}'


class TransformPublisher:
    """What one node tells tf2, if it is to; static: what holds until it is told anew.

    A frame has one parent (REP 105): where another node publishes the same child, it is said.
    remedy: what to do then.  Raises ParameterError where it is to and tf2_msgs is not installed.
    """

    def __init__(
        self, node: BaseNode, wanted: bool, static: bool = False, remedy: str = _REMEDY
    ) -> None:
        self._node, self._static, self._remedy = node, static, remedy
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
            for topic in TRANSFORMS:
                TransformSubscription(node, self._kind, topic, self._compare)

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
                    f'{transform.header.frame_id!r} ({publishers_of(self._node, "/tf")}); '
                    f'{self._remedy}'
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


class Reason(Enum):
    """Why a pose is not known: not yet, no more, or only far around its time; or no chain."""

    LATE = 'late'
    BEFORE = 'before'
    GAP = 'gap'
    NO_CHAIN = 'no chain'


class Missing(NamedTuple):
    """A pose that is not known: the reason; s from the nearest time with one, or of the gap."""

    reason: Reason
    seconds: float = 0.0


@dataclass
class _Frame:
    """A frame: its parent, and its poses in it by stamp, ns; a fixed one has no stamps."""

    parent: str
    poses: list[Pose] = field(default_factory=list)
    stamps: list[int] = field(default_factory=list)

    def add(self, stamp: int, pose: Pose) -> bool:
        """Take a pose in; say whether one of that time or a later one was there, and differs."""
        if self.stamps and stamp < self.stamps[-1] - _RESTART:
            self.stamps, self.poses = [], []
        place = bisect_left(self.stamps, stamp)
        if place < len(self.stamps) and self.stamps[place] == stamp:
            return bool(np.abs(self.poses[place].difference(pose)).max() > _MIN_CHANGE)
        self.stamps.insert(place, stamp)
        self.poses.insert(place, pose)
        del self.stamps[:-_MAX_LENGTH], self.poses[:-_MAX_LENGTH]
        return stamp < self.stamps[-1]

    def pose_at(self, stamp: int, max_gap: int) -> Pose | Missing:
        """Return the pose at a time, between two that are no further apart than `max_gap`, ns."""
        if not self.stamps:
            return self.poses[-1]
        after = bisect_left(self.stamps, stamp)
        if after == len(self.stamps):
            return Missing(Reason.LATE, (stamp - self.stamps[-1]) / 1e9)
        if self.stamps[after] == stamp:
            return self.poses[after]
        if not after:
            return Missing(Reason.BEFORE, (self.stamps[0] - stamp) / 1e9)
        first, second = self.stamps[after - 1 : after + 1]
        if second - first > max_gap:
            return Missing(Reason.GAP, (second - first) / 1e9)
        before, behind = self.poses[after - 1 : after + 1]
        change = behind.difference(before) * (stamp - first) / (second - first)
        return Pose(*before.retract(change))


class FrameTree:
    """What /tf and /tf_static have told so far; max_gap: ns between poses to interpolate."""

    def __init__(self, max_gap: int = _MAX_GAP) -> None:
        self._frames: dict[str, _Frame] = {}
        self._max_gap = max_gap

    def add(self, parent: str, child: str, pose: Pose, stamp: int | None) -> bool:
        """Take in where a frame stands in its parent; stamp: ns, None for what is fixed.

        Returns whether it cannot be of the publisher of what was there before.
        """
        known = self._frames.get(child)
        if known is None or known.parent != parent or (stamp is None and known.stamps):
            known = self._frames[child] = _Frame(parent)
        if stamp is None:
            known.poses = [pose]
            return False
        return known.add(stamp, pose)

    def find(self, frame: str, child: str, stamp: int) -> Pose | None:
        """Return the pose of one frame in another at a time, ns; None where it is not known."""
        found = self.look_up(frame, child, stamp)
        return None if isinstance(found, Missing) else found

    def look_up(self, frame: str, child: str, stamp: int) -> Pose | Missing:
        """See `find`; or return why it is not known."""
        up, down = self.chain(frame, child)
        if not up:
            return Missing(Reason.NO_CHAIN)
        legs = [self._compose(part, stamp) for part in (up, down)]
        missing = [leg for leg in legs if isinstance(leg, Missing)]
        if missing:
            return missing[0]
        parent, below = (leg for leg in legs if not isinstance(leg, Missing))
        return parent.inverse().compose(below)

    def latest(self, frame: str, child: str) -> int | None:
        """Return the latest time, ns, at which all of a chain is known; None for a fixed one."""
        moving = [
            known.stamps[-1]
            for part in self.chain(frame, child)
            for one in part[:-1]
            if (known := self._frames[one]).stamps
        ]
        return min(moving, default=None)

    def chain(self, frame: str, child: str) -> tuple[list[str], list[str]]:
        """Return both frames, each with its parents up to the common one; nothing for none."""
        up, down = self._ancestors(frame), self._ancestors(child)
        common = next((one for one in down if one in up), None)
        if common is None:
            return [], []
        return up[: up.index(common) + 1], down[: down.index(common) + 1]

    def _ancestors(self, frame: str) -> list[str]:
        chain = [frame]
        while chain[-1] in self._frames and self._frames[chain[-1]].parent not in chain:
            chain.append(self._frames[chain[-1]].parent)
        return chain

    def _compose(self, frames: Sequence[str], stamp: int) -> Pose | Missing:
        """Return the pose of the first of some frames in the last."""
        pose = identity()
        for frame in frames[:-1]:
            own = self._frames[frame].pose_at(stamp, self._max_gap)
            if isinstance(own, Missing):
                return own
            pose = own.compose(pose)
        return pose


class FrameListener:
    """Takes in transforms from `listen` on.

    moved: is called when there is something on /tf; max_gap: s between two transforms that are
    interpolated.
    """

    def __init__(
        self, node: BaseNode, moved: Callable[[], None] | None = None, max_gap: float | None = None
    ) -> None:
        self.tree = FrameTree(_MAX_GAP if max_gap is None else round(1e9 * max_gap))
        self._node, self._moved = node, moved
        self._listens = False
        self._needed: set[str] = set()  # frames that somebody has asked for
        self._told = 0.0  # s

    def listen(self, needed_by: str) -> None:
        """Subscribe; raise ParameterError, naming who needs it, where tf2_msgs is missing."""
        self._kind, self._listens = message_class(needed_by), True
        for topic in TRANSFORMS:
            hear = functools.partial(self._hear, topic == '/tf_static')
            TransformSubscription(self._node, self._kind, topic, hear)

    def find(self, frame: str, child: str, stamp: int) -> Pose | None:
        """Return the pose of one frame in another at a time, ns; None where it is not known.

        The first question is the first that anybody needs to hear of: a robot tells much on /tf.
        """
        if not self._listens:
            with suppress(ParameterError):
                self.listen('frames')
            self._listens = True
        found = self.look_up(frame, child, stamp)
        return None if isinstance(found, Missing) else found

    def look_up(self, frame: str, child: str, stamp: int) -> Pose | Missing:
        """See `FrameTree.look_up`."""
        frame, child = frame.lstrip('/'), child.lstrip('/')
        self._needed.update(*(part[:-1] for part in self.tree.chain(frame, child)))
        return self.tree.look_up(frame, child, stamp)

    def _hear(self, fixed: bool, data: bytes) -> None:
        for transform in deserialize_message(data, self._kind).transforms:
            stamp = None if fixed else stamp_of(transform)
            parent, child = (
                transform.header.frame_id.lstrip('/'),
                transform.child_frame_id.lstrip('/'),
            )
            again = self.tree.add(parent, child, read_transform(transform, '/tf'), stamp)
            if again and child in self._needed:
                self._tell_of_two(parent, child)
        if not fixed and self._moved is not None:
            self._moved()

    def _tell_of_two(self, parent: str, child: str) -> None:
        """Warn, now and then: to ask who publishes takes longer than to read a transform."""
        now = time.monotonic()
        if now - self._told > _WARNING_INTERVAL:
            self._told = now
            self._node.warn(
                f'/tf: {child!r} in {parent!r} comes twice, with stamps that go back; '
                f'{publishers_of(self._node, "/tf")}; stop all but one that publishes {child!r}'
            )
