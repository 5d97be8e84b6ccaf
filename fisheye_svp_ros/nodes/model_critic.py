"""Says what the simulation of a lens gets wrong about the image points that come."""

from __future__ import annotations

import math
import re
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from fisheye_svp_ros.errors import FisheyeSvpError, ObservationError, ParameterError
from fisheye_svp_ros.io import decoding
from fisheye_svp_ros.io.lens_files import save_lens
from fisheye_svp_ros.io.parameters import parameter
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.camera_info import CAMERA_INFO
from fisheye_svp_ros.nodes.quality import LATCHED
from fisheye_svp_ros.nodes.set_collection import (
    Progress,
    is_repeated,
    make_set,
    scenario_of,
    table_of,
)
from fisheye_svp_ros.nodes.solver import SolverNode
from fisheye_svp_ros.nodes.validation import Items
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.scene.observations import STEREO, Observations
from fisheye_svp_ros.solve.measured_poses import usable_observations
from fisheye_svp_ros.study.settings import RigSettings

if TYPE_CHECKING:
    from fisheye_svp_ros.diagnosis import Diagnosis

T = TypeVar('T')

_ALARMING = {'recalibrate', 'use_extended', 'retake'}  # decisions that warn
_MAX_PARAMETER_TOPICS = 24  # parameters of a cause that are worth a topic each


@dataclass(frozen=True)
class ModelCriticSettings(RigSettings):
    """Parameters of the model critic."""

    sigma_px: float = parameter(
        0.0, 'Standard deviation of an image point. 0: estimate it', 'px', (0.0, 1e3)
    )
    stereo: bool = parameter(
        False, 'Diagnose the cameras left and right of a rig together', fixed=True
    )
    free_intrinsics: bool = parameter(
        False, 'Fit the intrinsics, too. Those of a lens from `calibrate` are always fitted'
    )
    min_frames: int = parameter(
        20, 'Number of frames before the first diagnosis', span=(5, 100_000)
    )
    every_frames: int = parameter(
        20, 'Number of further frames before the next one', span=(1, 100_000)
    )
    max_frames: int = parameter(
        100, 'Largest number of frames to diagnose; the latest are used', span=(5, 100_000)
    )
    output: str = parameter(
        'extended_lens.yaml',
        'File that the services save and write_extended_lens write',
        fixed=True,
    )


class _Running(NamedTuple):
    """A diagnosis under way, the stamp of its last frame, and the number of the question."""

    future: Future[Diagnosis]
    stamp: int
    question: int


class ModelCritic(SolverNode):
    """Collects frames, diagnoses them beside the executor, publishes the verdict."""

    NAME = 'model_critic'
    SETTINGS = ModelCriticSettings
    METRICS = (
        'frames',
        'points',
        'noise_px',
        'base_rms_px',
        'base_heldout_rms_px',
        'extended_rms_px',
        'extended_heldout_rms_px',
        'gain',
        'gain_low',
        'gain_high',
    )
    BY_SCENARIO = True
    settings: ModelCriticSettings

    def __init__(self, node_name: str | None = None, **options: Any) -> None:
        super().__init__(node_name, **options)
        self._scenario: frozenset[tuple[str, str]] = frozenset()
        self._latest: tuple[int, Items]
        self._asked: tuple[object, ...] = ()
        self._question = 0
        self._frames: dict[int, Observations] = {}
        self._new = 0
        self._repeated = 0
        self._announced: tuple[str, ...] = ()
        self._judged = False
        self._running: _Running | None = None
        self._verdict: Diagnosis | None = None
        self._refusal = ''
        for name, answer in (
            ('~/write_extended_lens', self._write_extended_lens),
            ('~/save', self._write_extended_lens),
            ('~/reset', self._reset),
        ):
            self.create_service(Trigger, name, self.guard_callback(answer))
        self._progress = Progress(self)
        self.start_timer(0.2, self._tick)
        self.start()

    @property
    def cameras(self) -> tuple[str, ...]:
        """The namespaces of the cameras, each with its slash."""
        return tuple(f'{name}/' for name in STEREO) if self.settings.stereo else ('',)

    def prepare(self, settings: Any) -> Any:
        """Refuse settings that cannot be used."""
        if settings.min_frames > settings.max_frames:
            raise ParameterError('min_frames is above max_frames, so no diagnosis would start')
        if settings.stereo and settings.lens == CAMERA_INFO:
            raise ParameterError(
                'with rig, lens cannot be camera_info; name one lens file for both cameras'
            )
        if Path(settings.output).is_dir():
            raise ParameterError(f'output is {settings.output!r}, a folder; name a file')
        return super().prepare(settings)

    def configure(self, settings: Any) -> None:
        """Judge what has come so far anew where other settings make that another question."""
        super().configure(settings)
        asked = (
            settings.lens,
            settings.svp,
            settings.sigma_px,
            settings.free_intrinsics,
            settings.max_frames,
        )
        if asked != self._asked:
            self._asked = asked
            self._restart()

    def solve(self, stamp: int, landmarks: decoding.LandmarkSet, items: Items) -> None:
        """Take in one more frame; start over where the scenario is another one."""
        seen = make_set(stamp, items, self.cameras)
        lens = self.lens(stamp, items)  # raises where nobody names one
        for camera in self.cameras:
            self.warn_of_extrapolation(lens, items, camera)
        scenario = scenario_of(items)
        if scenario != self._scenario:
            self._scenario, self._frames, self._repeated = scenario, {}, 0
            self._restart()
        self._latest = stamp, items
        if is_repeated(seen, list(self._frames.values())):
            self._repeated += 1
            self._tell_progress(stamp)
            return
        self._new += stamp not in self._frames
        self._frames[stamp] = seen
        for old in list(self._frames)[: -self.settings.max_frames]:
            del self._frames[old]
        self._tell_progress(stamp)

    def _tell_progress(self, stamp: int) -> None:
        """Tell how many frames there are, and are missing for the next diagnosis."""
        least, every = self.settings.min_frames, self.settings.every_frames
        missing = max(least - len(self._frames), every - self._new if self._judged else 0, 0)
        more = {'views_repeated': self._repeated, 'diagnosing': self._running is not None}
        self._progress.publish(stamp, len(self._frames), missing, more)

    def _reset(self, _: Any, response: Any) -> Any:
        """Forget all frames and the verdict: the next frame is the first."""
        response.success, response.message = True, f'{len(self._frames)} frames forgotten'
        self._frames, self._new, self._repeated = {}, 0, 0
        self._restart()
        self._tell_progress(0)
        return response

    def _restart(self) -> None:
        self._question += 1
        self._judged, self._verdict, self._refusal = False, None, ''

    def _tick(self) -> None:
        if self._running is not None:
            if self._running.future.done():
                done, self._running = self._running, None
                self._tell_progress(done.stamp)
                if done.question == self._question:
                    self._finish(done)
            return
        wanted = self.settings.every_frames if self._judged else 0
        if len(self._frames) >= self.settings.min_frames and self._new >= wanted:
            self._new, self._judged = 0, True
            table, lens = self._table(), self.lens(*self._latest)
            free = self.settings.free_intrinsics or lens.calibration is not None
            work = in_background(lambda: judge(table, lens, free))
            self._running = _Running(work, self._latest[0], self._question)
            self._tell_progress(self._latest[0])

    def _table(self) -> Observations:
        window = list(self._frames.values())[-self.settings.max_frames :]
        table = table_of(window)
        sigma = self.settings.sigma_px
        return replace(table, sigma=np.full(len(table), sigma)) if sigma else table

    def _finish(self, done: _Running) -> None:
        try:
            diagnosis = done.future.result()
        except FisheyeSvpError as error:
            self._refusal = f'not diagnosed: {error}'
            self._complain(error, 'not diagnosed: ')
            self.publish_result(done.stamp, {}, str(error))
            return
        self._verdict = diagnosis
        numbers = figures(diagnosis)
        for name, value in numbers.items():
            if name not in self._metrics:
                self._metrics[name] = self.announce(Float64, f'~/metrics/{name}', LATCHED)
            self._metrics[name].publish(messages.number_message(value))
        said = tuple(one.say for one in diagnosis.decision.values())
        if said != self._announced:
            self._announced = said
            self.get_logger().info(' '.join(_lines(diagnosis)))
        self._result.publish(self._verdict_message(diagnosis, done.stamp, numbers))
        self._publish_diagnostics()

    def _verdict_message(
        self, diagnosis: Diagnosis, stamp: int, numbers: Mapping[str, float]
    ) -> Any:
        words = {
            'verdict': diagnosis.verdict,
            'causes': ' '.join(c.effect for c in diagnosis.causes),
            'candidates': ' '.join(c.effect for c in diagnosis.candidates),
            **decisions(diagnosis),
        }
        return messages.key_values_message(
            f'{self.get_fully_qualified_name()}: verdict',
            {**words, **numbers},
            stamp,
            ' '.join(_lines(diagnosis)),
            DiagnosticStatus.WARN
            if _ALARMING & {one.say for one in diagnosis.decision.values()}
            else DiagnosticStatus.OK,
        )

    def _publish_diagnostics(self) -> None:
        super()._publish_diagnostics()
        if self._repeated and len(self._frames) < self.settings.min_frames:
            self._publish_too_few()
        if self._verdict is not None:
            now = self.get_clock().now().nanoseconds
            numbers = figures(self._verdict)
            self._diagnostics.publish(self._verdict_message(self._verdict, now, numbers))

    def _publish_too_few(self) -> None:
        views = {
            'views': len(self._frames),
            'repeated': self._repeated,
            'min_frames': self.settings.min_frames,
        }
        self._diagnostics.publish(
            messages.key_values_message(
                f'{self.get_fully_qualified_name()}: views',
                views,
                self.get_clock().now().nanoseconds,
                f'too few different views: {views["views"]} of {views["min_frames"]}, '
                f'{self._repeated} repeated; move the camera or the target',
                DiagnosticStatus.WARN,
            )
        )

    def _write_extended_lens(self, request: Any, response: Any) -> Any:
        path = Path(self.settings.output).absolute()
        try:
            if self._verdict is None:
                raise ObservationError(self._refusal or self._what_is_missing())
            save_lens(self._verdict.lens, path, _refusal_reason(self._verdict))
        except FisheyeSvpError as error:
            response.success, response.message = False, str(error)
        else:
            response.success, response.message = True, str(path)
        return response

    def _what_is_missing(self) -> str:
        frames, least = len(self._frames), self.settings.min_frames
        missing = f'no diagnosis yet: {frames} of {least} frames'
        return missing if frames < least else f'{missing}; it is under way, ask again'


def judge(table: Observations, lens: Lens, free_intrinsics: bool) -> Diagnosis:
    """Diagnose the frames that can be posed; raise FisheyeSvpError where none can."""
    # Half of a start would be spent on it, and the first frames come long before a diagnosis.
    from fisheye_svp_ros.diagnosis import diagnose

    usable = usable_observations(table, lens)
    return diagnose(usable.observations, lens, free_intrinsics=free_intrinsics)


def _refusal_reason(diagnosis: Diagnosis) -> str:
    from fisheye_svp_ros.reporting.wording.diagnosis import refusal_reason

    return refusal_reason(diagnosis)


def _lines(diagnosis: Diagnosis) -> list[str]:
    """Return the first screen of a report as sentences."""
    from fisheye_svp_ros.reporting.wording.first_screen import first_screen, terminal_lines

    return [
        line.rstrip('.') + '.'
        for line in terminal_lines(first_screen(diagnosis, 'image_points'))
        if line
    ]


def decisions(diagnosis: Diagnosis) -> dict[str, object]:
    """Return what to do about lens, target and photographs, each with its figure, and bounds."""
    from fisheye_svp_ros.reporting.wording.decisions import decision_reason

    words: dict[str, object] = {}
    for name, one in diagnosis.decision.items():
        unit = _suffix(one.figure.unit)
        words |= {
            f'decision_{name}': one.say,
            f'decision_{name}_why': decision_reason(one),
            f'decision_{name}_{one.figure.name}{unit}': one.figure.value,
        }
        if one.confidence is not None:
            words[f'decision_{name}_confidence'] = one.confidence
        words |= {f'bound_{bound.effect}{_suffix(bound.unit)}': bound.value for bound in one.bound}
    return words


def figures(diagnosis: Diagnosis) -> dict[str, float]:
    """Return METRICS, and the parameters of the causes with their standard errors."""
    base, extended, gain = (
        diagnosis.figures.base,
        diagnosis.figures.extended,
        diagnosis.figures.gain,
    )
    numbers = {
        'frames': diagnosis.frames,
        'points': diagnosis.observations,
        'noise_px': diagnosis.noise_px,
        'base_rms_px': base.rms_px,
        'base_heldout_rms_px': base.heldout_rms_px,
        'extended_rms_px': extended.rms_px,
        'extended_heldout_rms_px': extended.heldout_rms_px,
        'gain': gain.value,
        'gain_low': gain.low,
        'gain_high': gain.high,
    }
    for cause in diagnosis.causes:
        if len(cause.parameters) > _MAX_PARAMETER_TOPICS:
            continue
        for name, entry in cause.parameters.items():
            unit = _suffix(entry['unit'])
            key = f'{cause.effect}_{name}'.replace('.', '_')
            numbers |= {f'{key}{unit}': entry['value'], f'{key}_stderr{unit}': entry['stderr']}
    return {name: float(value) for name, value in numbers.items() if math.isfinite(value)}


def _suffix(unit: str) -> str:
    """Return a unit as the end of a metric's name: nothing, _m2, _per_rad2."""
    return '' if unit in ('', '1') else '_' + re.sub(r'\W', '', unit.replace('1/', 'per_'))


def in_background(work: Callable[[], T]) -> Future[T]:
    """Start work on a thread that does not keep the process from ending."""
    future: Future[T] = Future()

    def complete() -> None:
        try:
            future.set_result(work())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=complete, daemon=True).start()
    return future
