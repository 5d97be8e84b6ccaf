"""Finds the pose of a camera from image points of known landmarks."""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from geometry_msgs.msg import Vector3Stamped
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.io.decoding import ImagePoints, LandmarkSet
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.camera_info import CAMERA_INFO
from fisheye_svp_ros.nodes.messages import camera_shape
from fisheye_svp_ros.nodes.quality import LATCHED
from fisheye_svp_ros.nodes.robot import RobotNode
from fisheye_svp_ros.nodes.solver import lens_of
from fisheye_svp_ros.nodes.validation import Items
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Views
from fisheye_svp_ros.solve.measured_poses import rms_px
from fisheye_svp_ros.solve.poses import solve_poses
from fisheye_svp_ros.solve.solved_poses import SolvedPoses
from fisheye_svp_ros.study.settings import LocalizerSettings
from fisheye_svp_ros.study.solutions import localization_metrics, residual_points

if TYPE_CHECKING:
    from fisheye_svp_ros.diagnosis import LensErrors

MAX_RMS_RATIO = 1.5  # a set may fit this much worse than the one before it, by chance
MAX_POSE_CHANGE = 0.1  # rad, and of the distance of the nearest landmark
PERFECT_FIT_PX = 1e-6  # px; smaller residuals are rounding
_MAX_AHEAD = 2  # intervals between two sets, after which a motion is not carried on
OUTLIER_SEARCH_INTERVAL = 10  # sets, of those that fit badly one after the other


class Localizer(RobotNode):
    """Publishes a pose, its residuals and, where the true pose is known, its errors."""

    NAME = 'localizer'
    SETTINGS = LocalizerSettings
    settings: LocalizerSettings

    def __init__(self, node_name: str | None = None, **options: Any) -> None:
        super().__init__(node_name, **options)
        self._position_error = self.announce(Vector3Stamped, '~/position_error')
        self._rotation_error = self.announce(Vector3Stamped, '~/rotation_error')
        self._residuals = self.announce(PointCloud2, '~/residuals')
        self._markers = self.announce(MarkerArray, '~/markers', LATCHED)
        self._latest: deque[tuple[int, Pose]] = deque(maxlen=2)  # stamps and poses, to go on from
        self._rms_before = 0.0  # px
        self._misfits = 0  # sets up to the one before that fit badly, without outliers found
        self._errors: LensErrors | None = None  # of the latest lens
        self.start()

    def prepare(self, settings: Any) -> Any:
        """Refuse a lens that cannot be loaded, or does not know its errors where they count."""
        if settings.model_error and settings.lens not in ('', CAMERA_INFO):
            _errors_of(lens_of(settings.lens, 1.0, settings))
        return super().prepare(settings)

    def solve(self, stamp: int, landmarks: LandmarkSet, items: Items) -> None:
        """Localize the camera of one set; raise GeometryError where its points fix no pose."""
        points: ImagePoints = items['image_points']
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
        views = views._replace(prior=self.prior(camera, stamp))
        true: Pose | None = items.get('true_pose')
        solved = self._localize(stamp, model, views, points.tag is not None)
        solved = solved.require(self.settings.gate)
        metrics = localization_metrics(solved, None if true is None else true.take(None))
        pose, world = solved.pose.take(0), landmarks.frame
        covariance = solved.covariance
        if errors is not None:
            covariance = errors.of_solved_poses(views, solved.result, None).total
        problem = self.publish_poses(stamp, solved, covariance, world, camera)
        if self._residuals.get_subscription_count():
            cloud = residual_points(solved)
            self._residuals.publish(messages.cloud_message(cloud, stamp, camera))
        if true is not None:
            error = pose.difference(true)
            self._position_error.publish(messages.vector_message(error[:3], stamp, world))
            self._rotation_error.publish(messages.vector_message(error[3:], stamp, world))
        self.publish_result(stamp, metrics, problem)
        if self._markers.get_subscription_count():
            shape = camera_shape(pose, 'estimated', alpha=0.6)
            self._markers.publish(messages.markers_message([shape], stamp, world))

    def _lens_errors(self, stamp: int, items: Items) -> LensErrors:
        lens = self.lens(stamp, items)
        if self._errors is None or self._errors.lens is not lens:
            self._errors = _errors_of(lens)
        return self._errors

    def _localize(self, stamp: int, model: ForwardModel, views: Views, tags: bool) -> SolvedPoses:
        """Solve from where the camera should be, which is faster; from anywhere if it is not near.

        A wrong lens is wrong in every set; to search each for outliers would take 20 ms more.
        Where a scenario names the lens, its error is what is measured: no point is an outlier.
        """
        start = _pose_at(stamp, self._latest)
        measured = bool(self.settings.lens)
        searched = measured and self._misfits % OUTLIER_SEARCH_INTERVAL == 0
        solve = functools.partial(solve_poses, model, views, tags=tags)
        solved = solve(start, searched=searched)
        if start is not None and not (
            _rms_px(solved) < MAX_RMS_RATIO * self._rms_before
            and _is_near(start, solved.pose, views)
        ):
            self._latest.clear()
            solved = solve(searched=measured)
        rms = _rms_px(solved)
        if np.isfinite(rms):
            self._latest.append((stamp, solved.pose))
            self._rms_before = max(rms, PERFECT_FIT_PX)
        self._misfits = self._misfits + 1 if solved.reasons[0] and not solved.outliers.any() else 0
        return solved


def _errors_of(lens: Lens) -> LensErrors:
    # Nothing else here needs what that imports, and a node is to start at once.
    from fisheye_svp_ros.diagnosis import LensErrors

    return LensErrors.from_lens(lens)


def _rms_px(solved: SolvedPoses) -> float:
    """Return the residual of one set; infinite without a pose."""
    return rms_px(solved.residual) if solved.result.converged[0] else np.inf


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
