"""Finds the pose of a camera from image points of known landmarks."""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, Vector3Stamped
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.io import decoding
from fisheye_svp_ros.io.tag_maps import TagMap, read_tag_map
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.base_pose import BasePose
from fisheye_svp_ros.nodes.camera_info import CAMERA_INFO
from fisheye_svp_ros.nodes.detections import TagLimits, detections_reader
from fisheye_svp_ros.nodes.messages import camera_shape
from fisheye_svp_ros.nodes.quality import LATCHED
from fisheye_svp_ros.nodes.solver import SolverNode, lens_of
from fisheye_svp_ros.nodes.transforms import TransformPublisher
from fisheye_svp_ros.nodes.validation import Items, KnownPoints
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.reporting.wording import inputs as wording
from fisheye_svp_ros.reporting.wording.poses import rolling_shutter_note
from fisheye_svp_ros.scene.observations import Views
from fisheye_svp_ros.scene.pose_priors import PlanarPrior
from fisheye_svp_ros.solve.localization import Localization
from fisheye_svp_ros.solve.pose_gate import GatedPose
from fisheye_svp_ros.solve.readout import exceeds, readout_bias, steady_velocity
from fisheye_svp_ros.study.settings import LocalizerSettings
from fisheye_svp_ros.study.solutions import (
    LOCALIZATION_METRICS,
    SetSolutions,
    localize_sets,
    residual_points,
)

if TYPE_CHECKING:
    from fisheye_svp_ros.diagnosis import LensErrors

MAX_RMS_RATIO = 1.5  # a set may fit this much worse than the one before it, by chance
MAX_POSE_CHANGE = 0.1  # rad, and of the distance of the nearest landmark
PERFECT_FIT_PX = 1e-6  # px; what fits better fits perfectly
_MAX_AHEAD = 2  # intervals between two sets, after which a motion is not carried on
OUTLIER_SEARCH_INTERVAL = 10  # sets, of those that fit badly one after the other


class Localizer(SolverNode):
    """Publishes a pose, its residuals and, where the true pose is known, its errors."""

    NAME = 'localizer'
    SETTINGS = LocalizerSettings
    METRICS = LOCALIZATION_METRICS
    settings: LocalizerSettings
    _tags: TagMap | None = None

    def __init__(self, node_name: str | None = None, **options: Any) -> None:
        super().__init__(node_name, **options)
        self._pose = self.announce(PoseWithCovarianceStamped, '~/pose')
        self._position_error = self.announce(Vector3Stamped, '~/position_error')
        self._rotation_error = self.announce(Vector3Stamped, '~/rotation_error')
        self._residuals = self.announce(PointCloud2, '~/residuals')
        self._markers = self.announce(MarkerArray, '~/markers', LATCHED)
        self._transforms = TransformPublisher(self, self.settings.publish_tf)
        self._base = BasePose(self, self.settings)
        self._latest: deque[tuple[int, Pose]] = deque(maxlen=2)  # stamps and poses, to go on from
        self._motion: deque[tuple[float, Pose]] = deque(maxlen=3)  # times, s, and poses
        self._first_stamp = 0  # ns, from which these times count
        self._rms_before = 0.0  # px
        self._misfits = 0  # sets up to the one before that fit badly, without outliers found
        self._errors: LensErrors | None = None  # of the latest lens
        self.start()
        if self._tags is not None:
            shapes, frame = messages.tag_map_shapes(self._tags), self.settings.map_frame
            self.announce(MarkerArray, '~/tag_map', LATCHED).publish(
                messages.markers_message(shapes, 0, frame)
            )

    def collect_landmarks(self) -> None:
        """Listen to the landmarks, or take those of a map of tags for good."""
        name, frame = self.settings.tag_map, self.settings.map_frame
        if not name:
            super().collect_landmarks()
            return
        self._tags = read_tag_map(name)
        self.hold_landmarks(decoding.LandmarkSet(self._tags.landmarks(), frame))
        if self._tags.note:
            self.get_logger().warning(self._tags.note)
        self.get_logger().info(wording.tag_map_in_use(name, self._tags.stderr))

    def collect_image_points(self, topic: str) -> None:
        """Listen to the image points, or with a map of tags to detections of these."""
        settings = self.settings
        if not settings.tag_map or settings.detections == 'image_points':
            super().collect_image_points(topic)
            return
        family = '' if self._tags is None else self._tags.family
        limits = TagLimits(settings.max_hamming, settings.min_decision_margin, family)
        kind, read = detections_reader(settings.detections, limits)
        use = functools.partial(self._add, topic)
        self.collect(kind, topic, read, use, name='detections')

    def needed_inputs(self) -> Sequence[Sequence[str]]:
        """Return the topics without which nothing can be solved."""
        needed = super().needed_inputs()
        return [one for one in needed if not self.settings.tag_map or 'landmarks' not in one]

    def prepare(self, settings: Any) -> Any:
        """Refuse a lens that cannot be loaded, or does not know its errors where they count."""
        if settings.model_error and settings.lens not in ('', CAMERA_INFO):
            _errors_of(lens_of(settings.lens, 1.0, settings))
        if settings.planar and not settings.base_frame:
            raise ParameterError('planar without base_frame; name the base that drives on a plane')
        return super().prepare(settings)

    def _prior(self, camera: str, stamp: int) -> PlanarPrior | None:
        """Return what is known of the camera (1,) of a base that drives on a plane, if it does."""
        settings = self.settings
        mount = self._base.mount(camera, stamp) if settings.planar else None
        if mount is None:
            return None
        sigma = np.array([[settings.planar_std_m, settings.planar_std_rad]])
        return PlanarPrior(mount.take(None), np.array([settings.planar_height]), sigma)

    def solve(self, stamp: int, landmarks: decoding.LandmarkSet, items: Items) -> None:
        """Localize the camera of one set; raise GeometryError where its points fix no pose."""
        points: KnownPoints = items['image_points']
        views, model = self.views(stamp, points), self.model(stamp, items)
        if self._tags is not None:
            views = views._replace(
                landmark_covariance=self._tags.landmark_covariance(views.landmark)
            )
        errors = self._lens_errors(stamp, items) if self.settings.model_error else None
        if errors is not None:
            sigma = errors.inflate_sigma(self.settings.sigma_px)
            views = views._replace(weight=np.full_like(views.weight, 1 / sigma))
        camera = self.settings.camera_frame or points.frame
        views = views._replace(prior=self._prior(camera, stamp))
        true: Pose | None = items.get('true_pose')
        solved = self._localize(stamp, model, views, true).require(self.settings.gate)
        solution = solved.solution
        pose, world = solution.pose.take(0), landmarks.frame
        covariance = solution.covariance
        if errors is not None:
            covariance = errors.of_solved_poses(views, solution, None).total
        bias, rolling = self._readout_bias(stamp, model, views, solution, covariance)
        covariance = covariance + bias[:, :, None] * bias[:, None, :]
        self._pose.publish(
            messages.pose_with_covariance_message(pose, covariance[0], stamp, world)
        )
        doubt = self._base.publish(
            GatedPose(
                pose,
                covariance[0],
                bool(solved.metrics['ambiguous'][0]),
                float(solved.sigmas[0]),
                solved.suspects[0] if solved.suspects else {},
            ),
            stamp,
            world,
            camera,
        )
        if self._residuals.get_subscription_count():
            cloud = residual_points(model, views, solution)
            self._residuals.publish(messages.cloud_message(cloud, stamp, camera))
        self._transforms.publish(pose, stamp, world, camera)
        if true is not None:
            error = pose.difference(true)
            self._position_error.publish(messages.vector_message(error[:3], stamp, world))
            self._rotation_error.publish(messages.vector_message(error[3:], stamp, world))
        problem = '; '.join(filter(None, (solved.reasons[0], rolling, doubt)))
        self.publish_result(stamp, solved.metrics, problem)
        if self._markers.get_subscription_count():
            shape = camera_shape(pose, 'estimated', alpha=0.6)
            self._markers.publish(messages.markers_message([shape], stamp, world))

    def _readout_bias(
        self,
        stamp: int,
        model: ForwardModel,
        views: Views,
        solution: Localization,
        covariance: Array,
    ) -> tuple[Array, str]:
        """Return what a rolling shutter may move a pose by, (1, 6), and what is to be told of it.

        Zeros where that is less than the covariance (1, 6, 6) states, and where the lens knows.
        """
        seconds, nothing = self.settings.readout_time, np.zeros((1, 6))
        self._first_stamp = self._first_stamp or stamp
        self._motion.append((1e-9 * (stamp - self._first_stamp), solution.pose.take(0)))
        velocity = steady_velocity(*zip(*self._motion, strict=True))
        models_it = model.without_motion() is not model
        if not seconds or not self.settings.lens or models_it or velocity is None:
            return nothing, ''
        bias = readout_bias(model, views, solution.pose, velocity, seconds)
        if not exceeds(bias[0], covariance[0]):
            return nothing, ''
        turn = float(np.linalg.norm(velocity[3:]))
        return bias, rolling_shutter_note(turn, seconds, float(np.linalg.norm(bias[0, :3])))

    def report(self) -> tuple[Mapping[str, object], str]:
        """Return what became of every set, and which poses were kept back."""
        values, text = super().report()
        return {**values, **self._base.report()}, text

    def _lens_errors(self, stamp: int, items: Items) -> LensErrors:
        lens = self.lens(stamp, items)
        if self._errors is None or self._errors.lens is not lens:
            self._errors = _errors_of(lens)
        return self._errors

    def _localize(
        self, stamp: int, model: ForwardModel, views: Views, true: Pose | None
    ) -> SetSolutions[Localization]:
        """Solve from where the camera should be, which is faster; from anywhere if it is not near.

        A wrong lens is wrong in every set; to search each for outliers would take 20 ms more.
        Where a scenario names the lens, its error is what is measured: no point is an outlier.
        """
        start = _pose_at(stamp, self._latest)
        measured = bool(self.settings.lens)
        searched = measured and self._misfits % OUTLIER_SEARCH_INTERVAL == 0
        localize = functools.partial(
            localize_sets, model, views, true, examined=True, tags=bool(self.settings.tag_map)
        )
        solved = localize(start=start, searched=searched)
        if start is not None and not (
            _rms_px(solved) < MAX_RMS_RATIO * self._rms_before
            and _is_near(start, solved.solution.pose, views)
        ):
            self._latest.clear()
            solved = localize(searched=measured)
        rms, pose = _rms_px(solved), solved.solution.pose
        if np.isfinite(rms):
            self._latest.append((stamp, pose))
            self._rms_before = max(rms, PERFECT_FIT_PX)
        whole = solved.metrics['points'][0] == views.used.sum()
        self._misfits = self._misfits + 1 if solved.reasons[0] and whole else 0
        return solved


def _errors_of(lens: Lens) -> LensErrors:
    # Nothing else here needs what that imports, and a node is to start at once.
    from fisheye_svp_ros.diagnosis import LensErrors

    return LensErrors.from_lens(lens)


def _rms_px(found: SetSolutions[Localization]) -> float:
    """Return the residual of one view; infinite without a pose."""
    return float(found.metrics['rms_px'][0]) if found.solved[0] else np.inf


def _pose_at(stamp: int, latest: Sequence[tuple[int, Pose]]) -> Pose | None:
    """Return where a camera is that moves on as it did, (1,); latest: stamps, ns, and poses."""
    if not latest:
        return None
    (before, other), (now, pose) = latest[0], latest[-1]
    if not before < now < stamp < now + _MAX_AHEAD * (now - before):
        return pose
    turned = pose.rotation @ np.swapaxes(other.rotation, -1, -2) @ pose.rotation
    # Rounding would grow from set to set: a step towards the nearest rotation.
    turned = 1.5 * turned - 0.5 * turned @ np.swapaxes(turned, -1, -2) @ turned
    return Pose._make((turned, 2 * pose.position - other.position))


def _is_near(start: Pose, pose: Pose, views: Views) -> bool:
    """Say whether a camera that went from one pose (1,) to another sees nearly the same."""
    nearest = np.linalg.norm(views.points[0] - pose.position, axis=-1).min()
    turned = np.linalg.norm(pose.rotation - start.rotation) / np.sqrt(2)  # the angle, if small
    return bool(
        np.linalg.norm(pose.position - start.position) < MAX_POSE_CHANGE * nearest
        and turned < MAX_POSE_CHANGE
    )
