"""A result's warning is the node's health, and a gate keeps doubtful poses from a robot."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from helpers.graph import LATCHED, FedLocalizer, Graph, set_parameter

from diagnostic_msgs.msg import DiagnosticArray  # isort: skip
from geometry_msgs.msg import TransformStamped  # isort: skip
from sensor_msgs.msg import PointCloud2  # isort: skip

from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.io.decoding import read_key_values, stamp_of
from fisheye_svp_ros.io.landmark_files import environment
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.recording import note_of_set
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.solver import exchange_reason
from fisheye_svp_ros.nodes.stereo_calibrator import StereoCalibrator
from fisheye_svp_ros.nodes.stereo_depth import StereoDepth
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.scene.observations import group_views, views_of
from fisheye_svp_ros.scene.rigs import rig
from fisheye_svp_ros.simulate.scenario import Scenario, simulate_scenario
from fisheye_svp_ros.solve.localization import localize
from fisheye_svp_ros.solve.solved_poses import gate_reason
from fisheye_svp_ros.study.sweep import plan_sweep, sweep_rows

SEEN = simulate_scenario(Scenario(noise_px=0.3)).observations
SOLVING = ('lens:=fish214', 'sigma_px:=0.3', 'patience:=0.2')


def longer(factor: float) -> np.ndarray:
    """Return image points as of a lens with another focal length."""
    lens = load_lens(lens_path('fish214'))
    center = np.array([lens.cx, lens.cy])
    return center + factor * (SEEN.uv - center)


class Driven(FedLocalizer):
    """A localizer that a robot drives by."""

    def tell(self, stamp: int, uv: Any) -> Any:
        self.feed(stamp, SEEN.landmark, uv, 'camera')
        return self.status(stamp)


def test_the_warning_of_a_result_is_on_diagnostics_and_in_the_log(
    graph: Callable[..., Graph], capfd: pytest.CaptureFixture[str]
) -> None:
    driven = Driven(graph(*SOLVING))
    for stamp in range(1, 11):
        assert 'times what sigma allows' in driven.tell(stamp, longer(1.05)).message
    reports = driven.graph.until(
        lambda: [m for m in driven.reports if 'result: the residuals' in m.status[0].message]
    )
    assert all(m.status[0].level == m.status[0].WARN for m in reports)
    driven.graph.until(
        lambda: read_key_values(driven.reports[-1])['sets: solved with a warning'] == '10'
    )
    assert read_key_values(driven.reports[-1])['sets: solved'] == '10'
    driven.tell(11, SEEN.uv)
    driven.graph.until(lambda: driven.reports[-1].status[0].message == 'all inputs usable')
    said = capfd.readouterr().err
    assert said.count('result: the residuals') == 1, 'ten results are one line'


def test_what_fails_the_gate_has_a_reason_and_no_pose(graph: Callable[..., Graph]) -> None:
    driven = Driven(graph(*SOLVING, 'gate:=3.0'))
    status = driven.tell(1, longer(1.05))
    assert 'sigma_px, above the gate (3 sigma_px)' in status.message and not status.values
    assert float(re.findall(r'are (\S+) sigma_px', status.message)[0]) > 3
    status = driven.tell(2, SEEN.uv[:, ::-1])  # u and v exchanged
    assert not status.values
    assert driven.tell(3, SEEN.uv).values
    driven.graph.until(lambda: driven.poses)
    assert [stamp_of(message) for message in driven.poses] == [3]
    driven.graph.until(
        lambda: driven.reports and read_key_values(driven.reports[-1])['sets: not solved'] == '2'
    )
    assert read_key_values(driven.reports[-1])['image_points: dropped'] == '0'
    assert set_parameter(driven.node, 'gate', 0).successful
    assert driven.tell(4, longer(1.05)).values


@pytest.mark.parametrize(
    ('longest', 'readout', 'told'), [(None, 0.025, True), (0.0, 0.025, False), (None, 0.0, False)]
)
def test_a_rolling_shutter_of_a_camera_that_turns_is_told(
    graph: Callable[..., Graph], longest: float | None, readout: float, told: bool
) -> None:
    """A global shutter has no warning at any pace, with the parameters as they are."""
    parameters = () if longest is None else (f'readout_time:={longest}',)
    driven = Driven(graph(*SOLVING, *parameters))
    lens = load_lens(lens_path('fish214'))
    model, views = ForwardModel(lens), views_of(SEEN.xyz)
    start, rng, texts = localize(model, group_views(SEEN)).pose, np.random.default_rng(1), []

    def seen_from(angle: float) -> np.ndarray:
        turned = start.retract(np.array([[0.0, 0.0, 0.0, 0.0, angle, 0.0]]))
        return np.asarray(model.predict(turned, views, limited=False).uv[0])

    for i in range(6):  # 1 rad/s
        uv = seen_from(0.05 * i)
        late = readout * (uv[:, 1] / lens.height - 0.5)
        uv = np.array([seen_from(0.05 * i + time)[row] for row, time in enumerate(late)])
        uv += 0.3 * rng.normal(size=uv.shape)
        texts.append(driven.tell(10**9 + 50_000_000 * i, uv).message)
    rolling = ['a rolling shutter of' in text for text in texts]
    assert not any(rolling[:2]) and rolling[5] == told
    assert not told or re.search('a rolling shutter of 2[3-7] ± ', texts[5])


def test_a_sweep_offline_has_the_same_gate() -> None:
    def notes(gate: float) -> list[Any]:
        plan = plan_sweep(
            {
                'synthetic_camera': {'noise_px': 0.3, 'sweep.shift_scale': [0.0, 5.0]},
                'localizer': {'sigma_px': 0.3, 'gate': gate},
            }
        )
        return list(sweep_rows(plan, range(2))['localizer.note'])

    assert notes(0.0) == [None, None]
    sound, shifted = notes(1.5)
    assert sound is None and 'above the gate' in shifted
    assert note_of_set(gate_reason(1.5, 157.2)) == shifted, 'as in a table of live results'


def test_exchanged_cameras_of_a_pair_are_told(graph: Callable[..., Graph]) -> None:
    scenario = Scenario(style='parallel', radius=0.5, shift_scale=0.0, poses_file='calibration')
    found = simulate_scenario(scenario)
    g = graph('lens:=fish214', 'svp:=true', 'rig:=topic', 'patience:=0.2')
    kinds = StereoCalibrator, StereoDepth
    heard = [g.hear(DiagnosticArray, f'{kind.NAME}/result') for kind in kinds]
    for kind in kinds:
        g.start(kind)
    given = g.tell(TransformStamped, 'rig', LATCHED)
    given.publish(messages.transform_message(rig('parallel', 0.15).inverse(), 1, '', ''))
    landmarks = g.tell(PointCloud2, 'landmarks', LATCHED)
    landmarks.publish(messages.landmarks_message(environment('whole', 0.5), 0, 'map'))
    points = {name: g.tell(PointCloud2, f'{name}/image_points') for name in ('left', 'right')}
    g.idle(0.3)
    for number, name in enumerate(('right', 'left')):  # exchanged
        rows = (found.observations.camera == number) & (found.observations.frame == 0)
        seen = found.observations.take(np.flatnonzero(rows))
        points[name].publish(messages.image_points_message(seen.landmark, seen.uv, 1, name))
    g.until(lambda: all(heard))
    for results in heard:
        status = results[0].status[0]
        assert status.level == status.WARN
        assert 'the left camera is 0.15 m to the right of the right one' in status.message


def test_cameras_that_look_apart_or_stand_one_above_the_other_are_not_exchanged() -> None:
    turned = rotation_from_vector(np.array([0.0, np.pi, 0.0]))
    for pose in (
        rig('divergent', 0.15),
        Pose(turned, np.array([0.1, 0.0, 0.0])),
        Pose(np.eye(3), np.array([0.05, 0.1, 0.0])),
    ):
        assert not exchange_reason(pose)
