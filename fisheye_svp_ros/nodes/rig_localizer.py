"""Finds the pose of a rig from what all of its cameras see at once."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from fisheye_svp_ros.errors import LensError, ParameterError
from fisheye_svp_ros.io.decoding import ImagePoints, LandmarkSet
from fisheye_svp_ros.io.rig_files import load_cameras
from fisheye_svp_ros.nodes.robot import RobotNode
from fisheye_svp_ros.nodes.set_collection import make_set
from fisheye_svp_ros.nodes.validation import Items
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.reporting.wording.poses import rig_reason
from fisheye_svp_ros.solve.table_poses import solve_rig_table
from fisheye_svp_ros.study.settings import RigLocalizerSettings
from fisheye_svp_ros.study.solutions import localization_metrics


class RigLocalizer(RobotNode):
    """Publishes the pose of the first camera of a rig, as `localize --rig` finds it."""

    NAME = 'rig_localizer'
    SETTINGS = RigLocalizerSettings
    settings: RigLocalizerSettings
    _loaded: tuple[tuple[str, ...], Pose] | None = None

    def __init__(self, node_name: str | None = None, **options: Any) -> None:
        super().__init__(node_name, **options)
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

    def solve(self, stamp: int, landmarks: LandmarkSet, items: Items) -> None:
        """Localize the rig of one set; raise GeometryError where its points fix no pose."""
        (names, places), cameras = self.rig, self.cameras
        table = make_set(stamp, items, cameras)
        table = replace(table, sigma=np.full(len(table), self.settings.sigma_px))
        points: list[ImagePoints] = [items[f'{camera}image_points'] for camera in cameras]
        tags = [one.tag for one in points if one.tag is not None]
        if of_tags := len(tags) == len(points):
            table = replace(table, board=np.concatenate(tags))
        lenses = {
            name: self.lens(stamp, items, camera)
            for name, camera in zip(names, cameras, strict=True)
        }
        frame = points[0].frame
        solved = solve_rig_table(
            table,
            lenses,
            names,
            places,
            self._tags,
            tags=of_tags,
            prior=self.prior(frame, stamp),
        ).require(self.settings.gate)
        true: Pose | None = items.get(f'{cameras[0]}true_pose')
        metrics = localization_metrics(solved, None if true is None else true.take(None))
        world, covariance = landmarks.frame, solved.covariance
        doubt = self.publish_poses(stamp, solved, covariance, world, frame)
        rejected = 0 if solved.rejected is None else len(solved.rejected.rows)
        problem = rig_reason(rejected, solved.contradicted)
        self.publish_result(stamp, metrics, '; '.join(filter(None, (problem, doubt))))
