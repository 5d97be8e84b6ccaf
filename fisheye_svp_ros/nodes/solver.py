"""What the solving nodes share: one set of inputs by stamp in, one result by stamp out."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import FisheyeSvpError, ObservationError, ParameterError
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.base import LATCHED_INPUT, BaseNode
from fisheye_svp_ros.nodes.join import StampJoin
from fisheye_svp_ros.nodes.messages import ImagePoints, LandmarkSet
from fisheye_svp_ros.optics import engines
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import STEREO, Views
from fisheye_svp_ros.simulate.scenario import model_of
from fisheye_svp_ros.study.settings import SolverSettings

Items = Mapping[str, Any]


class SolverNode(BaseNode):
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
        points = [f'{camera}image_points' for camera in self.cameras]
        poses = [f'{camera}true_pose' for camera in self.cameras]
        self._join = StampJoin(points, [*poses, 'landmarks', 'scenario'])
        self._standing: LandmarkSet | None = None
        self._in_series = False
        self._model: ForwardModel | None = None  # that of the parameter lens
        self.listen(
            PointCloud2, 'landmarks', messages.read_landmarks, self._hear_landmarks, LATCHED_INPUT
        )
        self._collect(DiagnosticArray, 'scenario', messages.read_key_values)
        for topic in poses:
            self._collect(PoseStamped, topic, messages.read_pose)
        # Last, because a camera that sees this subscription counts on the others.
        for topic in points:
            self._collect(PointCloud2, topic, messages.read_image_points)
        self.create_timer(0.1, self._work)

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
        if settings.lens:
            model_of(settings.lens, 1.0, settings.solves_svp)
        return settings

    def configure(self, settings: SolverSettings) -> None:
        """Load the lens and say which; do not wait for a scenario that nobody needs."""
        self._model = model_of(settings.lens, 1.0, settings.solves_svp) if settings.lens else None
        if settings.lens and not self.BY_SCENARIO:
            self._join.expect_no_more('scenario')
        lens = f'lens {settings.lens}' if settings.lens else 'lens that scenario names'
        how = 'without its viewpoint shift' if settings.solves_svp else 'as it stands'
        self.get_logger().info(f'solving with the {lens} {how} (svp: {settings.svp})')

    @abstractmethod
    def solve(self, stamp: int, landmarks: LandmarkSet, items: Items) -> None:
        """Solve one set and publish what comes out; items by topic."""

    def model(self, items: Items) -> ForwardModel:
        """Return the lens to solve with; raise ParameterError where nobody names one."""
        if self._model is not None:
            return self._model
        return model_of(*self.lens(items), self.settings.solves_svp)

    def lens(self, items: Items) -> tuple[str, float]:
        """Return the lens to solve with, file or name, and the scale of its shift."""
        if self.settings.lens:
            return self.settings.lens, 1.0
        scenario = items.get('scenario', {})
        if 'lens' not in scenario:
            raise ParameterError('no scenario names a lens; set the parameter lens')
        return scenario['lens'], float(scenario.get('shift_scale', 1.0))

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
        self, stamp: int, metrics: Mapping[str, Array], text: str = '', warn: bool = False
    ) -> None:
        """Publish the metrics (1,) of one set, together and one by one."""
        name = self.get_fully_qualified_name()
        values = {key: float(value[0]) for key, value in metrics.items()}
        for key, value in values.items():
            self._metrics[key].publish(messages.number_message(value))
        self._result.publish(messages.key_values_message(name, values, stamp, text, warn))

    def _collect(self, kind: Any, topic: str, read: Any) -> None:
        def use(stamp: int, item: Any) -> None:
            self._join.add(topic, stamp, item, time.monotonic())
            self._work()

        self.listen(kind, topic, read, use)

    def _hear_landmarks(self, stamp: int, landmarks: LandmarkSet) -> None:
        if stamp:
            self._join.add('landmarks', stamp, landmarks, time.monotonic())
        else:
            self._join.expect_no_more('landmarks')
            self._in_series = False
        if not self._in_series:
            self._standing = landmarks
        self._work()

    def _work(self) -> None:
        if not self.has_listeners():
            return
        now, patience = time.monotonic(), self.settings.patience
        for stamp, items in self._join.ready(now, patience):
            self._attempt(stamp, items)
        for _, items in self._join.given_up(now, patience):
            self._give_up(items)

    def _attempt(self, stamp: int, items: Items) -> None:
        topic = f'{self.cameras[0]}image_points'
        landmarks: LandmarkSet | None = items.get('landmarks', self._standing)
        if 'landmarks' in items:
            # Landmarks come set by set: from now on those of another set never stand in.
            self._in_series, self._standing = True, None
        try:
            if landmarks is None:
                raise ObservationError(f'{topic}: no landmarks; publish them on `landmarks`')
            self.solve(stamp, landmarks, items)
        except FisheyeSvpError as error:
            self.drop(topic, error)
            self.publish_result(stamp, {}, str(error), warn=True)

    def _give_up(self, items: Items) -> None:
        for topic in (f'{camera}image_points' for camera in self.cameras):
            if topic in items:
                self.drop(topic, ObservationError(f'{topic}: the other camera has no set like it'))


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
