"""Finds the pose of a rig from what all of its cameras see at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped

from fisheye_svp_ros.errors import LensError, ParameterError
from fisheye_svp_ros.io import decoding
from fisheye_svp_ros.io.rig_files import load_cameras
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.base_pose import BasePose
from fisheye_svp_ros.nodes.set_collection import make_set, table_of
from fisheye_svp_ros.nodes.solver import SolverNode
from fisheye_svp_ros.nodes.transforms import TransformPublisher
from fisheye_svp_ros.nodes.validation import Items
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.reporting.wording.poses import rig_reason
from fisheye_svp_ros.solve.pose_gate import GatedPose
from fisheye_svp_ros.solve.rig_localization import localize_rig
from fisheye_svp_ros.study.settings import RigLocalizerSettings
from fisheye_svp_ros.study.solutions import (
    LOCALIZATION_METRICS,
    check_gate,
    localization_metrics,
    residual_sigmas,
)


class RigLocalizer(SolverNode):
    """Publishes the pose of the first camera of a rig, as `localize --rig` finds it."""

    NAME = 'rig_localizer'
    SETTINGS = RigLocalizerSettings
    METRICS = tuple(name for name in LOCALIZATION_METRICS if name not in ('odds', 'ambiguous'))
    settings: RigLocalizerSettings
    _loaded: tuple[tuple[str, ...], Pose] | None = None

    def __init__(self, node_name: str | None = None, **options: Any) -> None:
        super().__init__(node_name, **options)
        self._pose = self.announce(PoseWithCovarianceStamped, '~/pose')
        self._transforms = TransformPublisher(self, self.settings.publish_tf)
        self._base = BasePose(self, self.settings)
        self.start()

    @property
    def rig(self) -> tuple[tuple[str, ...], Pose]:
        """Names of the cameras, and where each stands in the first one; raise ParameterError."""
        if self._loaded is None:
            if not self.settings.rig:
                raise ParameterError('rig is not set; name a rig.yaml or its folder')
            try:
                self._loaded = load_cameras(self.settings.rig)
            except LensError as cause:
                raise ParameterError(f'rig: {cause}') from cause
        return self._loaded

    @property
    def cameras(self) -> tuple[str, ...]:
        """The namespaces of the cameras, each with its slash."""
        return tuple(f'{name}/' for name in self.rig[0])

    def solve(self, stamp: int, landmarks: decoding.LandmarkSet, items: Items) -> None:
        """Localize the rig of one set; raise GeometryError where its points fix no pose."""
        (names, places), cameras = self.rig, self.cameras
        table = table_of([make_set(stamp, items, cameras)], cameras)
        table = replace(table, sigma=np.full(len(table), self.settings.sigma_px))
        lenses = {
            name: self.lens(stamp, items, camera)
            for name, camera in zip(names, cameras, strict=True)
        }
        solution = localize_rig(table, lenses, names, places)
        true: Pose | None = items.get(f'{cameras[0]}true_pose')
        residual = solution.residual.reshape(1, -1, 2)
        check_gate(residual / self.settings.sigma_px, self.settings.gate)
        metrics = localization_metrics(
            solution.pose, residual, None if true is None else true.take(None)
        )
        pose, world = solution.pose.take(0), landmarks.frame
        frame, covariance = items[f'{cameras[0]}image_points'].frame, solution.covariance[0]
        self._pose.publish(messages.pose_with_covariance_message(pose, covariance, stamp, world))
        sigmas = residual_sigmas(residual / self.settings.sigma_px)
        doubt = self._base.publish(GatedPose(pose, covariance, misfit=sigmas), stamp, world, frame)
        self._transforms.publish(pose, stamp, world, frame)
        problem = rig_reason(len(solution.outliers.rows), solution.contradicted)
        problem = '; '.join(filter(None, (problem, doubt)))
        self.publish_result(stamp, metrics, problem)

    def report(self) -> tuple[Mapping[str, object], str]:
        """Return what became of every set, and which poses were kept back."""
        values, text = super().report()
        return {**values, **self._base.report()}, text
