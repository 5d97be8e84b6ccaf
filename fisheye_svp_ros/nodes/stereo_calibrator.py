"""Calibrates a stereo rig from the image points of known landmarks in both cameras."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from geometry_msgs.msg import TransformStamped, Vector3Stamped

from fisheye_svp_ros import messages
from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.evaluation.errors import (
    NO_RIG,
    STEREO_CALIBRATION_METRICS,
    stereo_calibration_metrics,
)
from fisheye_svp_ros.nodes.base import LATCHED, run
from fisheye_svp_ros.nodes.solver import (
    Items,
    SolverNode,
    known_points,
    true_rig,
)
from fisheye_svp_ros.observations import (
    STEREO,
    Observations,
    make_observations,
    stereo_views,
)
from fisheye_svp_ros.settings import StereoCalibratorSettings
from fisheye_svp_ros.solve.stereo_calibration import StereoCalibration, calibrate_stereo

# What tells the sets of one scenario from each other; all else tells scenarios apart.
_WITHIN_SCENARIO = ('set', 'frame')


class _Seen(NamedTuple):
    """What both cameras see in one set; every array has N rows (camera: index into STEREO)."""

    landmark: Index
    uv: Array
    xyz: Array
    camera: Index


class StereoCalibrator(SolverNode):
    """Calibrates anew with every set, from those of its scenario so far."""

    NAME = 'stereo_calibrator'
    SETTINGS = StereoCalibratorSettings
    METRICS = STEREO_CALIBRATION_METRICS
    CAMERAS = tuple(f'{name}/' for name in STEREO)
    BY_SCENARIO = True
    settings: StereoCalibratorSettings

    def __init__(self) -> None:
        super().__init__()
        self._rig = self.announce(TransformStamped, '~/rig', LATCHED)
        self._position_error = self.announce(Vector3Stamped, '~/position_error', wait=True)
        self._rotation_error = self.announce(Vector3Stamped, '~/rotation_error', wait=True)
        self._scenario: frozenset[tuple[str, str]] = frozenset()
        self._window: list[_Seen] = []
        self.start()

    def solve(self, stamp: int, landmarks: messages.LandmarkSet, items: Items) -> None:
        """Calibrate with one more set; raise GeometryError where the views fix no rig."""
        model, scenario = self.model(items), _scenario(items)
        known = self._window if scenario == self._scenario else []
        window = [*known, seen_in(landmarks, items)][-self.settings.views:]
        left, right = stereo_views(table_of(window), self.settings.sigma_px)
        solution = calibrate_stereo(model, model, left, right)
        if not solution.converged[0]:
            raise GeometryError(NO_RIG)
        # Only now: a set that cannot be used must not spoil those to come.
        self._window, self._scenario = window, scenario
        self._publish(stamp, items, solution)

    def _publish(self, stamp: int, items: Items, solution: StereoCalibration) -> None:
        rig, true = solution.rig.take(0), true_rig(items)
        left, right = (items[f'{camera}image_points'].frame for camera in self.CAMERAS)
        self._rig.publish(messages.transform_message(rig, stamp, right, left))
        if true is not None:
            error = rig.difference(true)
            self._position_error.publish(messages.vector_message(error[:3], stamp, right))
            self._rotation_error.publish(messages.vector_message(error[3:], stamp, right))
        self.publish_result(stamp, stereo_calibration_metrics(
            solution.rig, solution.left_residual, solution.right_residual, true
        ))


def seen_in(landmarks: messages.LandmarkSet, items: Items) -> _Seen:
    """Return one set; raise ObservationError for an unknown landmark."""
    both = [items[f'{name}/image_points'] for name in STEREO]
    return _Seen(
        np.concatenate([seen.landmark for seen in both]),
        np.concatenate([seen.uv for seen in both]),
        np.concatenate([known_points(landmarks, seen) for seen in both]),
        np.repeat(np.arange(2), [len(seen.landmark) for seen in both]),
    )


def table_of(window: list[_Seen]) -> Observations:
    """Return sets as a table, one frame a set."""
    landmark, uv, xyz, camera = (np.concatenate(arrays) for arrays in zip(*window, strict=True))
    frame = np.repeat(np.arange(len(window)), [len(seen.landmark) for seen in window])
    return make_observations(
        frame, landmark, uv, xyz, camera=camera, cameras=STEREO, source='image_points'
    )


def _scenario(items: Items) -> frozenset[tuple[str, str]]:
    scenario: dict[str, str] = items.get('scenario', {})
    return frozenset((k, v) for k, v in scenario.items() if k not in _WITHIN_SCENARIO)


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(StereoCalibrator, args)
