"""Inputs whose stamps are not those of the sets: trackers, free-running cameras, one map."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.graph import LATCHED, Graph, set_parameter

from diagnostic_msgs.msg import DiagnosticArray  # isort: skip
from geometry_msgs.msg import PoseStamped  # isort: skip
from sensor_msgs.msg import PointCloud2  # isort: skip

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.io.csv_files import write_observations
from fisheye_svp_ros.io.decoding import read_key_values, stamp_of
from fisheye_svp_ros.io.landmark_files import environment
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.readers import write_poses
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.localizer import Localizer
from fisheye_svp_ros.nodes.measured_camera import MeasuredCamera
from fisheye_svp_ros.nodes.stereo_depth import StereoDepth
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.scene.observations import Landmarks
from fisheye_svp_ros.scene.rigs import paper_pose
from fisheye_svp_ros.simulate.scenario import Scenario, simulate_scenario

MS = 10**6
LENS = load_lens(lens_path('fish214')).svp()
LANDMARKS = environment('whole', 2.0)
PATIENCE = 'patience:=30.0'  # s: whoever waits in vain is found out


def moved(seconds: float) -> Pose:
    """Return where a camera is that moves and turns steadily."""
    turn = rotation_from_vector(np.array([0.0, 0.3 * seconds, 0.1 * seconds]))
    return Pose(turn @ paper_pose().rotation, np.array([0.2, -0.1, 0.05]) * seconds)


def points_message(pose: Pose, stamp: int) -> Any:
    image = project(LENS, pose.into_body(LANDMARKS.points))
    return messages.image_points_message(
        LANDMARKS.ids[image.valid], image.uv[image.valid], stamp, 'camera'
    )


class Solving:
    """A solver, and what tells it sets."""

    def __init__(self, g: Graph, kind: type, cameras: tuple[str, ...] = ('',)) -> None:
        self.graph = g
        self.node = g.start(kind)
        self.results = g.hear(DiagnosticArray, f'{kind.NAME}/result')
        self.reports = g.hear(DiagnosticArray, '/diagnostics')
        self.landmarks = g.tell(PointCloud2, 'landmarks', LATCHED)
        self.points = [g.tell(PointCloud2, f'{c}image_points') for c in cameras]
        self.truth = [g.tell(PoseStamped, f'{c}true_pose') for c in cameras]
        g.until(lambda: self.node._result.get_subscription_count() > 0)

    def tell_landmarks(self, stamp: int, shift: float = 0.0) -> None:
        told = Landmarks(LANDMARKS.ids, LANDMARKS.points + shift)
        self.landmarks.publish(messages.landmarks_message(told, stamp, 'world'))

    def tell_pose(self, pose: Pose, stamp: int, camera: int = 0) -> None:
        self.truth[camera].publish(messages.pose_message(pose, stamp, 'world'))

    def metrics(self, stamp: int) -> dict[str, float]:
        """Return the metrics of a set, once they are there."""
        message = self.graph.until(
            lambda: next((m for m in self.results if stamp_of(m) == stamp), None)
        )
        assert not message.status[0].message, message.status[0].message
        return {name: float(value) for name, value in read_key_values(message).items()}


def test_true_poses_of_a_tracker_are_interpolated_without_delay(
    graph: Callable[..., Graph],
) -> None:
    solving = Solving(graph('lens:=fish214', 'svp:=true', PATIENCE), Localizer)
    solving.tell_landmarks(0)
    poses, sets = range(1000, 1500, 10), range(1015, 1400, 33)
    for stamp in poses:
        solving.tell_pose(moved(stamp / 1000), stamp * MS)
    for stamp in sets:
        solving.points[0].publish(
            points_message(moved((stamp + 0.4) / 1000), stamp * MS + 400_000)
        )
    for stamp in sets:
        metrics = solving.metrics(stamp * MS + 400_000)
        assert metrics['position_error_m'] < 1e-6 and metrics['rotation_error_rad'] < 1e-6


def test_a_true_pose_that_nobody_publishes_is_not_waited_for(graph: Callable[..., Graph]) -> None:
    g = graph('lens:=fish214', 'svp:=true', 'patience:=3600.0')
    results = g.hear(DiagnosticArray, 'localizer/result')
    g.start(Localizer)
    told, points = g.tell(PointCloud2, 'landmarks', LATCHED), g.tell(PointCloud2, 'image_points')
    told.publish(messages.landmarks_message(LANDMARKS, 0, 'world'))
    points.publish(points_message(moved(1.0), 1000 * MS))
    assert not g.until(lambda: results)[0].status[0].message


def test_a_measured_camera_announces_true_poses_that_it_has(
    graph: Callable[..., Graph], tmp_path: Path
) -> None:
    """A solver would wait for others, before its first set."""
    write_observations(tmp_path / 'seen.csv', simulate_scenario(Scenario()).observations)
    write_poses(tmp_path / 'poses.csv', np.array([0]), moved(0.0).reshape(1))
    g = graph(
        f'observations:={tmp_path}/seen.csv',
        'lens:=fish214',
        'patience:=3600.0',
        f'folder:={tmp_path}',
        'rate:=20.0',
    )
    results = g.hear(DiagnosticArray, 'localizer/result')
    g.start(Localizer)
    camera = g.start(MeasuredCamera)
    g.until(lambda: results)
    assert not g.probe.count_publishers('/true_pose')
    assert set_parameter(camera, 'true_poses', f'{tmp_path}/poses.csv').successful
    g.until(lambda: 'position_error_m' in read_key_values(results[-1]))


def test_poses_that_are_too_far_apart_give_no_error_and_no_delay(
    graph: Callable[..., Graph],
) -> None:
    solving = Solving(
        graph('lens:=fish214', 'svp:=true', 'true_pose_gap:=0.005', PATIENCE), Localizer
    )
    solving.tell_landmarks(0)
    for stamp in range(1000, 1200, 10):
        solving.tell_pose(moved(stamp / 1000), stamp * MS)
    solving.points[0].publish(points_message(moved(1.104), 1104 * MS))
    metrics = solving.metrics(1104 * MS)
    assert metrics['rms_px'] < 1e-6 and 'position_error_m' not in metrics
    solving.graph.until(
        lambda: any('the nearest stamp is 4.0 ms' in m.status[0].message for m in solving.reports)
    )


def test_a_true_pose_that_is_lost_is_not_made_up(graph: Callable[..., Graph]) -> None:
    """Of scenarios that jump, the poses before and after say nothing of the one between."""
    solving = Solving(graph('lens:=fish214', 'svp:=true', 'patience:=0.3'), Localizer)
    solving.tell_landmarks(0)
    for stamp in (1000, 1010, 1020):
        if stamp != 1010:
            solving.tell_pose(moved(stamp / 100), stamp * MS)
        solving.points[0].publish(points_message(moved(stamp / 100), stamp * MS))
    assert 'position_error_m' not in solving.metrics(1010 * MS)
    assert solving.metrics(1020 * MS)['position_error_m'] < 1e-6


RIG = ('left/', 'right/')


def rig_sets(solving: Solving, stamps: tuple[int, int], offset: Array) -> None:
    right = moved(1.0)
    left = Pose(right.rotation, right.position + right.rotation @ offset)
    solving.tell_landmarks(0)
    for camera, (pose, stamp) in enumerate(zip((left, right), stamps, strict=True)):
        solving.tell_pose(pose, stamp, camera)
        solving.points[camera].publish(points_message(pose, stamp))


@pytest.mark.parametrize('apart', [0, 1 * MS, -1 * MS])
def test_cameras_a_little_apart_are_paired(graph: Callable[..., Graph], apart: int) -> None:
    solving = Solving(
        graph(
            'lens:=fish214',
            'svp:=true',
            'approximate_sync:=true',
            'approximate_sync_tolerance_seconds:=0.001',
            PATIENCE,
        ),
        StereoDepth,
        RIG,
    )
    rig_sets(solving, (1000 * MS, 1000 * MS + apart), np.array([-0.15, 0, 0]))
    metrics = solving.metrics(1000 * MS)
    assert metrics['points'] > 10 and metrics['error3_m'] < 1e-6


@pytest.mark.parametrize(
    'parameters', [(), ('approximate_sync:=true', 'approximate_sync_tolerance_seconds:=0.0009')]
)
def test_cameras_too_far_apart_are_told_by_how_much(
    graph: Callable[..., Graph], parameters: tuple[str, ...]
) -> None:
    solving = Solving(
        graph('lens:=fish214', 'svp:=true', 'patience:=0.2', *parameters), StereoDepth, RIG
    )
    rig_sets(solving, (1000 * MS, 1001 * MS), np.array([-0.15, 0, 0]))
    solving.graph.until(
        lambda: any(
            'the nearest stamp on right/image_points is 1.0 ms off' in m.status[0].message
            or 'the nearest stamp on left/image_points is 1.0 ms off' in m.status[0].message
            for m in solving.reports
        )
    )
    assert not solving.results


def test_landmarks_that_came_once_hold_for_all_sets(graph: Callable[..., Graph]) -> None:
    """Under the stamp of the first set, as a driver may latch them."""
    solving = Solving(graph('lens:=fish214', 'svp:=true', 'patience:=0.2'), Localizer)
    solving.tell_landmarks(1000 * MS)
    for stamp in (1000, 1100, 1200):
        solving.points[0].publish(points_message(moved(1.0), stamp * MS))
    for stamp in (1000, 1100, 1200):
        assert solving.metrics(stamp * MS)['rms_px'] < 1e-6


def test_landmarks_that_come_set_by_set_never_stand_in_for_others(
    graph: Callable[..., Graph],
) -> None:
    solving = Solving(graph('lens:=fish214', 'svp:=true', 'patience:=0.2'), Localizer)
    for stamp in (1000, 1100):
        solving.tell_landmarks(stamp * MS, stamp * 1e-12)
        solving.points[0].publish(points_message(moved(1.0), stamp * MS))
    assert solving.metrics(1100 * MS)
    for stamp in range(1150, 1190):  # however many
        solving.points[0].publish(points_message(moved(1.0), stamp * MS))
        message = solving.graph.until(
            lambda at=stamp * MS: next((m for m in solving.results if stamp_of(m) == at), None)
        )
        assert f'the nearest is {stamp - 1100}.0 ms off' in message.status[0].message
        assert 'with stamp 0' in message.status[0].message
    solving.tell_landmarks(0)
    solving.points[0].publish(points_message(moved(1.0), 1200 * MS))
    assert solving.metrics(1200 * MS)
