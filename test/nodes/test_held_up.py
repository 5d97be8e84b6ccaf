"""Sets whose landmarks and camera_info are lost or late, because a solver is held up."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from helpers.graph import Graph
from helpers.nodes import ROOT, NodeProcess

from diagnostic_msgs.msg import DiagnosticArray  # isort: skip
from sensor_msgs.msg import CameraInfo, PointCloud2  # isort: skip

from fisheye_svp_ros.io.decoding import read_key_values, stamp_of
from fisheye_svp_ros.io.landmark_files import environment
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.localizer import Localizer
from fisheye_svp_ros.nodes.quality import LATCHED_SETS, RELIABLE, SENSOR
from fisheye_svp_ros.nodes.synthetic_camera import SyntheticCamera
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.optics.curves import kannala_brandt_equivalent
from fisheye_svp_ros.scene.observations import Landmarks
from fisheye_svp_ros.scene.rigs import paper_pose

MS = 10**6
HELD_UP = 0.3  # s
LENS = load_lens(lens_path('fish214')).svp()
LANDMARKS = environment('whole', 2.0)


def points_message(stamp: int, lens: Any = LENS) -> Any:
    image = project(lens, paper_pose().into_body(LANDMARKS.points))
    return messages.image_points_message(
        LANDMARKS.ids[image.valid], image.uv[image.valid], stamp, 'camera'
    )


def many_landmarks(path: Path) -> Path:
    """Write landmarks of which most are behind the camera: together more than a buffer holds."""
    near = np.random.default_rng(1).uniform(-0.1, 0.1, (2000, 3))
    behind = paper_pose().transform(near - [0, 0, 1])
    points = np.concatenate([LANDMARKS.points, behind])
    path.write_text(
        'landmark,x,y,z\n'
        + ''.join(f'{number},{x},{y},{z}\n' for number, (x, y, z) in enumerate(points))
    )
    return path


def test_every_set_is_solved_though_the_solver_stood_still_for_a_while(
    graph: Callable[..., Graph], start_process: Callable[..., NodeProcess], tmp_path: Path
) -> None:
    g = graph(
        f'environment:={many_landmarks(tmp_path / "many.csv")}',
        'rate:=100.0',
        'wait_for_subscribers:=1',
    )
    results = g.hear(DiagnosticArray, 'localizer/result')
    points = g.hear(PointCloud2, 'image_points')
    env = os.environ | {'PYTHONPATH': os.pathsep.join([str(ROOT), *sys.path])}
    solver = start_process(
        [
            sys.executable,
            '-m',
            'fisheye_svp_ros.cli',
            'run',
            'localizer',
            '--ros-args',
            '-p',
            'backlog:=10000',
            '-p',
            'wait_for_subscribers:=1',
        ],
        env,
    )
    g.until(lambda: g.probe.count_publishers('localizer/result'))
    camera = g.start(SyntheticCamera)
    g.until(lambda: len(results) >= 20)
    solver.process.send_signal(signal.SIGSTOP)
    g.idle(HELD_UP)
    solver.process.send_signal(signal.SIGCONT)
    g.idle(0.5)
    g.executor.remove_node(camera)
    g.until(lambda: stamp_of(points[-1]) == camera._stamp)
    first = min(stamp_of(one) for one in results)
    sent = {stamp for one in points if (stamp := stamp_of(one)) >= first}
    g.until(lambda: sent <= {stamp_of(one) for one in results})
    assert [text for one in results if (text := one.status[0].message)] == []
    assert len(sent) > 20 + 100 * HELD_UP


def test_each_set_has_its_camera_info_though_the_solver_was_busy(
    graph: Callable[..., Graph],
) -> None:
    g = graph('lens:=camera_info')
    results = g.hear(DiagnosticArray, 'localizer/result')
    g.start(Localizer)
    told, info = (
        g.tell(kind, topic, LATCHED_SETS)
        for kind, topic in ((PointCloud2, 'landmarks'), (CameraInfo, 'camera_info'))
    )
    points = g.tell(PointCloud2, 'image_points', RELIABLE)
    told.publish(messages.landmarks_message(LANDMARKS, 0, 'world'))
    g.until(lambda: info.get_subscription_count() > 1 or not g.idle(0.1))
    for number in range(1, 31):  # each with a lens of its own, and nobody takes them
        lens = kannala_brandt_equivalent(LENS.with_parameters(('fx', 'fy'), [400 + number] * 2))
        info.publish(messages.camera_info_message(lens, number * MS, 'camera'))
        points.publish(points_message(number * MS, lens))
        time.sleep(0.01)
    g.until(lambda: len(results) == 30)
    assert all(float(read_key_values(one)['rms_px']) < 1e-6 for one in results)


def test_who_comes_late_counts_no_set_for_the_landmarks_of_old_ones(
    graph: Callable[..., Graph],
) -> None:
    g = graph('lens:=fish214', 'svp:=true')
    results = g.hear(DiagnosticArray, 'localizer/result')
    reports = g.hear(DiagnosticArray, '/diagnostics')
    told = g.probe.create_publisher(PointCloud2, 'landmarks', LATCHED_SETS)
    for stamp in range(1, 51):  # of another world each
        other = Landmarks(LANDMARKS.ids, LANDMARKS.points * (1 + stamp / 100))
        told.publish(messages.landmarks_message(other, stamp * MS, 'world'))
    node = g.start(Localizer)
    points = g.tell(PointCloud2, 'image_points', RELIABLE)
    g.until(lambda: node._inputs['landmarks'].count.received == 50)
    for stamp in range(51, 56):
        told.publish(messages.landmarks_message(LANDMARKS, stamp * MS, 'world'))
        points.publish(points_message(stamp * MS))
    g.until(lambda: len(results) == 5)
    assert all(float(read_key_values(one)['rms_px']) < 1e-6 for one in results)
    reports.clear()
    last = g.until(lambda: reports[1:])[0].status[0]
    counts = {pair.key: pair.value for pair in last.values}
    assert last.message == 'all inputs usable'
    assert counts['sets: taken'] == counts['sets: solved'] == '5'
    assert counts['landmarks: received'] == '55' and counts['landmarks: dropped'] == '0'


def test_all_that_has_come_is_taken_in_before_a_set_is_solved(graph: Callable[..., Graph]) -> None:
    g = graph('lens:=fish214', 'svp:=true', 'backlog:=2')
    results = g.hear(DiagnosticArray, 'localizer/result')
    node = g.start(Localizer)
    told, points = (g.tell(PointCloud2, topic) for topic in ('landmarks', 'image_points'))
    told.publish(messages.landmarks_message(LANDMARKS, 0, 'world'))
    points.publish(points_message(1 * MS))
    g.until(lambda: results)
    for stamp in range(2, 9):
        points.publish(points_message(stamp * MS))
    time.sleep(0.2)  # they wait in the middleware
    counts: dict[str, Any] = {}
    while counts.get('sets: taken') in (None, 1):
        g.executor.spin_once()
        counts = {**node.report()[0]}
    assert [counts[f'sets: {what}'] for what in ('taken', 'solved', 'dropped', 'waiting')] == [
        8,
        2,
        5,
        1,
    ]


def test_publishers_that_everybody_hears_cost_the_executor_nothing(
    graph: Callable[..., Graph],
) -> None:
    node = graph('lens:=fish214', 'svp:=true').start(Localizer)
    entities = len(list(node.waitables))
    node.announce(PointCloud2, 'reliable')
    assert len(list(node.waitables)) == entities
    node.announce(PointCloud2, 'lossy', SENSOR)  # that may not be heard, which is said
    assert len(list(node.waitables)) > entities
