"""One bad point costs one point; one reason does not hide another; counters mean one thing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.graph import LATCHED, Graph

from diagnostic_msgs.msg import DiagnosticArray  # isort: skip
from geometry_msgs.msg import PoseWithCovarianceStamped  # isort: skip
from sensor_msgs.msg import PointCloud2  # isort: skip

from fisheye_svp_ros.io.decoding import read_key_values, stamp_of
from fisheye_svp_ros.io.landmark_files import environment
from fisheye_svp_ros.io.lens_files import load_lens, save_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.base import Complaints
from fisheye_svp_ros.nodes.localizer import Localizer
from fisheye_svp_ros.nodes.stereo_depth import StereoDepth
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.scene.observations import Landmarks
from fisheye_svp_ros.simulate.scenario import Scenario, simulate_scenario

SOLVING = ('lens:=fish214', 'svp:=true', 'patience:=0.2')
SEEN = simulate_scenario(Scenario(shift_scale=0.0)).observations
COUNT = len(SEEN.landmark)
WORLD = environment('whole', 2.0)


class Told:
    """A solver, and what tells it image points, some of which cannot be used."""

    def __init__(self, g: Graph, kind: type = Localizer, cameras: tuple[str, ...] = ('',)) -> None:
        self.graph = g
        self.results = g.hear(DiagnosticArray, f'{kind.NAME}/result')
        self.poses = g.hear(PoseWithCovarianceStamped, 'localizer/pose')
        self.reports = g.hear(DiagnosticArray, '/diagnostics')
        self.node = g.start(kind)
        self.landmarks = g.tell(PointCloud2, 'landmarks', LATCHED)
        self.points = [g.tell(PointCloud2, f'{camera}image_points') for camera in cameras]
        g.until(lambda: self.node._result.get_subscription_count() > 0)

    def world(self, landmarks: Landmarks = WORLD, stamp: int = 0) -> None:
        self.landmarks.publish(messages.landmarks_message(landmarks, stamp, 'world'))

    def tell(self, stamp: int, uv: Any = SEEN.uv, ids: Any = SEEN.landmark) -> Any:
        for publisher in self.points:
            publisher.publish(messages.image_points_message(ids, uv, stamp, 'camera'))
        return self.status(stamp)

    def status(self, stamp: int) -> Any:
        """Wait for the result of a stamp."""
        found = self.graph.until(
            lambda: next((m for m in self.results if stamp_of(m) == stamp), None)
        )
        return found.status[0]

    def report(self, wanted: Callable[[str], bool]) -> Any:
        """Wait for a report on /diagnostics whose text is as wanted."""
        return self.graph.until(
            lambda: next((m for m in self.reports if wanted(m.status[0].message)), None)
        )


def spoilt(column: int, value: float) -> np.ndarray:
    uv = SEEN.uv.copy()
    uv[3, column] = value
    return uv


@pytest.mark.parametrize('value', [np.nan, np.inf, 1e300])
def test_a_point_without_a_value_costs_one_point(
    graph: Callable[..., Graph], value: float
) -> None:
    told = Told(graph(*SOLVING))
    told.world()
    status = told.tell(1, spoilt(1, value))
    metrics = {pair.key: float(pair.value) for pair in status.values}
    assert metrics['points'] == COUNT - 1 and metrics['rms_px'] < 1e-6
    assert f'image_points: 1 of {COUNT} points left out: no finite value' in status.message
    assert status.level == status.WARN
    report = told.report(lambda text: f'1 of {COUNT} points left out' in text)
    assert report.status[0].level == status.WARN
    counts = read_key_values(report)
    assert counts['image_points: points without a value'] == '1'
    assert counts['image_points: dropped'] == counts['sets: not solved'] == '0'
    told.graph.until(lambda: told.poses)


def test_an_unknown_landmark_costs_one_point(graph: Callable[..., Graph]) -> None:
    told = Told(graph(*SOLVING))
    told.world()
    ids = SEEN.landmark.copy()
    ids[5] = 4711
    status = told.tell(1, ids=ids)
    assert {pair.key: pair.value for pair in status.values}['points'] == f'{COUNT - 1}.0'
    assert f'1 of {COUNT} points left out: unknown landmarks 4711' in status.message
    report = told.report(lambda text: 'unknown landmarks 4711' in text)
    assert read_key_values(report)['image_points: points of unknown landmarks'] == '1'


def test_mirrored_points_are_told(graph: Callable[..., Graph], tmp_path: Path) -> None:
    lens = replace(load_lens(lens_path('fish214')).svp(), cy=700.0)
    save_lens(lens, tmp_path / 'lens.yaml')
    grid = np.stack(np.meshgrid(np.arange(5), np.arange(4)), axis=-1).reshape(-1, 2)
    board = np.column_stack([0.1 * grid - 0.1, np.full(20, 0.4)])
    uv = project(lens, board).uv
    told = Told(graph(f'lens:={tmp_path}/lens.yaml', 'patience:=0.2'))
    told.world(Landmarks(np.arange(20), board))
    assert 'behind' not in told.tell(1, uv, np.arange(20)).message
    status = told.tell(2, uv * [1, -1] + [0, lens.height - 1], np.arange(20))
    assert 'shows the board from behind: v is counted upward' in status.message


def test_a_strict_node_refuses_the_set(graph: Callable[..., Graph]) -> None:
    told = Told(graph(*SOLVING, 'strict:=true'))
    told.world()
    ids = SEEN.landmark.copy()
    ids[5] = 4711
    status = told.tell(1, ids=ids)
    assert 'landmark 4711 is not one of the landmarks' in status.message and not status.values
    status = told.tell(2, spoilt(0, np.nan))
    assert "field 'u' of point 3 is nan; leave out points" in status.message and not status.values
    assert told.tell(3).values and len(told.poses) <= 1


def test_a_landmark_without_a_place_is_left_out_and_told_as_long_as_it_is_the_latest(
    graph: Callable[..., Graph],
) -> None:
    told = Told(graph(*SOLVING))
    places = WORLD.points.copy()
    places[7, 2] = np.nan
    told.world(Landmarks(WORLD.ids, places))
    status = told.tell(1)
    assert f'1 of {COUNT} points left out: unknown landmarks {WORLD.ids[7]}' in status.message
    told.graph.until(lambda: len(told.reports) > 12)
    assert all('landmarks: 1 of 33 left out' in m.status[0].message for m in told.reports[-5:])
    told.world()
    told.tell(2)
    told.report(lambda text: text == 'all inputs usable')


def test_a_refused_map_is_told_as_long_as_the_old_one_is_used(
    graph: Callable[..., Graph],
) -> None:
    told = Told(graph(*SOLVING))
    told.world()
    told.tell(1)
    told.world(Landmarks(np.array([1, 1]), np.zeros((2, 3))))
    told.report(lambda text: 'landmark 1 is listed twice' in text)
    for stamp in range(2, 22):  # all of them good, but for another complaint
        told.tell(stamp, spoilt(0, np.nan))
    told.reports.clear()
    told.graph.until(lambda: len(told.reports) > 3)
    for report in told.reports[1:]:
        status = report.status[0]
        assert status.level == status.WARN
        assert 'the latest message is refused, the one before is used' in status.message
        assert 'landmark 1 is listed twice' in status.message
    told.world()
    told.report(lambda text: text == 'all inputs usable')


def test_two_reasons_are_told_in_one_report(
    graph: Callable[..., Graph], capfd: pytest.CaptureFixture[str]
) -> None:
    told = Told(graph(*SOLVING), StereoDepth, ('left/', 'right/'))
    told.world()
    ids = SEEN.landmark.copy()
    ids[5] = 4711
    for stamp in range(1, 6):
        told.points[0].publish(messages.image_points_message(ids, SEEN.uv, stamp, 'left'))
        told.points[1].publish(
            messages.image_points_message(SEEN.landmark, spoilt(0, np.nan), stamp, 'right')
        )
        told.status(stamp)
    told.report(
        lambda text: (
            'left/image_points: 1 of' in text
            and 'right/image_points: 1 of' in text
            and 'no rig' in text
        )
    )
    said = capfd.readouterr().err
    assert said.count('left/image_points: 1 of') == said.count('right/image_points: 1 of') == 1


def test_dropped_counts_unusable_messages_alone(graph: Callable[..., Graph]) -> None:
    told = Told(graph(*SOLVING))
    told.world()
    told.tell(1, SEEN.uv[:3], SEEN.landmark[:3])  # too few for a pose
    told.points[0].publish(PointCloud2())
    told.tell(2)
    counts = read_key_values(
        told.graph.until(
            lambda: next(
                (m for m in told.reports if read_key_values(m)['sets: solved'] == '1'), None
            )
        )
    )
    assert counts['image_points: dropped'] == '1'
    assert counts['sets: not solved'] == '2' and counts['sets: dropped'] == '0'


def test_an_image_without_its_partner_is_no_unusable_message(graph: Callable[..., Graph]) -> None:
    told = Told(graph(*SOLVING), StereoDepth, ('left/', 'right/'))
    told.world()
    message = messages.image_points_message(SEEN.landmark, SEEN.uv, 1, 'left')
    told.points[0].publish(message)
    report = told.report(lambda text: 'no message on right/image_points' in text)
    counts = read_key_values(report)
    assert counts['left/image_points: dropped'] == counts['sets: dropped'] == '0'
    assert counts['sets: incomplete'] == counts['sets: taken'] == '1'


def test_a_slot_is_a_topic_and_a_reason() -> None:
    lines: list[str] = []
    complaints = Complaints(lines.append)
    for text in ('a: 1 of 4 is bad', 'b: 1 of 4 is bad', 'a: 2 of 4 is bad', "a: in 'x y'"):
        complaints.add(text, 1e9, 'dropped: ')
    assert complaints.collect() == ['a: 2 of 4 is bad', 'b: 1 of 4 is bad', "a: in 'x y'"]
    assert complaints.collect() == []
    assert lines == [
        'dropped: a: 1 of 4 is bad',
        'dropped: b: 1 of 4 is bad',
        "dropped: a: in 'x y'",
    ]


def test_slots_are_bounded() -> None:
    complaints = Complaints(lambda _: None)
    for number in range(1000):
        complaints.add(chr(0x4E00 + number), 1e9)
    assert len(complaints.collect()) == 20 and len(complaints._logged) == 200


def test_points_beyond_what_is_known_of_the_lens_are_told(
    graph: Callable[..., Graph], tmp_path: Path
) -> None:
    lens = load_lens(lens_path('fish214')).svp()
    save_lens(replace(lens, calibration={'reached_deg': 20.0}), tmp_path / 'lens.yaml')
    told = Told(graph(f'lens:={tmp_path}/lens.yaml', 'patience:=0.2'))
    told.world()
    status = told.tell(1)
    reason = 'deg from the axis, but image points of the calibration reach 20 deg'
    assert status.values and reason in status.message and status.level == status.WARN
    told.report(lambda text: reason in text)
