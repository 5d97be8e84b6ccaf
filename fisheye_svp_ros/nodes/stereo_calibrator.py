"""Calibrates a stereo rig from the image points of known landmarks in both cameras."""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import TransformStamped, Vector3Stamped

from fisheye_svp_ros.io import decoding
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.quality import LATCHED
from fisheye_svp_ros.nodes.set_collection import CollectedSet, make_set, scenario_of, table_of
from fisheye_svp_ros.nodes.solver import SolverNode, exchange_reason, true_rig
from fisheye_svp_ros.nodes.transforms import Transforms
from fisheye_svp_ros.nodes.validation import Items
from fisheye_svp_ros.scene.observations import STEREO, stereo_views
from fisheye_svp_ros.solve.stereo_calibration import StereoCalibration
from fisheye_svp_ros.study.settings import StereoCalibratorSettings
from fisheye_svp_ros.study.solutions import STEREO_CALIBRATION_METRICS, SetSolutions, solve_rigs


class StereoCalibrator(SolverNode):
    """Calibrates anew with every set, from those of its scenario so far."""

    NAME = 'stereo_calibrator'
    SETTINGS = StereoCalibratorSettings
    METRICS = STEREO_CALIBRATION_METRICS
    CAMERAS = tuple(f'{name}/' for name in STEREO)
    BY_SCENARIO = True
    settings: StereoCalibratorSettings

    def __init__(self, node_name: str | None = None, **options: Any) -> None:
        super().__init__(node_name, **options)
        self._rig = self.announce(TransformStamped, '~/rig', LATCHED)
        self._position_error = self.announce(Vector3Stamped, '~/position_error')
        self._rotation_error = self.announce(Vector3Stamped, '~/rotation_error')
        self._transforms = Transforms(self, self.settings.publish_tf, static=True)
        self._scenario: frozenset[tuple[str, str]] = frozenset()
        self._window: list[CollectedSet] = []
        self.start()

    def solve(self, stamp: int, landmarks: decoding.LandmarkSet, items: Items) -> None:
        """Calibrate with one more set; raise GeometryError where the views fix no rig."""
        scenario = scenario_of(items)
        # A recording that starts over tells nothing new.
        known = (
            [seen for seen in self._window if seen.stamp != stamp]
            if scenario == self._scenario
            else []
        )
        one = make_set(stamp, items, self.CAMERAS)
        window = [*known, one][-self.settings.views :]
        left, right = stereo_views(table_of(window, self.CAMERAS), self.settings.sigma_px)
        found = solve_rigs(self.models(stamp, items), left, right, true=true_rig(items)).require(
            self.settings.gate
        )
        # Only now: a set that cannot be used must not spoil those to come.
        self._window, self._scenario = window, scenario
        self._publish(stamp, items, found)

    def _publish(self, stamp: int, items: Items, found: SetSolutions[StereoCalibration]) -> None:
        rig, true = found.solution.rig.take(0), true_rig(items)
        left, right = (items[f'{camera}image_points'].frame for camera in self.CAMERAS)
        self._rig.publish(messages.transform_message(rig, stamp, right, left))
        self._transforms.publish(rig, stamp, right, left)
        if true is not None:
            error = rig.difference(true)
            self._position_error.publish(messages.vector_message(error[:3], stamp, right))
            self._rotation_error.publish(messages.vector_message(error[3:], stamp, right))
        problems = filter(None, (found.reasons[0], exchange_reason(rig)))
        self.publish_result(stamp, found.metrics, '; '.join(problems))
