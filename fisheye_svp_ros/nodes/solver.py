"""What the solving nodes share: one set of inputs by stamp in, one result by stamp out."""

from __future__ import annotations

import functools
import time
from abc import abstractmethod
from collections import Counter, deque
from collections.abc import Mapping, Sequence
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
    read_framed_camera,
    read_framed_pose,
    read_image_points,
    read_key_values,
    read_landmarks,
)
from fisheye_svp_ros.io.lens_files import cameras_in
from fisheye_svp_ros.io.parameters import rows
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.base import ManagedNode
from fisheye_svp_ros.nodes.camera_info import CAMERA_INFO, CameraInfos
from fisheye_svp_ros.nodes.declaration import check_access
from fisheye_svp_ros.nodes.join import LIMIT, LatchedLandmarks, Pending, StampJoin
from fisheye_svp_ros.nodes.quality import INFO_INPUT
from fisheye_svp_ros.nodes.subscriptions import Unread
from fisheye_svp_ros.nodes.transforms import FrameListener
from fisheye_svp_ros.nodes.validation import Items, SetValidation
from fisheye_svp_ros.optics import engines
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.reporting.wording import inputs as wording
from fisheye_svp_ros.scene.observations import STEREO, Views
from fisheye_svp_ros.simulate.scenario import Scenario, true_lens
from fisheye_svp_ros.solve.lens_checks import extrapolated_points
from fisheye_svp_ros.solve.mirrored_points import Mirror, mirror_by_lens
from fisheye_svp_ros.study.settings import SolverSettings
from fisheye_svp_ros.study.solutions import Pair

_UNREAD = 5 * LIMIT  # messages to look at while there is nothing to solve
_LONGEST_INTAKE = 0.05  # s of taking in before a set is solved, come what may
_MIRROR_SETS = 5  # sets of a lens that say whether image points are mirrored
_NS = 10**9
_MAX_UNANSWERED = 10  # sets that wait for a topic on which nothing has ever come
_MIN_AXIS_COSINE = 0.7  # cosine of the angle between two viewing axes
_ENDS = ('taken', 'solved', 'not solved', 'dropped', 'incomplete')  # of sets
MAX_LATENCY = 0.5  # s from the stamp of a set to its result, above which it is told
_CLOCKS_AGREE = 600.0  # s by which a stamp may be older than now, as of the same clock
_COUNTS = (*_ENDS, 'solved with a warning')
_SHIFT_SCALE = next(row for row in rows(Scenario) if row.name == 'shift_scale')


class Pace:
    """What became of the sets so far, by the words of the report, and how late they are."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.latency = 0.0  # s, of the latest set
        self._restarted, self._reported = time.monotonic(), self.counts.copy()

    def answer(self, age: float, waited: float) -> None:
        """Take in how late a set is answered: s since its stamp, and since it was received.

        A recording that is played back has stamps of another time, which tell nothing.
        """
        self.latency = age if waited <= age < _CLOCKS_AGREE else waited

    def report(self, waiting: int) -> tuple[dict[str, object], str]:
        """Return the counts since the start, and what is wrong since the last report.

        taken = solved + not solved + dropped + incomplete + waiting, at any time.
        """
        counts, before, now = self.counts, self._reported, time.monotonic()
        seconds = max(now - self._restarted, 1e-3)
        self._restarted, self._reported = now, counts.copy()
        came = (counts['taken'] - before['taken']) / seconds
        done = sum(counts[end] - before[end] for end in ('solved', 'not solved')) / seconds
        told: dict[str, object] = {
            **{f'sets: {what}': counts[what] for what in _COUNTS},
            'sets: waiting': waiting,
            'sets: received per second': round(came, 1),
            'sets: solved per second': round(done, 1),
            'sets: latency_s': round(self.latency, 4),
        }
        if counts['dropped'] == before['dropped']:
            late = self.latency > MAX_LATENCY and counts['solved'] > before['solved']
            return told, wording.late(self.latency) if late else ''
        return told, (
            f'too slow: {came:.0f} sets per second are received and {done:.0f} are solved, '
            f'{self.latency:.2f} s late; {waiting} wait, {counts["dropped"]} are dropped'
        )


class SolverNode(ManagedNode):
    """Joins landmarks, image points, true poses and scenario by stamp; `solve` does the rest.

    CAMERAS: the namespaces of the cameras, each with its slash; METRICS: all names in results;
    BY_SCENARIO: the scenario matters even where the lens is given.
    """

    CAMERAS: ClassVar[tuple[str, ...]] = ('',)
    BY_SCENARIO: ClassVar[bool] = False
    METRICS: ClassVar[tuple[str, ...]]
    settings: SolverSettings

    def __init__(self, node_name: str | None = None, **options: Any) -> None:
        super().__init__(node_name, **options)
        self._compilation = engines.settle_in_background()  # a start must not wait
        if self._compilation is not None:
            self.get_logger().info(wording.compiling())
        self._metrics = {
            name: self.announce(Float64, f'~/metrics/{name}') for name in self.METRICS
        }
        self._image_points = tuple(f'{camera}image_points' for camera in self.cameras)
        self._poses = {f'{camera}true_pose': f'{camera}image_points' for camera in self.cameras}
        first = self._image_points[0]
        self._join = StampJoin(
            self._image_points, {**self._poses, 'landmarks': first, 'scenario': first}
        )
        self._backlog: deque[Pending] = deque()
        self._unread: deque[tuple[int, str]] = deque(maxlen=_UNREAD)
        self._pace = Pace()
        self._latched_landmarks = LatchedLandmarks()
        self._listener = FrameListener(self)
        self._validation = SetValidation(
            self._image_points, tuple(self._poses), self.drop, self._find_frame
        )
        self._left_out: list[str] = []  # of the set that is solved, and what is doubtful in it
        self._said = ''
        self._lenses: dict[str, Lens] = {}  # those of the parameter lens
        self._infos = CameraInfos(self.get_logger().info)
        self._models: dict[str, tuple[Lens, ForwardModel]] = {}  # the latest, by camera
        self._mirrors: dict[str, tuple[Lens, int, Mirror | None]] = {}  # and sets of it, so far
        self._guarded_work = self.guard_callback(self._work)
        self._rest = self.create_guard_condition(self._guarded_work)
        self.collect_landmarks()
        self._collect(DiagnosticArray, 'scenario', read_key_values)
        for topic in self._poses:
            self._collect(PoseStamped, topic, read_framed_pose)
        # Last, because a camera that sees this subscription counts on the others.
        for topic in self._image_points:
            self.collect_image_points(topic)
        self.start_timer(0.1, self._work)

    def start(self) -> None:
        """Take the parameters into use, as every node does; call it after all `announce`."""
        # Last, because a recorder that sees this topic counts on having seen the others.
        self._result = self.announce(DiagnosticArray, '~/result', wait=True)
        super().start()

    def destroy_node(self) -> None:
        """End what runs beside the node, too."""
        if self._compilation is not None:
            self._compilation.stop()
        super().destroy_node()

    def collect_landmarks(self) -> None:
        """Listen to the landmarks."""
        self.collect(
            PointCloud2, 'landmarks', self._read_landmarks, self._hear_landmarks, latched=True
        )

    def collect_image_points(self, topic: str) -> None:
        """Listen to the image points of a camera."""
        self._collect(PointCloud2, topic, self._read_image_points)

    def hold_landmarks(self, landmarks: LandmarkSet) -> None:
        """Take landmarks for all sets, in place of a topic."""
        self._latched_landmarks.hold(landmarks)
        self._join.expect_no_more('landmarks')

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
        lens = (
            f'lens {settings.lens}'
            if not told
            else f'lens of {CAMERA_INFO}'
            if settings.lens
            else 'lens that scenario names'
        )
        how = 'without its viewpoint shift' if settings.solves_svp else 'with its viewpoint shift'
        text = f'solving with the {lens} {how} (svp: {settings.svp})'
        if text != self._said:
            self.get_logger().info(text)
        self._said = text
        self._join.reaches = dict.fromkeys(self._poses, round(_NS * settings.true_pose_gap))
        self._join.tolerance = round(_NS * settings.sync_tolerance)

    def needed_inputs(self) -> Sequence[Sequence[str]]:
        """Return the topics without which nothing can be solved."""
        lens = {'': ['scenario'], CAMERA_INFO: [f'{c}{CAMERA_INFO}' for c in self.cameras]}
        topics = [*self._image_points, 'landmarks', *lens.get(self.settings.lens, ())]
        return [(topic,) for topic in topics]

    @abstractmethod
    def solve(self, stamp: int, landmarks: LandmarkSet, items: Items) -> None:
        """Solve one set and publish what comes out; items by topic."""

    def model(self, stamp: int, items: Items, camera: str = '') -> ForwardModel:
        """Return what to solve with, as `lens` does."""
        lens, known = self.lens(stamp, items, camera), self._models.get(camera)
        if known is None or known[0] is not lens:
            known = self._models[camera] = lens, ForwardModel(lens)
        self._left_out += self.warn_of_extrapolation(lens, items, camera)
        self._left_out += self._warn_of_mirror(stamp, lens, items, camera)
        return known[1]

    def _warn_of_mirror(self, stamp: int, lens: Lens, items: Items, camera: str) -> list[str]:
        """Warn of mirrored image points, by the first sets of a lens; return what was said."""
        topic = f'{camera}image_points'
        of, sets, mirror = self._mirrors.get(camera, (lens, 0, None))
        if of is not lens:
            sets, mirror = 0, None
        if sets < _MIRROR_SETS:
            mirror = mirror_by_lens(self.views(stamp, items[topic]), lens)
        self._mirrors[camera] = lens, sets + 1, mirror
        texts = [wording.points_mirrored(topic, mirror)] if mirror else []
        for text in texts:
            self.warn(text)
        return texts

    def warn_of_extrapolation(self, lens: Lens, items: Items, camera: str = '') -> list[str]:
        """Warn of image points where the curve of a lens is a guess; return what was said."""
        topic = f'{camera}image_points'
        beyond = extrapolated_points(lens, items[topic].uv)
        texts = [wording.points_extrapolated(topic, beyond)] if beyond else []
        for text in texts:
            self.warn(text)
        return texts

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
                raise ParameterError(
                    f'lens {self.settings.lens}: it holds several cameras; add # '
                    'and the name of one'
                )
            return self._lenses[camera]
        if self.settings.lens == CAMERA_INFO:
            frame = items[f'{camera}image_points'].frame
            return self._infos.lens(f'{camera}{CAMERA_INFO}', stamp, frame)
        scenario = items.get('scenario', {})
        if 'lens' not in scenario:
            raise ParameterError('no scenario names a lens; set the parameter lens')
        name = check_access(scenario['lens'], self.settings.folder, 'scenario: lens')
        scale = shift_scale(scenario.get('shift_scale', '1.0'))
        return lens_of(name, scale, self.settings)

    def views(self, stamp: int, seen: ImagePoints) -> Views:
        """Return image points as one view."""
        shape = 1, len(seen.landmark)
        return Views(
            points=seen.xyz[None],
            uv=seen.uv[None],
            weight=np.full(shape, 1 / self.settings.sigma_px),
            landmark=seen.landmark[None],
            board=np.zeros(shape, dtype=np.int64) if seen.tag is None else seen.tag[None],
            t=np.full(shape, stamp / 1e9),
            frame=np.array([stamp]),
            camera=np.zeros(1, dtype=np.int64),
            row=np.arange(len(seen.landmark))[None],
        )

    def publish_result(self, stamp: int, metrics: Mapping[str, Array], problem: str = '') -> None:
        """Publish the metrics (1,) of one set, together and one by one.

        problem: why they should not be relied on; what was left out of the set is added.
        """
        name = self.get_fully_qualified_name()
        if problem and metrics:  # what is not solved, and what is left out, is told where it is
            self._pace.counts['solved with a warning'] += 1
            self.warn(f'result: {problem}')
        problem = '; '.join(filter(None, (problem, *self._left_out)))
        values = {key: float(value[0]) for key, value in metrics.items()}
        for key, value in values.items():
            if self._metrics[key].get_subscription_count():  # seldom, and each takes its time
                self._metrics[key].publish(messages.number_message(value))
        level = DiagnosticStatus.WARN if problem else DiagnosticStatus.OK
        self._result.publish(messages.key_values_message(name, values, stamp, problem, level))

    def report(self) -> tuple[Mapping[str, object], str]:
        """Return what became of every set, and whether this node keeps up."""
        counts, overload = self._pace.report(len(self._backlog) + len(self._join))
        if overload:
            self.warn(overload)
        inactive = '' if self.listening else self.inactive_reason()
        troubles = filter(None, (inactive, self._latched_landmarks.trouble))
        return {
            **counts,
            **self._validation.rejected,
            'engine': self._engine(),
        }, '; '.join(troubles)

    def _engine(self) -> str:
        """Return what solves; say once that Numba has compiled, or why it has not."""
        compilation = self._compilation
        if compilation is None:
            return engines.settle(0)
        if compilation.state == 'compiling':
            return 'numpy, until Numba has compiled'
        self._compilation = None
        self.get_logger().info(wording.compilation_text(compilation.state))
        return engines.settle(0)

    def _listen_to_camera_info(self) -> None:
        def hear(topic: str, stamp: int, unread: Unread) -> None:
            self._infos.hear(topic, stamp, unread)
            self._join.expect_no_more(topic)

        for topic in (f'{camera}{CAMERA_INFO}' for camera in self.cameras):
            if not self.listens_to(topic):
                self._join.expect(topic)
                self.collect(
                    CameraInfo,
                    topic,
                    functools.partial(
                        read_framed_camera, rectified=self.settings.from_rectified_images
                    ),
                    functools.partial(hear, topic),
                    INFO_INPUT,
                    latched=True,
                )

    def _read_landmarks(self, message: Any, topic: str) -> LandmarkSet:
        return read_landmarks(message, topic, self.settings.strict)

    def _read_image_points(self, message: Any, topic: str) -> Any:
        return read_image_points(message, topic, self.settings.strict)

    def _collect(self, kind: Any, topic: str, read: Any) -> None:
        self.collect(kind, topic, read, functools.partial(self._add, topic))

    def _add(self, topic: str, stamp: int, item: Unread) -> None:
        self._pace.counts['taken'] += self._join.add(topic, stamp, item, time.monotonic())
        self._unread.append((stamp, topic))

    def _hear_landmarks(self, stamp: int, unread: Unread) -> None:
        if stamp:
            self._add('landmarks', stamp, unread)
        self._latched_landmarks.hear(stamp, unread)
        if not stamp:
            self._join.expect_no_more('landmarks')

    def after_message(self) -> None:
        """Work at once: to be called back for it costs the executor more than most sets do."""
        self._guarded_work()

    def _work(self) -> None:
        """Take all in that has come, then do one thing: solve a set, or look at the rest."""
        self._take_in()
        now, patience = time.monotonic(), self.settings.patience
        self._skip_unpublished()
        for one in self._join.pop_complete(now, patience):
            self._backlog.append(one)
            self._compare_stamps(one)
        for one in self._join.pop_expired(now, patience):
            self._drop_set(one)
        while len(self._backlog) > self.settings.most_waiting:
            self._backlog.popleft()
            self._pace.counts['dropped'] += 1
        if not self.has_listeners():
            return
        if self._backlog:
            one = self._backlog.popleft()
            self._attempt(one)
            age = 1e-9 * (self.get_clock().now().nanoseconds - one.stamp)
            self._pace.answer(age, time.monotonic() - one.since)
        else:
            self._look_at_next()
        if self._backlog or self._unread:
            self._rest.trigger()

    def _take_in(self) -> None:
        """Take in what has come, a message of each topic in turn, before the executor brings it.

        A solver that is behind would else find out late which sets are too old to be solved.
        """
        end = time.monotonic() + _LONGEST_INTAKE
        for one in self.unread:
            while one.take() and time.monotonic() < end:
                pass
        while (
            sum(subscription.take() for subscription in self._inputs.values())
            and time.monotonic() < end
        ):
            pass

    def _skip_unpublished(self) -> None:
        """Do not let sets wait for what nobody publishes, or has never sent for many sets."""
        optional = (*self._poses, *(['scenario'] if self.settings.lens else []))
        for topic in optional if len(self._join) else ():
            if not self._join.expects(topic):
                continue  # to look at the graph takes longer than to read a set
            one = self._inputs[topic]
            silent = not one.has_messages and len(self._join) > _MAX_UNANSWERED
            if silent or not self.count_publishers(one.resolved):
                self._join.expect_no_more(topic)

    def _compare_stamps(self, pending: Pending) -> None:
        """Say how far off the true poses are that come and are of no use to a set."""
        for topic, points in self._poses.items():
            off = self._join.distance(topic, pending.stamps[points])
            if topic not in pending.items and off is not None:
                self.warn(
                    f'{topic}: the nearest stamp is {1e-6 * off:.1f} ms from that of the '
                    'image points; true poses are interpolated only over gaps up to '
                    f'true_pose_gap ({self.settings.true_pose_gap:g} s)'
                )

    def _look_at_next(self) -> None:
        """Decode what waits for the rest of its set, so that bad input is told of at once."""
        item = None
        while self._unread and not isinstance(item, Unread):
            stamp, topic = self._unread.popleft()
            item = self._join.waiting(topic, stamp)
        if not isinstance(item, Unread):
            return
        try:
            item.read()
        except FisheyeSvpError as error:
            self.drop(topic, error)
            self._join.forget(topic, stamp)
            if topic in self._image_points:
                self._fail(stamp, str(error))

    def _attempt(self, pending: Pending) -> None:
        try:
            items, landmarks = self._validate(pending)
            self.solve(pending.stamp, landmarks, items)
            self._pace.counts['solved'] += 1
        except FisheyeSvpError as error:
            self._complain(error, 'not solved: ')
            self._fail(pending.stamp, str(error))
        except Exception as error:
            self.unforeseen(error)
            self._fail(pending.stamp, f'internal error: {error!r:.200}')
        finally:
            self._left_out = []

    def _validate(self, pending: Pending) -> tuple[Items, LandmarkSet]:
        """Return what is to be solved; raise FisheyeSvpError where that is nothing."""
        read = self._validation.read(pending.items)
        landmarks = self._latched_landmarks.find_for_set(
            read.get('landmarks'), self._join.distance('landmarks', pending.stamp)
        )
        items, self._left_out = self._validation.check(
            read, landmarks, self.settings, pending.stamp
        )
        for text in self._left_out:
            self.warn(text)
        return items, landmarks

    def _find_frame(self, frame: str, child: str, stamp: int) -> Pose | None:
        """See `FrameListener.find`; what this node itself tells of `odom_frame` proves nothing."""
        if getattr(self.settings, 'odom_frame', ''):
            return None
        return self._listener.find(frame, child, stamp)

    def _fail(self, stamp: int, problem: str) -> None:
        self._pace.counts['not solved'] += 1
        self.publish_result(stamp, {}, problem)

    def _drop_set(self, pending: Pending) -> None:
        self._pace.counts['incomplete'] += 1
        missing = [topic for topic in self._image_points if topic not in pending.items]
        for topic, stamp in pending.stamps.items():
            reason = self._reason(missing[0], stamp) if missing else 'too many sets wait'
            self._complain(ObservationError(f'{topic}: {reason}'), 'incomplete: ')

    def _reason(self, missing: str, stamp: int) -> str:
        off = self._join.distance(missing, stamp)
        if off is None:
            return f'no message on {missing}'
        return (
            f'the nearest stamp on {missing} is {1e-6 * off:.1f} ms off; with '
            'approximate_sync:=true, up to approximate_sync_tolerance_seconds is allowed'
        )


def true_rig(items: Items) -> Pose | None:
    """Return the left camera in the right one where both true poses are known."""
    left, right = (items.get(f'{camera}/true_pose') for camera in STEREO)
    return None if left is None or right is None else right.inverse().compose(left)


def exchange_reason(rig: Pose) -> str:
    """Say that left and right are exchanged where a rig looks like that, or nothing.

    rig: the left camera in the right one.  Both look the same way, and it is on the right.
    """
    x, y, z = rig.position
    if rig.rotation[2, 2] > _MIN_AXIS_COSINE and x > max(abs(y), abs(z)):
        return wording.cameras_exchanged(float(x))
    return ''


def lenses_of(settings: SolverSettings, cameras: Sequence[str]) -> dict[str, Lens]:
    """Return the lens of the parameter by camera; raise LensError for a bad one.

    cameras: namespaces, each with its slash.
    """
    names = cameras_in(lens_path(settings.lens))
    if len(cameras) < 2 or not names:
        return dict.fromkeys(('', *cameras), lens_of(settings.lens, 1.0, settings))
    return {
        camera: lens_of(f'{settings.lens}#{name}', 1.0, settings)
        for camera, name in zip(cameras, names, strict=False)
    }


def lens_of(name: str, scale: float, settings: SolverSettings) -> Lens:
    """Return a lens as it is to be solved with; raise FisheyeSvpError where it cannot be."""
    lens = true_lens(name, scale)
    return lens.approximate() if settings.solves_svp else lens


def shift_scale(text: str) -> float:
    """Return the factor that a scenario names; raise FisheyeSvpError where it cannot be used."""
    try:
        value = float(text)
    except ValueError:
        raise ObservationError(
            f'scenario: shift_scale is {text[:40]!r}; a number is needed'
        ) from None
    return float(_SHIFT_SCALE.check(value))
