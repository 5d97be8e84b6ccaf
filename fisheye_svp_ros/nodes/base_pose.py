"""The pose of a robot's base from that of its camera, as robot_localization and Nav2 take it."""

from __future__ import annotations

import time
from collections import deque
from typing import NamedTuple

from geometry_msgs.msg import PoseWithCovarianceStamped

from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.base import BaseNode
from fisheye_svp_ros.nodes.quality import TRANSFORMS
from fisheye_svp_ros.nodes.transforms import FrameListener, TransformPublisher
from fisheye_svp_ros.pose import Pose, carried_pose
from fisheye_svp_ros.solve.pose_gate import (
    GatedPose,
    GateLimits,
    OdometryGate,
    Verdict,
    weakness,
)
from fisheye_svp_ros.study.settings import RobotSettings

_MAX_WAITING = 30  # poses that wait for odometry of their time
_LONGEST_WAIT = 2.0  # s that a pose does


class _Waiting(NamedTuple):
    """The pose of a base in its world, the stamp, ns, and since when it waits, s."""

    pose: GatedPose
    stamp: int
    world: str
    since: float


class BasePose:
    """Publishes `~/base_pose` and, with an odometry frame, map -> odom on /tf as amcl does.

    Poses that a robot should not act on are kept back, see `solve.pose_gate`.  The camera in the
    base is looked up on /tf_static.  Raises ParameterError for frames that cannot belong together,
    and where tf2_msgs is not installed.
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
        self._limits = GateLimits(
            settings.max_std_m,
            settings.max_std_rad,
            settings.allow_ambiguous,
            settings.max_innovation,
            settings.odom_error,
        )
        self._gate = OdometryGate(self._limits)
        self._kept_back = 0
        if not base:
            return
        topics = [topic for topic in TRANSFORMS if odom or topic == '/tf_static']
        self._frames.listen('base_frame', topics)
        self._publisher = node.announce(PoseWithCovarianceStamped, '~/base_pose')
        self._transforms = TransformPublisher(node, bool(odom))

    def mount(self, frame: str, stamp: int) -> Pose | None:
        """Return the base in the frame of a camera; None where there is none, or it is unknown."""
        return self._frames.find(frame, self._base, stamp) if self._base else None

    def publish(self, camera: GatedPose, stamp: int, world: str, frame: str) -> str:
        """Publish the base that carries a camera; return why not, or what is doubtful in it.

        camera: its pose in place of that of the base; frame: its frame id.
        """
        if not self._base:
            return ''
        mount = self.mount(frame, stamp)
        if mount is None:
            self._node.warn(
                f'no base_pose: /tf_static has no chain from {self._base!r} (base_frame) to '
                f'{frame!r}; publish it, e. g. with robot_state_publisher'
            )
            return ''
        base, covariance = carried_pose(camera.base, camera.covariance, mount)
        pose = camera._replace(base=base, covariance=covariance)
        if reason := weakness(pose, self._limits):
            self._kept_back += 1
            return f'no base_pose: {reason}'
        odometry = self._frames.find(self._odom, self._base, stamp) if self._odom else None
        verdict = Verdict() if odometry is None else self._gate.judge(pose, odometry)
        if verdict.refused:
            self._kept_back += 1
            return f'no base_pose: {verdict.refused}'
        self._publisher.publish(
            messages.pose_with_covariance_message(base, covariance, stamp, world)
        )
        if odometry is not None:
            self._transforms.publish(base.compose(odometry.inverse()), stamp, world, self._odom)
        elif self._odom:
            self._drop_expired()
            self._waiting.append(_Waiting(pose, stamp, world, time.monotonic()))
        return verdict.unconfirmed

    def report(self) -> dict[str, object]:
        """Return what /diagnostics holds of it."""
        return {'sets: kept back from base_pose and /tf': self._kept_back} if self._base else {}

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
            pose, stamp, world, _ = one
            there = self._frames.find(self._odom, self._base, stamp)
            if there is None:
                self._waiting.append(one)
                continue
            verdict = self._gate.judge(pose, there)
            if verdict.refused:
                self._kept_back += 1
                self._node.warn(f'no transform to {self._odom!r}: {verdict.refused}')
                continue
            if verdict.unconfirmed:
                self._node.warn(f'transform to {self._odom!r}: {verdict.unconfirmed}')
            self._transforms.publish(pose.base.compose(there.inverse()), stamp, world, self._odom)
