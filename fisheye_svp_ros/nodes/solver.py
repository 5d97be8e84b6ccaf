"""What the solving nodes share: one set of inputs by stamp in, one result by stamp out."""

from __future__ import annotations

import functools
import time
from abc import abstractmethod
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import CameraInfo, PointCloud2
from std_msgs.msg import Float64

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import FisheyeSvpError, ObservationError, ParameterError
from fisheye_svp_ros.io.decoding import (
    ImagePoints,
    LandmarkSet,
    read_camera_info,
    read_image_points,
    read_key_values,
    read_landmarks,
    read_pose,
)
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.access import allowed
from fisheye_svp_ros.nodes.base import LATCHED_INPUT, SENSOR_INPUT
from fisheye_svp_ros.nodes.camera_info import CAMERA_INFO, CameraInfos
from fisheye_svp_ros.nodes.inputs import Unread
from fisheye_svp_ros.nodes.join import LIMIT, Pending, StampJoin
from fisheye_svp_ros.nodes.lenses import lens_of, lenses_of, shift_scale
from fisheye_svp_ros.nodes.lifecycle import ManagedNode
from fisheye_svp_ros.optics import engines
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import STEREO, Views
from fisheye_svp_ros.study.settings import SolverSettings
from fisheye_svp_ros.study.solutions import Pair

Items = Mapping[str, Any]


_UNREAD = 5 * LIMIT  # messages to look at while there is nothing to solve
_LONGEST_DRAIN = 0.05  # s of taking in before a set is solved, come what may
_NONE = 'no landmarks; publish them on `landmarks`'
_NONE_OF_STAMP = ('no landmarks of its stamp in time: they were late, lost because too much comes '
                  'at once, or never sent')


@dataclass
class Counts:
    """What became of the sets so far."""

    taken: int = 0
    solved: int = 0
    unsolved: int = 0
    dropped: int = 0
    incomplete: int = 0


class _Arrivals:
    """When to stop taking in and solve; and how late the sets are."""

    def __init__(self) -> None:
        self.count = 0  # of messages
        self.latency = 0.0  # s, of the latest set
        self._seen = 0
        self._since = self._restarted = time.monotonic()

    def go_on(self, now: float) -> bool:
        """Say whether more may be waiting to be taken in."""
        fresh, self._seen = self.count != self._seen, self.count
        if fresh and now - self._since < _LONGEST_DRAIN:
            return True
        self._since = now
        return False

    def done(self, now: float, began: float) -> None:
        """Take note that a set is solved."""
        self._since, self.latency = now, now - began

    def restart(self) -> float:
        """Return the seconds since the last call."""
        before, self._restarted = self._restarted, time.monotonic()
        return max(self._restarted - before, 1e-3)


class SolverNode(ManagedNode):
    """Joins landmarks, image points, true poses and scenario by stamp; `solve` does the rest.

    CAMERAS: the namespaces of the cameras, each with its slash; METRICS: all names in results;
    BY_SCENARIO: the scenario matters even where the lens is given.
    """

    CAMERAS: ClassVar[tuple[str, ...]] = ('',)
    BY_SCENARIO: ClassVar[bool] = False
    METRICS: ClassVar[tuple[str, ...]]
    settings: SolverSettings

    def __init__(self) -> None:
        super().__init__()
        engines.settle(engines.LOADING)  # a node runs for long, but its start must not
        self._metrics = {
            name: self.announce(Float64, f'~/metrics/{name}') for name in self.METRICS
        }
        self._image_points = tuple(f'{camera}image_points' for camera in self.cameras)
        poses = [f'{camera}true_pose' for camera in self.cameras]
        self._join = StampJoin(self._image_points, [*poses, 'landmarks', 'scenario'])
        self._backlog: deque[Pending] = deque()
        self._unread: deque[tuple[int, str]] = deque(maxlen=_UNREAD)
        self._counts = Counts()
        self._reported = Counts()
        self._arrivals = _Arrivals()
        self._standing: LandmarkSet | None = None
        self._in_series = False
        self._lenses: dict[str, Lens] = {}  # those of the parameter lens
        self._infos = CameraInfos(self.get_logger().info)
        self._models: dict[str, tuple[Lens, ForwardModel]] = {}  # the latest, by camera
        self._wake = self.create_guard_condition(self.guarded(self._work))
        self.collect(
            PointCloud2, 'landmarks', read_landmarks, self._hear_landmarks, LATCHED_INPUT
        )
        self._collect(DiagnosticArray, 'scenario', read_key_values)
        for topic in poses:
            self._collect(PoseStamped, topic, read_pose)
        # Last, because a camera that sees this subscription counts on the others.
        for topic in self._image_points:
            self._collect(PointCloud2, topic, read_image_points)
        self.every(0.1, self._wake.trigger)

    def start(self) -> None:
        """Take the parameters into use, as every node does; call it after all `announce`."""
        # Last, because a recorder that sees this topic counts on having seen the others.
        self._result = self.announce(DiagnosticArray, '~/result', wait=True)
        super().start()

    @property
    def cameras(self) -> tuple[str, ...]:
        """The namespaces of the cameras, each with its slash."""
        return self.CAMERAS

    def prepare(self, settings: SolverSettings) -> SolverSettings:
        """Refuse a lens that cannot be loaded."""
        if settings.lens not in ('', CAMERA_INFO):
            lenses_of(settings, self.cameras)
        return settings

    def configure(self, settings: SolverSettings) -> None:
        """Load the lens and say which; do not wait for a scenario that nobody needs."""
        told = settings.lens in ('', CAMERA_INFO)
        self._lenses = {} if told else lenses_of(settings, self.cameras)
        if settings.lens == CAMERA_INFO:
            self._listen_to_camera_info()
        if settings.lens and not self.BY_SCENARIO:
            self._join.expect_no_more('scenario')
        lens = (f'lens {settings.lens}' if not told else
                f'lens of {CAMERA_INFO}' if settings.lens else 'lens that scenario names')
        how = 'without its viewpoint shift' if settings.solves_svp else 'as it stands'
        self.get_logger().info(f'solving with the {lens} {how} (svp: {settings.svp})')

    @abstractmethod
    def solve(self, stamp: int, landmarks: LandmarkSet, items: Items) -> None:
        """Solve one set and publish what comes out; items by topic."""

    def model(self, stamp: int, items: Items, camera: str = '') -> ForwardModel:
        """Return what to solve with, as `lens` does."""
        lens, known = self.lens(stamp, items, camera), self._models.get(camera)
        if known is None or known[0] is not lens:
            known = self._models[camera] = lens, ForwardModel(lens)
        return known[1]

    def models(self, stamp: int, items: Items) -> Pair:
        """Return what to solve with for each camera of a rig, as `lens` does."""
        left, right = (self.model(stamp, items, camera) for camera in self.cameras)
        return left, right

    def lens(self, stamp: int, items: Items, camera: str = '') -> Lens:
        """Return the lens to solve the set of a camera with, its shift left out where it is to be.

        camera: its namespace, with its slash.  Raises FisheyeSvpError where nobody names a lens.
        """
        if self._lenses:
            if camera not in self._lenses:
                raise ParameterError(f'lens {self.settings.lens}: it holds several cameras, and '
                                     'one lens is needed; add # and the name of one')
            return self._lenses[camera]
        if self.settings.lens == CAMERA_INFO:
            return self._infos.lens(f'{camera}{CAMERA_INFO}', stamp)
        scenario = items.get('scenario', {})
        if 'lens' not in scenario:
            raise ParameterError('no scenario names a lens; set the parameter lens')
        name = allowed(scenario['lens'], self.settings.folder, 'scenario: lens')
        scale = shift_scale(scenario.get('shift_scale', '1.0'))
        return lens_of(name, scale, self.settings)

    def views(self, stamp: int, landmarks: LandmarkSet, seen: ImagePoints) -> Views:
        """Return image points as one view; raise ObservationError for an unknown landmark."""
        points = known_points(landmarks, seen)
        shape = 1, len(points)
        return Views(
            points=points[None],
            uv=seen.uv[None],
            weight=np.full(shape, 1 / self.settings.sigma_px),
            landmark=seen.landmark[None],
            board=np.zeros(shape, dtype=np.int64),
            t=np.full(shape, stamp / 1e9),
            frame=np.array([stamp]),
            camera=np.zeros(1, dtype=np.int64),
            row=np.arange(len(points))[None],
        )

    def publish_result(
        self, stamp: int, metrics: Mapping[str, Array], problem: str = ''
    ) -> None:
        """Publish the metrics (1,) of one set, together and one by one."""
        name = self.get_fully_qualified_name()
        values = {key: float(value[0]) for key, value in metrics.items()}
        for key, value in values.items():
            self._metrics[key].publish(messages.number_message(value))
        level = DiagnosticStatus.WARN if problem else DiagnosticStatus.OK
        self._result.publish(messages.key_values_message(name, values, stamp, problem, level))

    def report(self) -> tuple[Mapping[str, object], str]:
        """Return what became of every set, and whether this node keeps up.

        taken = solved + not solved + dropped + incomplete + waiting, at any time.
        """
        counts, before, seconds = self._counts, self._reported, self._arrivals.restart()
        self._reported = replace(counts)
        waiting = len(self._backlog) + len(self._join)
        came = (counts.taken - before.taken) / seconds
        done = (counts.solved + counts.unsolved - before.solved - before.unsolved) / seconds
        latency = self._arrivals.latency
        told = {
            'sets: taken': counts.taken, 'sets: solved': counts.solved,
            'sets: not solved': counts.unsolved, 'sets: dropped': counts.dropped,
            'sets: incomplete': counts.incomplete, 'sets: waiting': waiting,
            'sets: come per second': round(came, 1), 'sets: done per second': round(done, 1),
            'sets: latency_s': round(latency, 4),
        }
        if counts.dropped == before.dropped:
            return told, ''
        return told, (f'cannot keep up: {came:.0f} sets come in a second and {done:.0f} are '
                      f'solved, {latency:.2f} s late; {waiting} wait, {counts.dropped} are '
                      'dropped')

    def _listen_to_camera_info(self) -> None:
        def hear(topic: str, stamp: int, unread: Unread) -> None:
            self._infos.hear(topic, stamp, unread)
            self._join.expect_no_more(topic)
            self._wake.trigger()

        for topic in (f'{camera}{CAMERA_INFO}' for camera in self.cameras):
            if not self.listens_to(topic):
                self._join.expect(topic)
                self.collect(CameraInfo, topic, read_camera_info, functools.partial(hear, topic),
                             LATCHED_INPUT, SENSOR_INPUT)

    def _collect(self, kind: Any, topic: str, read: Any) -> None:
        self.collect(kind, topic, read, functools.partial(self._add, topic))

    def _add(self, topic: str, stamp: int, item: Unread) -> None:
        self._counts.taken += self._join.add(topic, stamp, item, time.monotonic())
        self._unread.append((stamp, topic))
        self._arrivals.count += 1
        self._wake.trigger()

    def _hear_landmarks(self, stamp: int, unread: Unread) -> None:
        if stamp:
            self._add('landmarks', stamp, unread)
        else:
            self._in_series = False
        if not self._in_series:
            self._standing = unread.read()
        if not stamp:
            self._join.expect_no_more('landmarks')
            self._wake.trigger()

    def _work(self) -> None:
        """Do one thing: take all in that has come, then solve a set, then look at the rest."""
        now, patience = time.monotonic(), self.settings.patience
        if self._arrivals.go_on(now):
            self._wake.trigger()
            return
        self._backlog.extend(self._join.ready(now, patience))
        for one in self._join.given_up(now, patience):
            self._give_up(one)
        while len(self._backlog) > self.settings.backlog:
            self._backlog.popleft()
            self._counts.dropped += 1
        if not self.has_listeners():
            return
        if self._backlog:
            one = self._backlog.popleft()
            self._attempt(one)
            self._arrivals.done(time.monotonic(), one.since)
        elif self._unread:
            self._look_at(*self._unread.popleft())
        if self._backlog or self._unread:
            self._wake.trigger()

    def _look_at(self, stamp: int, topic: str) -> None:
        """Decode what waits for the rest of its set, so that bad input is told of at once."""
        items = self._join.items(stamp)
        if not isinstance(items.get(topic), Unread):
            return
        try:
            items[topic] = items[topic].read()
        except FisheyeSvpError as error:
            self.drop(topic, error)
            del items[topic]
            if topic in self._image_points:
                self._join.forget(stamp)
                self._fail(stamp, str(error))

    def _attempt(self, one: Pending) -> None:
        topic = self._image_points[0]
        try:
            items = self._contents(one.items)
            landmarks: LandmarkSet | None = items.get('landmarks', self._standing)
            if 'landmarks' in items:
                # Landmarks come set by set: from now on those of another set never stand in.
                self._in_series, self._standing = True, None
            if landmarks is None:
                raise ObservationError(f'{topic}: {_NONE_OF_STAMP if self._in_series else _NONE}')
            self.solve(one.stamp, landmarks, items)
            self._counts.solved += 1
        except FisheyeSvpError as error:
            self.drop(topic, error)
            self._fail(one.stamp, str(error))
        except Exception as error:
            self.unforeseen(error)
            self._fail(one.stamp, f'internal error: {error!r:.200}')

    def _contents(self, unread: Items) -> dict[str, Any]:
        """Return what a set holds; without what cannot be read and need not be there."""
        items = {}
        for topic, item in unread.items():
            try:
                items[topic] = item.read() if isinstance(item, Unread) else item
            except FisheyeSvpError as error:
                if topic in (*self._image_points, 'landmarks'):
                    raise
                self.drop(topic, error)
        return items

    def _fail(self, stamp: int, problem: str) -> None:
        self._counts.unsolved += 1
        self.publish_result(stamp, {}, problem)

    def _give_up(self, one: Pending) -> None:
        present = [topic for topic in self._image_points if topic in one.items]
        for topic in present:
            self.drop(topic, ObservationError(f'{topic}: the other camera has no set like it'))
        self._counts.incomplete += bool(present)


def known_points(landmarks: LandmarkSet, seen: ImagePoints) -> Array:
    """Return the landmarks (N, 3), m, of image points; raise ObservationError for an unknown."""
    points, known = landmarks.landmarks.lookup(seen.landmark)
    if not known.all():
        unknown = seen.landmark[~known][0]
        raise ObservationError(f'image_points: landmark {unknown} is not among the landmarks')
    return points


def true_rig(items: Items) -> Pose | None:
    """Return the left camera in the right one where both true poses are known."""
    left, right = (items.get(f'{camera}/true_pose') for camera in STEREO)
    return None if left is None or right is None else right.inverse().compose(left)
