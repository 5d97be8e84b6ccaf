"""Measures landmarks with a stereo rig that is known: epipolar offsets and 3-D points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.errors import LensError, ObservationError, ParameterError
from fisheye_svp_ros.io import decoding
from fisheye_svp_ros.io.decoding import (
    LANDMARKS,
    FramedRig,
    are_different_frames,
    read_framed_rig,
    structured_array,
)
from fisheye_svp_ros.io.rig_files import load_rig
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.messages import camera_shape, epipolar_shapes, landmarks_shape
from fisheye_svp_ros.nodes.quality import LATCHED
from fisheye_svp_ros.nodes.solver import SolverNode, exchange_reason, true_rig
from fisheye_svp_ros.nodes.validation import Items
from fisheye_svp_ros.pose import Pose, identity
from fisheye_svp_ros.reporting.wording import inputs as wording
from fisheye_svp_ros.scene.observations import STEREO
from fisheye_svp_ros.solve.reliability import doubt_of_pairs
from fisheye_svp_ros.solve.stereo_depth import epipolar_curves
from fisheye_svp_ros.study.settings import SolverSettings, StereoDepthSettings
from fisheye_svp_ros.study.solutions import STEREO_DEPTH_METRICS, Pair, measure_points


class StereoDepth(SolverNode):
    """Publishes a point for each landmark that both cameras see."""

    NAME = 'stereo_depth'
    SETTINGS = StereoDepthSettings
    METRICS = STEREO_DEPTH_METRICS
    CAMERAS = tuple(f'{name}/' for name in STEREO)
    settings: StereoDepthSettings

    def __init__(self, node_name: str | None = None, **options: Any) -> None:
        super().__init__(node_name, **options)
        self._points = self.announce(PointCloud2, '~/points')
        self._markers = self.announce(MarkerArray, '~/markers', LATCHED)
        self._latest: FramedRig | None = None
        self.listen(TransformStamped, 'rig', read_framed_rig, self._hear, latched=True)
        self.start()

    def prepare(self, settings: SolverSettings) -> SolverSettings:
        """Refuse a lens or a rig that cannot be loaded."""
        _rig_file(settings)
        return super().prepare(settings)

    def configure(self, settings: SolverSettings) -> None:
        """Load the lens and the rig."""
        self._given = _rig_file(settings)
        super().configure(settings)

    def needed_inputs(self) -> Sequence[Sequence[str]]:
        """Return the topics without which nothing can be measured."""
        rig = {'topic': ['rig'], 'true': [f'{camera}true_pose' for camera in self.CAMERAS]}
        return [*super().needed_inputs(), *((t,) for t in rig.get(self.settings.rig, ()))]

    def _hear(self, _: int, rig: FramedRig) -> None:
        self._latest = rig

    def solve(self, stamp: int, landmarks: decoding.LandmarkSet, items: Items) -> None:
        """Measure one set; raise GeometryError where no landmark is in both images."""
        models, rig = self.models(stamp, items), self._rig(items)
        left, right = (items[f'{camera}image_points'] for camera in self.CAMERAS)
        ids, in_left, in_right = np.intersect1d(
            left.landmark, right.landmark, assume_unique=True, return_indices=True
        )
        uv = left.uv[in_left], right.uv[in_right]
        true: Pose | None = items.get('right/true_pose')
        known = right.xyz[in_right]
        solved = measure_points(
            models,
            rig.take(None),
            uv[0][None],
            uv[1][None],
            None if true is None else true.into_body(known)[None],
            self.settings.optimal,
        ).require()
        points = solved.solution.points[0]
        seen = np.isfinite(points[:, 0])
        cloud = structured_array(LANDMARKS, ids[seen], *points[seen].T)
        self._points.publish(messages.cloud_message(cloud, stamp, right.frame))
        doubt = doubt_of_pairs(models, rig.take(None), uv, ids, self.settings.sigma_px)
        problems = filter(None, (doubt, exchange_reason(rig)))
        self.publish_result(stamp, solved.metrics, '; '.join(problems))
        if self._markers.get_subscription_count():
            pose: Pose | None = items.get('left/true_pose')
            frame = left.frame if pose is None else landmarks.frame
            shapes = _shapes(models, rig, pose or identity(), *uv, points[seen])
            self._markers.publish(messages.markers_message(shapes, stamp, frame))

    def _rig(self, items: Items) -> Pose:
        if self.settings.rig == 'topic' and self._latest is not None:
            rig, *frames = self._latest
            cameras = [items[f'{camera}image_points'].frame for camera in self.CAMERAS]
            if any(map(are_different_frames, frames, cameras)):
                raise ObservationError(wording.rig_of_others(frames, cameras))
            return rig
        known = true_rig(items) if self.settings.rig == 'true' else self._given
        if known is None:
            raise ObservationError(
                'no rig: true poses of both cameras are needed, or rig:=topic '
                'and a calibrated one, or rig:=FILE'
            )
        return known


def _rig_file(settings: SolverSettings) -> Pose | None:
    """Return the rig of a file, None where none is named; raise ParameterError for a bad one."""
    assert isinstance(settings, StereoDepthSettings)
    rig = settings.rig
    try:
        return None if rig in ('true', 'topic') else load_rig(rig)
    except LensError as cause:
        raise ParameterError(
            f'rig is {rig!r}; true, topic or the file of a rig is needed ({cause})'
        ) from cause


def _shapes(
    models: Pair, rig: Pose, left: Pose, uv_left: Array, uv_right: Array, points: Array
) -> list[messages.Segments]:
    # As markers, because RViz draws no cloud of doubles.
    place = left.compose(rig.inverse()).transform(points)
    shape = landmarks_shape(place)._replace(name='measured points', color=(0.8, 0.2, 0.2, 1.0))
    curves = epipolar_curves(*models, rig, uv_right)
    return [
        camera_shape(left, 'left', alpha=0.6),
        *epipolar_shapes(models[0].lens, left, curves, uv_left),
        shape,
    ]
