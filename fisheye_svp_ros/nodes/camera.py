"""What both cameras share: their topics, and the pace at which they step through their sets."""

from __future__ import annotations

import re
import time
from abc import abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.duration import Duration
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from fisheye_svp_ros.arrays import Index
from fisheye_svp_ros.detect.photographs import Pixels
from fisheye_svp_ros.errors import FisheyeSvpError, ParameterError
from fisheye_svp_ros.io import decoding
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.base import BaseNode, NodeExit, NodeFailure
from fisheye_svp_ros.nodes.quality import LATCHED_SETS, SENSOR
from fisheye_svp_ros.nodes.session import RCLError
from fisheye_svp_ros.nodes.subscriptions import LIMIT
from fisheye_svp_ros.nodes.transforms import TransformPublisher
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Landmarks, Observations
from fisheye_svp_ros.study.settings import CameraSettings

_TOPIC = re.compile(r'(~/|/)?[A-Za-z_]\w*(/[A-Za-z_]\w*)*', re.ASCII)
_CAMERA_FRAME = 'camera_optical_frame'
_CLOCK_RESET_NS = 10**9  # ns by which a clock is not early but set back
_REPUBLISH_TIMEOUT = 15.0  # s without an answer after which a set is published again
_DELIVERY_TIMEOUT = 20.0  # s for which the end waits for subscribers that are held up


class CameraTopics:
    """The topics of one camera; name: its namespace, empty for the only camera.

    has_truth: whether true poses are known; a solver waits for them if they are announced.
    """

    def __init__(self, node: CameraNode, name: str, photographs: bool, has_truth: bool) -> None:
        prefix, settings = f'{name}/' if name else '', node.settings
        self._prefix, self._photographs = prefix, photographs
        self._world, self._transforms = settings.world_frame, node.transforms
        # Cameras in several namespaces are several cameras, also for tf2.
        space = [] if settings.camera_frame else node.get_namespace().strip('/').split('/')
        words = [*space, name, settings.camera_frame or _CAMERA_FRAME]
        self.frame = '_'.join(filter(None, words))
        self._info = node.announce(CameraInfo, f'{prefix}camera_info', LATCHED_SETS)
        self._pose: Any = None
        if has_truth:
            self.announce_truth(node)
        self._images = self._points = None
        if photographs:
            self._images = node.announce(Image, f'{prefix}image', SENSOR)
        else:
            self._points = node.announce(PointCloud2, f'{prefix}image_points', wait=True)

    def announce_truth(self, node: CameraNode) -> None:
        """Announce true poses, unless they are."""
        if self._pose is None:
            # Who solves listens to the true pose, but not to images.
            self._pose = node.announce(
                PoseStamped, f'{self._prefix}true_pose', wait=self._photographs
            )

    @property
    def unwatched_topic(self) -> str:
        """The topic of images that nobody looks at; empty where there is none."""
        if self._images is None or self._images.get_subscription_count():
            return ''
        return str(self._images.topic_name)

    def publish(
        self, stamp: int, observations: Observations | Pixels, pose: Pose | None, lens: Lens | None
    ) -> None:
        """Publish one set: image points or an image, and what is known of pose and lens."""
        if lens is not None:
            self._info.publish(messages.camera_info_message(lens, stamp, self.frame))
        if pose is not None:
            self._pose.publish(messages.pose_message(pose, stamp, self._world))
            self._transforms.publish(pose, stamp, self._world, f'{self.frame}_true')
        if self._points is not None and isinstance(observations, Observations):
            self._points.publish(
                messages.image_points_message(
                    observations.landmark, observations.uv, stamp, self.frame
                )
            )
        if self._images is not None and isinstance(observations, np.ndarray):
            self._images.publish(messages.image_message(observations, stamp, self.frame))


class CameraNode(BaseNode):
    """Publishes sets one after the other, at a rate or in lock-step with those who answer."""

    settings: CameraSettings
    photographs = False  # in place of landmarks and image points

    def __init__(self, node_name: str | None = None, **options: Any) -> None:
        super().__init__(node_name, **options)
        self._landmarks = (
            None if self.photographs else self.announce(PointCloud2, 'landmarks', LATCHED_SETS)
        )
        self._scenario = self.announce(DiagnosticArray, 'scenario')
        self.transforms = TransformPublisher(self, self.settings.publish_tf)
        self._cameras: dict[str, CameraTopics] = {}
        self._timer: Any = None
        self._steps: Iterator[Any] = iter(())
        self._answering: set[str] = set()
        self._unanswered: set[str] = set()
        self._step: Any = None
        self._stamp = 0
        self._sent = 0.0
        self._begun, self._is_reported = time.monotonic(), False

    def prepare(self, settings: Any) -> Any:
        """Refuse topics to wait for whose names are none."""
        for topic in settings.lock_step.split():
            if not _TOPIC.fullmatch(topic):
                raise ParameterError(f'lock_step: {topic[:100]!r} is not the name of a topic')
        return settings

    def unheard_topics(self) -> list[str]:
        """Return the topics that more have to listen to, images that nobody looks at among them.

        That is of all cameras: one that is heard later would miss the first sets.
        """
        if not self.settings.wait_for_subscribers:
            return []
        unwatched = (camera.unwatched_topic for camera in self._cameras.values())
        return [*super().unheard_topics(), *filter(None, unwatched)]

    @abstractmethod
    def publish_set(self, step: Any, stamp: int) -> None:
        """Publish one set."""

    def stamp_of(self, step: Any) -> int:
        """Return the stamp of a set, ns: the present time, later than the one before it.

        Where the clock was set back, as by a recording that starts over, stamps follow it.
        """
        now = int(self.get_clock().now().nanoseconds)
        return now if now < self._stamp - _CLOCK_RESET_NS else max(now, self._stamp + 1)

    def play(self, steps: Iterator[Any]) -> None:
        """Start stepping through other sets."""
        self._steps = steps
        self._unanswered.clear()
        for topic in self.settings.lock_step.split():
            if topic not in self._answering:
                self._hear_answers_on(topic)
        if self._timer is not None:
            self.destroy_timer(self._timer)
        self._timer = self.start_timer(1 / self.settings.rate, self._tick, self.get_clock())

    def camera(self, name: str, has_truth: bool = True) -> CameraTopics:
        """Return the topics of a camera; has_truth: whether its true poses are known."""
        if name not in self._cameras:
            self._cameras[name] = CameraTopics(self, name, self.photographs, has_truth)
        elif has_truth:
            self._cameras[name].announce_truth(self)
        return self._cameras[name]

    def tag(self, stamp: int, values: Mapping[str, Any], text: str = '') -> None:
        """Say which scenario the set of a stamp belongs to."""
        self._scenario.publish(messages.key_values_message('scenario', values, stamp, text))

    def publish_landmarks(self, landmarks: Landmarks, stamp: int) -> None:
        """Publish landmarks; stamp 0: they hold for every set."""
        if self._landmarks is not None:
            self._landmarks.publish(
                messages.landmarks_message(landmarks, stamp, self.settings.world_frame)
            )

    def _hear_answers_on(self, topic: str) -> None:
        def use(stamp: int, _: Any) -> None:
            if stamp == self._stamp and topic in self._unanswered:
                self._unanswered.discard(topic)
                if not self._unanswered:
                    self._advance()

        self._answering.add(topic)
        self.listen(DiagnosticArray, topic, decoding.read_key_values, use)

    def _tick(self) -> None:
        if not self._unanswered:
            if self.has_listeners():
                self._advance()
            else:
                self._report_unheard()
        elif time.monotonic() - self._sent > _REPUBLISH_TIMEOUT:
            # Who answers may not have known of this node yet when it did.
            waiting = ' '.join(sorted(self._unanswered))
            self.get_logger().warning(f'no answer on {waiting}; the set is published again')
            self._send()

    def _report_unheard(self) -> None:
        """Log once which topics the camera waits for, where that takes long."""
        if not self._is_reported and time.monotonic() - self._begun > LIMIT:
            self._is_reported = True
            self.get_logger().warning(
                'nothing is published yet: wait_for_subscribers is '
                f'{self.settings.wait_for_subscribers}, and too few listen to '
                + ', '.join(self.unheard_topics())
            )

    def _advance(self) -> None:
        try:
            self._step = next(self._steps, None)
        except FisheyeSvpError as error:  # a file that was there at the start is not any more
            raise NodeFailure(str(error)) from error
        if self._step is None:
            self._timer.cancel()
            self._deliver()
            raise NodeExit('all sets are published')
        self._stamp = self.stamp_of(self._step)
        self._send()

    def _send(self) -> None:
        self._unanswered = set(self.settings.lock_step.split())
        self._sent = time.monotonic()
        self.publish_set(self._step, self._stamp)

    def _deliver(self) -> None:
        """Wait until reliable subscriptions have what was sent: it is lost with its publisher."""
        end = time.monotonic() + _DELIVERY_TIMEOUT
        for publisher in self.publishers:
            left = max(end - time.monotonic(), 0.0)
            with suppress(RCLError):  # of a middleware that cannot tell
                publisher.wait_for_all_acked(Duration(seconds=left))


def rows_by_frame(observations: Observations) -> dict[tuple[int, str], Index]:
    """Return which rows belong to each frame of each camera, by frame and camera name."""
    order = np.lexsort((observations.camera, observations.frame))
    keys = np.stack([observations.frame, observations.camera], axis=-1)[order]
    starts = np.flatnonzero(np.any(np.diff(keys, axis=0, prepend=keys[:1] - 1), axis=1))
    groups = np.split(order, starts[1:]) if len(order) else []
    frame, camera = observations.frame, observations.camera
    return {(int(frame[r[0]]), observations.cameras[camera[r[0]]]): r for r in groups}
