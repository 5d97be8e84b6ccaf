"""The pose of a robot's base from that of its camera, as robot_localization and Nav2 take it."""

from __future__ import annotations

import time
from collections import deque
from typing import NamedTuple

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped

from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.base import BaseNode
from fisheye_svp_ros.nodes.odometry_transform import OdometryTransform
from fisheye_svp_ros.nodes.transforms import FrameListener, Missing, Reason, publishers_of
from fisheye_svp_ros.pose import Pose, carried_pose
from fisheye_svp_ros.solve.pose_gate import (
    GatedPose,
    GateLimits,
    OdometryGate,
    Verdict,
    weakness,
)
from fisheye_svp_ros.study.settings import RobotSettings

_MAX_WAITING = 30  # poses that wait for transforms of their time
_LONGEST_WAIT = 2.0  # s that a pose does
_ON_SIDE, _UPRIGHT = 0.5, 0.94  # cosines of the angle between the z axes of base and world
# Axes of an optical frame in that of its camera link: x right, y down, z ahead (REP 103)
_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


class _Waiting(NamedTuple):
    """A pose, its stamp, ns, and since when it waits, s.

    camera: its frame id while the pose is that of the camera; '' once it is that of the base.
    """

    pose: GatedPose
    stamp: int
    world: str
    camera: str
    since: float


class BasePose:
    """Publishes `~/base_pose` and, with an odometry frame, map -> odom on /tf as amcl does.

    Poses that a robot should not act on are kept back, see `solve.pose_gate`.  The camera in the
    base is looked up on /tf_static and /tf, at the time of the image: a pose waits until that is
    there.  Raises ParameterError for frames that cannot belong together, and where tf2_msgs is not
    installed.
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
        self._node, self._base, self._odom, self._gap = node, base, odom, settings.transform_gap
        self._frames = FrameListener(node, self._work_off, settings.transform_gap)
        self._waiting: deque[_Waiting] = deque(maxlen=_MAX_WAITING)
        self._since = 0.0  # s: the time of the first pose
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
        self._frames.listen('base_frame')
        self._publisher = node.announce(PoseWithCovarianceStamped, '~/base_pose')
        if odom:
            self._transform = OdometryTransform(
                node, base, odom, self._frames, settings.transform_tolerance
            )

    def mount(self, frame: str, stamp: int) -> Pose | None:
        """Return the base in the frame of a camera; None where there is none, or it is unknown."""
        return self._frames.find(frame, self._base, stamp) if self._base else None

    def publish(self, camera: GatedPose, stamp: int, world: str, frame: str) -> str:
        """Publish the base that carries a camera; return why not, or what is doubtful in it.

        camera: its pose in place of that of the base; frame: its frame id.
        """
        if not self._base:
            return ''
        now = time.monotonic()
        self._since = self._since or now
        self._drop_expired(now)
        return self._advance(_Waiting(camera, stamp, world, frame, now))

    def _advance(self, one: _Waiting) -> str:
        """Take a pose as far as there are transforms of its time; see `publish`."""
        if not one.camera:
            return self._publish_odometry(one)
        mount = self._frames.look_up(one.camera, self._base, one.stamp)
        if isinstance(mount, Missing):
            return self._wait(one, mount)
        base, covariance = carried_pose(one.pose.base, one.pose.covariance, mount)
        pose = one.pose._replace(base=base, covariance=covariance)
        if reason := weakness(pose, self._limits):
            self._kept_back += 1
            return f'no base_pose: {reason}'
        odometry = self._odometry(one.stamp)
        verdict = self._gate.judge(pose, odometry) if isinstance(odometry, Pose) else Verdict()
        if verdict.refused:
            self._kept_back += 1
            return f'no base_pose: {verdict.refused}'
        self._publisher.publish(
            messages.pose_with_covariance_message(base, covariance, one.stamp, one.world)
        )
        if isinstance(odometry, Pose):
            self._publish_transform(pose, odometry, one)
            waits = ''
        else:
            waits = self._wait(one._replace(pose=pose, camera=''), odometry) if self._odom else ''
        doubts = verdict.unconfirmed, waits, self._frame_doubt(one, base, mount)
        return '; '.join(filter(None, doubts))

    def _publish_odometry(self, one: _Waiting) -> str:
        """Publish where the odometry stands in the world, for a base that waited for it."""
        odometry = self._odometry(one.stamp)
        if isinstance(odometry, Missing):
            return self._wait(one, odometry)
        verdict = self._gate.judge(one.pose, odometry)
        if verdict.refused:
            self._kept_back += 1
            return f'no transform to {self._odom!r}: {verdict.refused}'
        self._publish_transform(one.pose, odometry, one)
        return verdict.unconfirmed and f'transform to {self._odom!r}: {verdict.unconfirmed}'

    def _publish_transform(self, pose: GatedPose, odometry: Pose, one: _Waiting) -> None:
        self._transform.publish(pose.base.compose(odometry.inverse()), one.stamp, one.world)

    def _odometry(self, stamp: int) -> Pose | Missing:
        if not self._odom:
            return Missing(Reason.NO_CHAIN)
        return self._frames.look_up(self._odom, self._base, stamp)

    def _wait(self, one: _Waiting, missing: Missing) -> str:
        """Let a pose wait for a transform that may still come; say why one cannot."""
        waits = missing.reason == Reason.LATE or (
            missing.reason == Reason.NO_CHAIN and not one.camera
        )
        if waits:
            self._waiting.append(one)
            return ''
        if missing.reason == Reason.BEFORE and one.since < self._since + _LONGEST_WAIT:
            return ''  # at the start images may be there before transforms
        return self._explain(one, missing)

    def _explain(self, one: _Waiting, missing: Missing) -> str:
        """Say what is not published for want of which transform."""
        parent, child = (self._base, one.camera) if one.camera else (self._odom, self._base)
        lacks = 'base_pose' if one.camera else f'transform to {self._odom!r} (odom_frame)'
        if missing.reason == Reason.NO_CHAIN:
            remedy = (
                'publish it, e. g. with robot_state_publisher'
                if one.camera
                else 'check the odometry'
            )
            return (
                f'no {lacks}: neither /tf_static nor /tf has a chain from {parent!r} '
                f'({"base_frame" if one.camera else "odom_frame"}) to {child!r}; {remedy}'
            )
        edge = f'{child!r} in {parent!r}'
        who = publishers_of(self._node, '/tf')
        if missing.reason == Reason.GAP:
            return (
                f'no {lacks}: {edge} has a gap of {missing.seconds:.2f} s on /tf, above '
                f'transform_gap ({self._gap:g} s); {who}'
            )
        when = (
            f'ends {missing.seconds:.2f} s before'
            if missing.reason == Reason.LATE
            else f'begins {missing.seconds:.2f} s after'
        )
        return f'no {lacks}: {edge} on /tf {when} the image; {who}'

    def _frame_doubt(self, one: _Waiting, base: Pose, mount: Pose) -> str:
        """Say that a base lies on its side which would stand if the camera's frame were optical.

        mount: the base in that frame.
        """
        up = float(base.rotation[2, 2])
        optical = one.pose.base.rotation @ _OPTICAL.T @ mount.rotation
        if not (abs(up) < _ON_SIDE and optical[2, 2] > _UPRIGHT):
            return ''
        return (
            f'base_pose: {self._base!r} lies {np.degrees(np.arccos(up)):.0f} deg on its side, '
            f'as if frame_id {one.camera!r} were not optical. Name the optical frame (REP 103: '
            'x right, y down, z ahead)'
        )

    def _drop_expired(self, now: float) -> None:
        """Drop the pose that has waited too long, or is one too many, and tell of it."""
        expired = self._waiting[0] if len(self._waiting) == _MAX_WAITING else None
        while self._waiting and now - self._waiting[0].since > _LONGEST_WAIT:
            expired = self._waiting.popleft()
        if expired is not None:
            parent, child = (
                (self._base, expired.camera) if expired.camera else (self._odom, self._base)
            )
            missing = self._frames.look_up(parent, child, expired.stamp)
            if isinstance(missing, Missing):
                self._node.warn(self._explain(expired, missing))

    def _work_off(self) -> None:
        """Take the poses that wait as far as there are transforms of their time."""
        for _ in range(len(self._waiting)):
            if text := self._advance(self._waiting.popleft()):
                self._node.warn(text)

    def report(self) -> dict[str, object]:
        """Return what /diagnostics holds of it."""
        return {'sets: kept back from base_pose and /tf': self._kept_back} if self._base else {}
