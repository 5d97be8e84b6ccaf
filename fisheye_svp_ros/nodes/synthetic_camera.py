"""Simulates what one camera or a rig sees of landmarks; steps through sweeps."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from rcl_interfaces.msg import ParameterDescriptor
from visualization_msgs.msg import MarkerArray

from fisheye_svp_ros.detect.patterns import parse_pattern
from fisheye_svp_ros.detect.photographs import Pixels
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.io.parameters import SWEEP, Sweep, parameter, sweep_of, with_values
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.camera import CameraNode, rows_by_frame
from fisheye_svp_ros.nodes.messages import camera_shape, landmarks_shape, rays_shape
from fisheye_svp_ros.nodes.quality import LATCHED
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.rectify.maps import svp_equivalent
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.simulate.render import Exposure, Print, render
from fisheye_svp_ros.simulate.scenario import (
    Scenario,
    Simulation,
    camera_names,
    check_sweep,
    scalars,
    simulate_in_pieces,
)
from fisheye_svp_ros.study.settings import SyntheticCameraSettings

_SAY_EVERY = 1.0  # s, how far the sweep is


@dataclass(frozen=True)
class PhotographingSettings(SyntheticCameraSettings):
    """Parameters of the synthetic camera and of what it photographs."""

    photograph: str = parameter(
        '',
        'Board, chessboard:COLUMNSxROWS:SIZE: publish rendered images of it on `image`, '
        'instead of landmarks and image points. Its first inner corner is the origin of the '
        'world, x right, y down, z away from the camera',
        fixed=True,
    )


class SweepSet(NamedTuple):
    """Set `place` of the `sets` of scenario `number`; `frame` of the piece that is simulated.

    swept: values of the sweep point; seen: observations by camera; svp_lenses: for `camera_info`.
    """

    number: int
    place: int
    sets: int
    frame: int
    scenario: Scenario
    swept: dict[str, Any]
    simulation: Simulation
    seen: dict[str, Observations]
    svp_lenses: tuple[Lens, ...]


class SyntheticCamera(CameraNode):
    """Publishes the simulated sets of every scenario of its sweep."""

    NAME = 'synthetic_camera'
    SETTINGS = PhotographingSettings
    settings: PhotographingSettings

    def __init__(self, node_name: str | None = None, **options: Any) -> None:
        super().__init__(node_name, **options)
        self._sweep = sweep_of(Scenario, self.given)
        for name, values in self._sweep.lists.items():
            self.declare_parameter(
                SWEEP + name, values, ParameterDescriptor(read_only=True), ignore_override=True
            )
        self._markers = self.announce(MarkerArray, 'markers', LATCHED)
        self.start()

    def prepare(self, settings: PhotographingSettings) -> PhotographingSettings:
        """Refuse settings of which a scenario cannot be simulated."""
        super().prepare(settings)
        if settings.photograph:
            _print_of_board(settings.photograph)
        check_sweep(settings, self._sweep)
        return settings

    @property
    def photographs(self) -> bool:  # type: ignore[override]
        """Whether images are published in place of landmarks and image points."""
        return bool(self.settings.photograph)

    def configure(self, settings: SyntheticCameraSettings) -> None:
        """Start over with new settings."""
        lists = self._sweep.lists
        for style, rig in itertools.product(
            lists.get('style', (settings.style,)), lists.get('rig_file', (settings.rig_file,))
        ):
            for name in camera_names(style, rig):
                self.camera(name)
        self.play(steps(settings, self._sweep))

    def publish_set(self, step: SweepSet, stamp: int) -> None:
        """Publish a set."""
        if self._sweep.lists:
            self.get_logger().info(
                f'scenario {step.number + 1} of {len(self._sweep)}',
                throttle_duration_sec=_SAY_EVERY,
            )
        simulation = step.simulation
        place = {
            'scenario': step.number,
            'scenarios': len(self._sweep),
            'set': step.place,
            'sets': step.sets,
        }
        text = ', '.join(f'{name} {value}' for name, value in step.swept.items())
        self.tag(stamp, {**place, **scalars(step.scenario)}, text)
        self.publish_landmarks(simulation.landmarks, stamp)
        for number, (name, seen) in enumerate(step.seen.items()):
            pose = simulation.poses[number].take(step.frame)
            picture = self._photograph(step, number, pose) if self.photographs else seen
            self.camera(name).publish(stamp, picture, pose, step.svp_lenses[number])
        if self._markers.get_subscription_count():
            world = self.settings.world_frame
            self._markers.publish(messages.markers_message(_shapes(step), stamp, world))

    def _photograph(self, step: SweepSet, camera: int, pose: Pose) -> Pixels:
        rng = np.random.default_rng([step.scenario.seed, step.number, step.place])
        printed = _print_of_board(self.settings.photograph)
        return render(step.simulation.lenses[camera], printed, pose, Exposure(), rng)


def _print_of_board(board: str) -> Print:
    pattern = parse_pattern(board)
    if pattern.kind != 'chessboard':
        raise ParameterError(f'photograph is {board!r}; only a chessboard can be rendered')
    return Print(pattern.columns, pattern.rows, pattern.size)


def steps(settings: SyntheticCameraSettings, sweep: Sweep) -> Iterator[SweepSet]:
    """Yield all sets of all scenarios, over and over where the settings say so."""
    nothing = np.array([], dtype=np.int64)
    for repetition in itertools.count():
        for number, swept in enumerate(sweep):
            scenario = with_values(settings, swept)
            for first, sets, simulation in simulate_in_pieces(scenario, number, repetition):
                svp_lenses = tuple(map(svp_equivalent, simulation.lenses))
                table = simulation.observations
                rows_of = rows_by_frame(table)
                for frame in range(len(simulation.poses[0].position)):
                    seen = {
                        camera: table.take(rows_of.get((frame, camera), nothing))
                        for camera in table.cameras
                    }
                    yield SweepSet(
                        number,
                        first + frame,
                        sets,
                        frame,
                        scenario,
                        swept,
                        simulation,
                        seen,
                        svp_lenses,
                    )
        if not settings.repeat:
            return


def _shapes(step: SweepSet) -> Iterator[messages.Segments]:
    simulation = step.simulation
    yield landmarks_shape(simulation.landmarks.points)
    for number, (name, seen) in enumerate(step.seen.items()):
        pose = simulation.poses[number].take(step.frame)
        yield camera_shape(pose, f'true {name}'.strip(), alpha=1.0)
        yield rays_shape(simulation.lenses[number], pose, seen.xyz, name)
