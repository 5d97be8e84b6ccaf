"""What every node does that poses a robot: tags of a map, what is known of the base, the gate."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from visualization_msgs.msg import MarkerArray

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.io.decoding import LandmarkSet
from fisheye_svp_ros.io.tag_maps import TagMap, read_tag_map
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.base_pose import BasePose
from fisheye_svp_ros.nodes.detections import TagLimits, detections_reader
from fisheye_svp_ros.nodes.quality import LATCHED
from fisheye_svp_ros.nodes.solver import SolverNode
from fisheye_svp_ros.nodes.transforms import TransformPublisher
from fisheye_svp_ros.reporting.wording import inputs as wording
from fisheye_svp_ros.scene.pose_priors import PlanarPrior
from fisheye_svp_ros.solve.pose_gate import GatedPose
from fisheye_svp_ros.solve.readout import Readout
from fisheye_svp_ros.solve.solved_poses import SolvedPoses
from fisheye_svp_ros.solve.warm_up import load_solver
from fisheye_svp_ros.solve.weak_geometry import is_ambiguous
from fisheye_svp_ros.study.settings import RobotSettings
from fisheye_svp_ros.study.solutions import LOCALIZATION_METRICS

_IMAGE_POINTS, _DETECTIONS = 'image_points', 'detections'


class RobotNode(SolverNode):
    """Solves sets to poses of a robot, by landmarks that it hears or those of a map of tags."""

    METRICS = LOCALIZATION_METRICS
    settings: RobotSettings
    _tags: TagMap | None = None

    def __init__(self, node_name: str | None = None, **options: Any) -> None:
        super().__init__(node_name, **options)
        self._pose = self.announce(PoseWithCovarianceStamped, '~/pose')
        self._transforms = TransformPublisher(self, self.settings.publish_tf)
        self._base = BasePose(self, self.settings)
        self._first_stamp = 0  # ns, from which times count

    def start(self) -> None:
        """Take the parameters into use; show the map of tags."""
        super().start()
        # The first set would wait for what it loads; a start does not, nor do connections.
        self._warm_up = self.start_timer(0.0, self._load_solver)
        if self._tags is not None:
            shapes, frame = messages.tag_map_shapes(self._tags), self.settings.map_frame
            self.announce(MarkerArray, '~/tag_map', LATCHED).publish(
                messages.markers_message(shapes, 0, frame)
            )

    def _load_solver(self) -> None:
        self._warm_up.cancel()
        load_solver()

    def collect_landmarks(self) -> None:
        """Listen to the landmarks, or take those of a map of tags for good."""
        name, frame = self.settings.tag_map, self.settings.map_frame
        if not name:
            super().collect_landmarks()
            return
        self._tags = read_tag_map(name)
        self.hold_landmarks(LandmarkSet(self._tags.landmarks(), frame, of_tags=True))
        if self._tags.note:
            self.get_logger().warning(self._tags.note)
        self.get_logger().info(wording.tag_map_in_use(name, self._tags.stderr))

    def collect_image_points(self, topic: str) -> None:
        """Listen to the image points, or with a map of tags to detections of these."""
        settings = self.settings
        if not settings.tag_map or settings.detections == _IMAGE_POINTS:
            super().collect_image_points(topic)
            return
        family = '' if self._tags is None else self._tags.family
        limits = TagLimits(settings.max_hamming, settings.min_decision_margin, family)
        # Not every camera of a rig sees a tag.
        kind, read = detections_reader(settings.detections, limits, len(self.cameras) > 1)
        use = functools.partial(self._add, topic)
        self.collect(kind, topic, read, use, name=topic.replace(_IMAGE_POINTS, _DETECTIONS))

    def needed_inputs(self) -> Sequence[Sequence[str]]:
        """Return the topics without which nothing can be solved."""
        needed = super().needed_inputs()
        return [one for one in needed if not self.settings.tag_map or 'landmarks' not in one]

    def prepare(self, settings: Any) -> Any:
        """Refuse a plane without a base that drives on it."""
        if settings.planar and not settings.base_frame:
            raise ParameterError('planar without base_frame; name the base that drives on a plane')
        return super().prepare(settings)

    def configure(self, settings: Any) -> None:
        """Take the time of a readout into use, too."""
        super().configure(settings)
        self._readout = Readout(settings.readout_time)

    def prior(self, camera: str, stamp: int) -> PlanarPrior | None:
        """Return what is known of the camera (1,) of a base that drives on a plane, if it does."""
        settings = self.settings
        mount = self._base.mount(camera, stamp) if settings.planar else None
        if mount is None:
            return None
        sigma = np.array([[settings.planar_std_m, settings.planar_std_rad]])
        return PlanarPrior(mount.take(None), np.array([settings.planar_height]), sigma)

    def publish_poses(
        self,
        stamp: int,
        solved: SolvedPoses,
        covariance: Array,
        world: str,
        camera: str,
    ) -> str:
        """Publish the pose of one set, the base and transforms; return what is doubtful in them.

        covariance (1, 6, 6): of the pose; world, camera: frame ids.
        """
        pose = solved.pose.take(0)
        rolling = ''
        if self.settings.lens:  # a scenario simulates none
            self._first_stamp = self._first_stamp or stamp
            time = 1e-9 * (stamp - self._first_stamp)
            covariance, rolling = self._readout.cover(time, solved, covariance)
        self._pose.publish(
            messages.pose_with_covariance_message(pose, covariance[0], stamp, world)
        )
        cautious = covariance + solved.cautious_covariance - solved.covariance
        gated = GatedPose(
            pose,
            cautious[0],
            bool(is_ambiguous(solved.result)[0]),
            float(solved.sigmas[0]),
            solved.suspects[0] if solved.suspects else {},
        )
        doubt = self._base.publish(gated, stamp, world, camera)
        self._transforms.publish(pose, stamp, world, camera)
        return '; '.join(filter(None, (solved.reasons[0], rolling, doubt)))

    def report(self) -> tuple[Mapping[str, object], str]:
        """Return what became of every set, and which poses were kept back."""
        values, text = super().report()
        return {**values, **self._base.report()}, text
