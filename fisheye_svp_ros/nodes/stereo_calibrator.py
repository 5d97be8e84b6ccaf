"""Calibrates a stereo rig from the image points of known landmarks in both cameras."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from geometry_msgs.msg import TransformStamped, Vector3Stamped
from std_srvs.srv import Trigger

from fisheye_svp_ros.errors import FisheyeSvpError, ObservationError, ParameterError
from fisheye_svp_ros.io import decoding
from fisheye_svp_ros.io.rig_files import save_rig
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.quality import LATCHED
from fisheye_svp_ros.nodes.set_collection import (
    Progress,
    make_set,
    scenario_of,
    table_of,
)
from fisheye_svp_ros.nodes.solver import SolverNode, exchange_reason, true_rig
from fisheye_svp_ros.nodes.transforms import TransformPublisher
from fisheye_svp_ros.nodes.validation import Items
from fisheye_svp_ros.scene.observations import STEREO, Observations, stereo_views
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
        self._transforms = TransformPublisher(self, self.settings.publish_tf, static=True)
        self._progress = Progress(self)
        self._scenario: frozenset[tuple[str, str]] = frozenset()
        self._window: dict[int, Observations] = {}  # by stamp, ns
        self._found: SetSolutions[StereoCalibration] | None = None  # the latest
        for name, answer in (('~/save', self._save), ('~/reset', self._reset)):
            self.create_service(Trigger, name, self.guard_callback(answer))
        self.start()

    def prepare(self, settings: Any) -> Any:
        """Refuse a file that is none."""
        if Path(settings.output).is_dir():
            raise ParameterError(f'output is {settings.output!r}, a folder; name a file')
        return super().prepare(settings)

    def report(self) -> tuple[Mapping[str, object], str]:
        """Return how far the calibration is, too."""
        counts, trouble = super().report()
        progress: dict[str, object] = {
            'calibration: views': len(self._window),
            'calibration: views missing': self.settings.views - len(self._window),
        }
        if self._found is not None:
            progress['calibration: rms_px'] = float(self._found.metrics['rms_px'][0])
        return {**counts, **progress}, trouble

    def solve(self, stamp: int, landmarks: decoding.LandmarkSet, items: Items) -> None:
        """Calibrate with one more set; raise GeometryError where the views fix no rig."""
        scenario = scenario_of(items)
        # A recording that starts over tells nothing new.
        window = dict(self._window) if scenario == self._scenario else {}
        window.pop(stamp, None)
        window[stamp] = make_set(stamp, items, self.CAMERAS)
        window = dict(list(window.items())[-self.settings.views :])
        left, right = stereo_views(table_of([*window.values()]), self.settings.sigma_px)
        solved = solve_rigs(self.models(stamp, items), left, right, true=true_rig(items)).require(
            self.settings.gate
        )
        # Only now: a set that cannot be used must not spoil those to come.
        self._window, self._scenario, self._found = window, scenario, solved
        self._publish(stamp, items, solved)
        fit = {name: float(solved.metrics[name][0]) for name in ('points', 'rms_px')}
        self._progress.publish(stamp, len(window), self.settings.views - len(window), fit)

    def _save(self, _: Any, response: Any) -> Any:
        """Write the latest rig to `output`."""
        path = Path(self.settings.output).absolute()
        try:
            if self._found is None:
                raise ObservationError('no rig yet: no set has been solved')
            save_rig(self._found.solution.rig.take(0), path)
        except FisheyeSvpError as error:
            response.success, response.message = False, str(error)
            return response
        missing = self.settings.views - len(self._window)
        response.success = True
        response.message = f'{path}: {len(self._window)} views' + (
            f', {missing} fewer than the parameter views' if missing else ''
        )
        return response

    def _reset(self, _: Any, response: Any) -> Any:
        """Forget all views: the next set is the first."""
        response.success, response.message = True, f'{len(self._window)} views forgotten'
        self._window, self._found = {}, None
        self._progress.publish(0, 0, self.settings.views, {})
        return response

    def _publish(self, stamp: int, items: Items, solved: SetSolutions[StereoCalibration]) -> None:
        rig, true = solved.solution.rig.take(0), true_rig(items)
        left, right = (items[f'{camera}image_points'].frame for camera in self.CAMERAS)
        self._rig.publish(messages.transform_message(rig, stamp, right, left))
        self._transforms.publish(rig, stamp, right, left)
        if true is not None:
            error = rig.difference(true)
            self._position_error.publish(messages.vector_message(error[:3], stamp, right))
            self._rotation_error.publish(messages.vector_message(error[3:], stamp, right))
        problems = filter(None, (solved.reasons[0], exchange_reason(rig)))
        self.publish_result(stamp, solved.metrics, '; '.join(problems))
