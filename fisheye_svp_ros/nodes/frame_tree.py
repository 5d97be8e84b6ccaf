"""Frames as tf2 knows them: where one stands in another, at a time."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field

from fisheye_svp_ros.pose import Pose, identity

_MAX_LENGTH = 1000  # poses of a moving frame that are kept, 10 s at 100 Hz


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

    def at(self, stamp: int) -> Pose | None:
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
            own = self._frames[frame].at(stamp)
            if own is None:
                return None
            pose, frame = own.compose(pose), self._frames[frame].parent
        return pose
