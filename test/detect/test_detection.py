"""Boards in rendered photographs: where their corners are, how sure, and what is refused."""

from __future__ import annotations

import platform
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from time import sleep
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.data import DATA
from helpers.memory import page_faults
from helpers.patterns import pattern_photograph
from helpers.photographs import (
    BOARD,
    LENS,
    photograph,
    poses,
    printed_with,
    true_corners,
    write,
)
from rosbags.typesys import Stores, get_typestore

from fisheye_svp_ros import cli
from fisheye_svp_ros.detect.corner_fit import Corners, fit_corners
from fisheye_svp_ros.detect.detection import Detection, _Task, detect, examine
from fisheye_svp_ros.detect.finders import DETECTORS, dictionary_of
from fisheye_svp_ros.detect.patterns import _MARKERS, LocatedPoints, parse_pattern
from fisheye_svp_ros.detect.photographs import (
    Photograph,
    decode_image,
    doubtful_folders,
    exif_turned,
    find_photographs,
)
from fisheye_svp_ros.detect.points import _least_square, find_points
from fisheye_svp_ros.detect.workers import BoundedCalls, TimedOut, bounded_map
from fisheye_svp_ros.errors import ObservationError, ParameterError
from fisheye_svp_ros.io.bags import BagWriter
from fisheye_svp_ros.io.readers import read_observations
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.simulate.render import Exposure, Print, render
from fisheye_svp_ros.simulate.targets import board_views

PATTERN = parse_pattern(BOARD)


def found(folder: Path, board: str = BOARD) -> Detection:
    return detect(find_photographs([str(folder)]), parse_pattern(board), source=str(folder))


def reasons(detection: Detection) -> dict[str, str]:
    return {Path(one.name).name: one.reason for one in detection.searched}


def test_a_damaged_jpeg_is_called_so_and_libjpeg_writes_nothing(
    capfd: pytest.CaptureFixture[str],
) -> None:
    data = cv2.imencode('.jpg', photograph(poses(1).take(0)))[1].tobytes()
    half = data[: len(data) // 2] + data[-2:]
    seen = examine(_Task(Photograph('a.jpg', 'a', '', 0.0, half), PATTERN, 'quick'))
    assert seen.size == (LENS.width, LENS.height)
    assert 'damaged' in seen.notes[0]
    assert capfd.readouterr().err == ''


def test_corners_do_not_depend_on_where_the_search_saw_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Windows about rough points lean to one side, and reach into the next edge."""
    pose = poses(1).take(0)
    image, true = photograph(pose, exposure=Exposure(blur=1.2)), true_corners(pose)
    rough = np.random.default_rng(0).uniform(-2, 2, true.shape)

    def seen(off: float) -> np.ndarray:
        monkeypatch.setattr(
            'fisheye_svp_ros.detect.points.DETECTORS',
            {'saddle': ((), lambda *_: LocatedPoints(np.arange(len(true)), true + off * rough))},
        )
        points = find_points(image, PATTERN, 'saddle')
        assert not isinstance(points, str)
        assert len(points.ids) == len(true)
        return np.column_stack([points.uv, points.sigma])

    close, far = seen(0.0), seen(1.0)
    assert np.abs(far - close)[:, :2].max() < 0.3 * close[:, 2].min()


def test_live_corners_are_fitted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """But for the few that the search saw elsewhere; and they are as good."""
    fitted: list[int] = []

    def fit(pixels: np.ndarray, start: np.ndarray, *more: Any) -> Corners:
        fitted.append(len(start))
        return fit_corners(pixels, start, *more)

    monkeypatch.setattr('fisheye_svp_ros.detect.points.fit_corners', fit)
    for i in range(3):  # the classic search of OpenCV 4.6 misses the fourth
        pose = poses(4, 2).take(i)
        image, true = photograph(pose), true_corners(pose)
        thorough, live = (find_points(image, PATTERN, name) for name in ('saddle', 'quick'))
        assert not isinstance(thorough, str)
        assert not isinstance(live, str)
        assert live.ids.tolist() == thorough.ids.tolist()
        assert np.abs((live.uv - true) / live.sigma[:, None]).max() < 5
        assert np.abs((live.uv - thorough.uv) / live.sigma[:, None]).max() < 0.5
        assert sum(fitted[2:]) < 1.2 * len(true)
        fitted.clear()


class TestPatterns:
    @pytest.mark.parametrize(
        'spec',
        [
            'chessboard',
            'chessboard:9x6',
            'chessboard:9x6:24',
            'chessboard:9x6:-1mm',
            'chessboard:2x6:1mm',
            'chessboard:9x6:24m',
            'checker:9x6:24mm',
            'chessboard:9x6:1.2.3mm',
            'charuco:5x4:20mm:30mm',
            'squares:3x4:30mm',
            'circles:3x4:1mm:symmetric',
            'aprilgrid:missing.yaml',
            'chessboard:900x600:1mm',
        ],
    )
    def test_refused_in_one_line(self, spec: str) -> None:
        with pytest.raises(ParameterError) as error:
            parse_pattern(spec)
        assert '\n' not in str(error.value)

    @pytest.mark.parametrize(
        ('spec', 'said'),
        [
            (
                'charuco:7x5:30mm:22mm:DICT_9X9_1',
                'no dictionary DICT_9X9_1; choose from DICT_4X4_50, ',
            ),
            (
                'charuco:20x20:30mm:22mm:dict_5x5_100',
                'it needs 200 markers, and DICT_5X5_100 has 100',
            ),
            ('aprilgrid:', "board 'aprilgrid:': the file of a Kalibr target is needed"),
        ],
    )
    def test_what_is_refused_is_named(self, spec: str, said: str) -> None:
        with pytest.raises(ParameterError, match=re.escape(said)):
            parse_pattern(spec)

    def test_dictionaries_are_those_of_opencv(self) -> None:
        if not hasattr(cv2, 'aruco'):
            pytest.skip('this OpenCV has no markers')
        for name, count in _MARKERS.items():
            pattern = parse_pattern(f'charuco:4x4:30mm:22mm:{name}')
            if name != 'DICT_ARUCO_MIP_36H12' or hasattr(cv2.aruco, 'DICT_ARUCO_MIP_36h12'):
                assert len(dictionary_of(pattern).bytesList) == count

    @pytest.mark.parametrize(
        ('spec', 'ways'),
        [
            ('chessboard:9x6:24mm', 1),
            ('chessboard:6x4:24mm', 2),
            ('chessboard:5x3:24mm', 2),
            ('chessboard:5x5:24mm', 2),
            ('chessboard:4x4:24mm', 4),
            ('circles:5x4:2cm', 2),
            ('circles:4x4:2cm', 4),
            ('circles:4x11:2cm:asymmetric', 1),
            ('squares:3x4:30mm:20mm', 2),
        ],
    )
    def test_in_how_many_ways_it_looks_the_same(self, spec: str, ways: int) -> None:
        assert len(parse_pattern(spec).symmetries) == ways

    def test_lengths_in_any_unit(self) -> None:
        for spec in ('chessboard:9x6:0.025m', 'chessboard:9x6:2.5cm', 'chessboard:9x6:25mm'):
            assert parse_pattern(spec).points[-1] == pytest.approx([0.2, 0.125, 0])

    def test_kalibr_target(self, tmp_path: Path) -> None:
        path = tmp_path / 'april.yaml'
        path.write_text(
            "target_type: 'aprilgrid'\ntagCols: 3\ntagRows: 2\ntagSize: 0.05\ntagSpacing: 0.3\n"
        )
        pattern = parse_pattern(f'aprilgrid:{path}')
        assert pattern.points[6] == pytest.approx([0.065 + 0.05, 0.05, 0])


class TestCorners:
    @pytest.mark.slow
    def test_scatter_is_the_stated_sigma(self) -> None:
        pose = poses(3, 1).take(1)
        seen = [find_points(photograph(pose, seed=seed), PATTERN, 'saddle') for seed in range(25)]
        uv = np.stack([one.uv for one in seen if not isinstance(one, str)])
        sigma = np.stack([one.sigma for one in seen if not isinstance(one, str)])
        assert uv.shape == (25, 30, 2)
        ratio = uv.std(axis=0, ddof=1).mean(axis=1) / sigma.mean(axis=0)
        assert np.mean(ratio) == pytest.approx(1.0, abs=0.2)
        assert np.abs(uv.mean(axis=(0, 1)) - true_corners(pose).mean(axis=0)).max() < 0.01

    def test_a_board_that_is_drawn_straight_and_without_noise(self) -> None:
        drawn = np.full((340, 380), 230, np.uint8)
        for row in range(6):
            for column in range(row % 2, 7, 2):
                v, u = 20 + 50 * row, 15 + 50 * column
                drawn[v : v + 50, u : u + 50] = 25
        points = find_points(cv2.GaussianBlur(drawn, (0, 0), 1.0), PATTERN, 'saddle')
        assert not isinstance(points, str), points
        v, u = np.mgrid[:5, :6].reshape(2, -1) * 50.0
        assert np.abs(points.uv - np.stack([u + 64.5, v + 69.5], axis=-1)[points.ids]).max() < 1e-3
        # Grey levels are whole numbers: what rounding them may move a corner by.
        assert points.sigma == pytest.approx(1e-3, rel=0.2)

    def test_uneven_light_and_defocus_do_not_move_corners(self) -> None:
        pose = poses(3, 1).take(1)
        exposure = Exposure(blur=1.8, slope=(0.6, -0.4))
        points = find_points(photograph(pose, exposure=exposure), PATTERN, 'saddle')
        assert not isinstance(points, str)
        assert points.blur == pytest.approx(1.8, abs=0.2)
        error = points.uv - true_corners(pose)[points.ids]
        assert np.abs(error.mean(axis=0)).max() < 0.02

    def test_a_soft_board_that_shrinks_outwards(self) -> None:
        lens, board = replace(LENS, width=640, height=600, cx=320.0, cy=300.0), Print(9, 6, 0.025)
        pose = board_views(lens, board, 8, (0.1, 0.2), np.random.default_rng(3)).take(7)
        image = render(lens, board, pose, Exposure(blur=1.4), np.random.default_rng(0))
        points = find_points(image, parse_pattern('chessboard:9x6:25mm'), 'saddle')
        assert not isinstance(points, str)
        error = points.uv - project(lens, pose.into_body(board.corners)).uv[points.ids]
        assert np.abs(error / points.sigma[:, None]).max() < 5

    def test_outer_squares_are_smaller_than_the_last_ones_between_corners(self) -> None:
        steps = 0.8 ** np.arange(PATTERN.columns)
        u, v = np.meshgrid(100 * np.cumsum(steps), 200.0 * np.arange(PATTERN.rows))
        least = _least_square(np.stack([u, v], axis=-1).reshape(-1, 2), PATTERN)
        expected = 100 * 0.8 ** np.minimum(np.arange(1, PATTERN.columns + 1), PATTERN.columns)
        assert least.reshape(PATTERN.rows, -1)[2] == pytest.approx(expected)

    def test_a_large_soft_image(self) -> None:
        pose = poses(3, 1).take(1)
        large = cv2.resize(photograph(pose), None, fx=6, fy=6, interpolation=cv2.INTER_CUBIC)
        points = find_points(large, PATTERN, 'saddle')
        assert not isinstance(points, str), points
        assert len(points.ids) == 30
        error = (points.uv + 0.5) / 6 - 0.5 - true_corners(pose)
        assert np.abs(error).max() < 0.04
        assert points.blur > 3

    @pytest.mark.parametrize('detector', ['saddle', 'sb', 'classic'])
    def test_every_detector_keeps_the_order(self, detector: str) -> None:
        # The fourth of these poses is too hard for SB and for OpenCV before 4.7, which may find a
        # grid that is a square off.
        old = cv2.__version__ < '4.7'
        for i in range(3 if detector == 'sb' or old else 4):
            pose = poses(4, 2).take(i)
            points = find_points(photograph(pose), PATTERN, detector)
            assert not isinstance(points, str)
            assert np.median(np.abs(points.uv - true_corners(pose)[points.ids])) < 0.2

    def test_near_the_last_place(self) -> None:
        pose = poses(4, 2).take(0)
        image, true = photograph(pose), true_corners(pose)
        points = find_points(image, PATTERN, 'saddle', true + 5)
        lost = find_points(image, PATTERN, 'saddle', (true % 40) + 300)
        assert not isinstance(points, str)
        assert not isinstance(lost, str)
        assert np.abs(points.uv - lost.uv).max() < 0.02

    def test_the_last_place_is_only_glanced_at(self, monkeypatch: Any) -> None:
        """To find none takes OpenCV up to half a second, to find a board 2 ms."""
        searched: list[tuple[int, ...]] = []
        finder = DETECTORS['quick'][1]
        monkeypatch.setattr(
            'fisheye_svp_ros.detect.points.DETECTORS',
            {
                'quick': (
                    ('chessboard',),
                    lambda image, pattern: (searched.append(image.shape), finder(image, pattern))[
                        1
                    ],
                )
            },
        )
        pose = poses(4, 2).take(0)
        image, true = photograph(pose), true_corners(pose)
        here = find_points(cv2.resize(image, None, fx=3, fy=3), PATTERN, 'quick', 3 * true)
        assert not isinstance(here, str) and len(searched) == 1
        assert np.abs((here.uv + 0.5) / 3 - 0.5 - true).max() < 0.2
        find_points(np.zeros((800, 900), np.uint8), PATTERN, 'quick', 3 * true)
        assert max(map(max, searched[:2])) == 350 and searched[2] == (800, 900)

    def test_a_board_of_another_size_is_no_board(self) -> None:
        assert isinstance(
            find_points(
                photograph(poses(1).take(0)), parse_pattern('chessboard:9x8:30mm'), 'saddle'
            ),
            str,
        )

    def test_a_grid_that_lies_a_square_off_is_no_board(self, monkeypatch: Any) -> None:
        pose = poses(4, 2).take(0)
        grid = true_corners(pose).reshape(PATTERN.rows, PATTERN.columns, 2)
        beyond = 2 * grid[:, -1:] - grid[:, -2:-1]
        off = np.concatenate([grid[:, 1:], beyond], axis=1).reshape(-1, 2)
        found = LocatedPoints(np.arange(len(off)), off)
        monkeypatch.setattr(
            'fisheye_svp_ros.detect.points.DETECTORS',
            {'saddle': (('chessboard',), lambda *_: found)},
        )
        assert 'shifted by one square' in str(find_points(photograph(pose), PATTERN, 'saddle'))

    def test_a_steep_board_out_of_focus(self) -> None:
        """Neither search finds it unless the image is sharpened."""
        pattern = parse_pattern('chessboard:9x6:25mm')
        image, true = pattern_photograph(pattern, 0, Exposure(blur=1.5))
        points = find_points(image, pattern, 'saddle')
        assert not isinstance(points, str), points
        assert np.abs(points.uv - true[points.ids]).max() < 0.2

    def test_sixteen_bits(self) -> None:
        pose = poses(4, 2).take(0)
        image = photograph(pose).astype(np.uint16) * 16
        points = find_points(image, PATTERN, 'saddle')
        assert not isinstance(points, str)
        assert np.abs(points.uv - true_corners(pose)[points.ids]).max() < 0.1


class TestTags:
    def warped(self, flat: np.ndarray) -> tuple:
        """Show a flat print obliquely; return the picture and the homography."""
        turn = np.array([[0.5, 0.06, 60], [-0.04, 0.47, 80], [1.2e-4, 0.8e-4, 1]])
        image = cv2.warpPerspective(flat, turn, (520, 480), flags=cv2.INTER_AREA, borderValue=255)
        image = cv2.GaussianBlur(image, (0, 0), 0.7)
        return image, turn

    def test_a_charuco_board_of_an_older_opencv(self) -> None:
        made = getattr(getattr(cv2, 'aruco', None), 'CharucoBoard', None)
        if not hasattr(made, 'setLegacyPattern'):
            pytest.skip('this OpenCV knows no older boards')
        pattern, side = parse_pattern('charuco:6x4:40mm:28mm:DICT_5X5_100'), 60
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
        board = cv2.aruco.CharucoBoard((6, 4), 0.04, 0.028, dictionary)
        for legacy in (False, True):
            board.setLegacyPattern(legacy)
            image = board.generateImage((6 * side, 4 * side), marginSize=0)
            image = cv2.copyMakeBorder(image, 50, 50, 50, 50, cv2.BORDER_CONSTANT, value=255)
            points = find_points(cv2.GaussianBlur(image, (0, 0), 0.8), pattern, 'charuco')
            assert not isinstance(points, str)
            column, row = points.ids % 5, points.ids // 5
            true = 49.5 + side * np.stack([column + 1, row + 1], axis=-1)
            assert len(points.ids) == 15 and np.abs(points.uv - true).max() < 0.1

    def test_charuco(self) -> None:
        if not hasattr(cv2, 'aruco'):
            pytest.skip('this OpenCV has no markers')
        pattern = parse_pattern('charuco:6x5:40mm:28mm:DICT_5X5_100')
        if not hasattr(cv2.aruco, 'CharucoDetector'):
            pytest.skip('boards are drawn by OpenCV 4.7 or newer')
        board = cv2.aruco.CharucoBoard(
            (6, 5), 0.04, 0.028, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
        )
        image, turn = self.warped(board.generateImage((960, 800)))
        points = find_points(image, pattern, 'charuco')
        assert not isinstance(points, str), points
        assert len(points.ids) > 15
        flat = (pattern.points[points.ids, :2] + 0.04) * 4000 - 0.5
        expected = cv2.perspectiveTransform(flat[None], turn)[0]
        assert np.abs(points.uv - expected).max() < 0.5

    @pytest.mark.parametrize(
        ('name', 'value'),
        [
            ('tagCols', '1.5'),
            ('tagCols', '1000000'),
            ('tagRows', '600'),
            ('tagSize', '1e300'),
            ('tagSize', '.nan'),
            ('tagSpacing', '-1'),
        ],
    )
    def test_an_aprilgrid_that_cannot_be(self, tmp_path: Path, name: str, value: str) -> None:
        given = {
            'tagCols': '3',
            'tagRows': '2',
            'tagSize': '0.1',
            'tagSpacing': '0.3',
            name: value,
        }
        path = tmp_path / 'a.yaml'
        path.write_text(
            'target_type: aprilgrid\n' + ''.join(f'{key}: {text}\n' for key, text in given.items())
        )
        with pytest.raises(ParameterError, match=name):
            parse_pattern(f'aprilgrid:{path}')

    def test_aprilgrid(self, tmp_path: Path) -> None:
        if not hasattr(cv2, 'aruco'):
            pytest.skip('this OpenCV has no markers')
        path = tmp_path / 'april.yaml'
        path.write_text(
            "target_type: 'aprilgrid'\ntagCols: 3\ntagRows: 2\ntagSize: 0.1\ntagSpacing: 0.3\n"
        )
        pattern = parse_pattern(f'aprilgrid:{path}')
        flat = np.full((700, 1000), 255, np.uint8)
        cell, gap = 20, 60  # a tag of ten cells; 0.1 m are 200 px
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        left, bottom = 100, 600
        for tag in range(6):
            draw = getattr(cv2.aruco, 'generateImageMarker', None) or cv2.aruco.drawMarker
            picture = draw(dictionary, tag, 10 * cell, borderBits=2)
            u, v = left + 260 * (tag % 3), bottom - 200 - 260 * (tag // 3)
            flat[v : v + 200, u : u + 200] = picture
        for row in range(3):
            for column in range(4):
                u, v = left - gap + 260 * column, bottom - 260 * row
                flat[v : v + gap, u : u + gap] = 0
        image, turn = self.warped(flat)
        points = find_points(image, pattern, 'aprilgrid')
        assert not isinstance(points, str), points
        assert len(points.ids) == 24
        place = pattern.points[points.ids, :2] * 2000
        flat_uv = np.stack([left + place[:, 0], bottom - place[:, 1]], axis=-1) - 0.5
        expected = cv2.perspectiveTransform(flat_uv[None], turn)[0]
        assert np.abs(points.uv - expected).max() < 0.5

    def test_tags_alone_with_a_border_of_one_cell(self, tmp_path: Path) -> None:
        """No squares stand beyond their corners."""
        if not hasattr(cv2, 'aruco'):
            pytest.skip('this OpenCV has no markers')
        path = tmp_path / 'april.yaml'
        path.write_text(
            '{target_type: aprilgrid, tagCols: 2, tagRows: 1, tagSize: 0.1, tagSpacing: 0.3}'
        )
        pattern = parse_pattern(f'aprilgrid:{path}')
        flat = np.full((300, 500), 255, np.uint8)
        assert find_points(flat, pattern, 'aprilgrid') == 'no board found'
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        draw = getattr(cv2.aruco, 'generateImageMarker', None) or cv2.aruco.drawMarker
        for tag in range(2):
            flat[70:230, 60 + 208 * tag : 220 + 208 * tag] = draw(dictionary, tag, 160)
        image, turn = self.warped(flat)
        points = find_points(image, pattern, 'aprilgrid')
        assert not isinstance(points, str), points
        place = pattern.points[points.ids, :2] * 1600
        flat_uv = np.stack([60 + place[:, 0], 230 - place[:, 1]], axis=-1) - 0.5
        expected = cv2.perspectiveTransform(flat_uv[None], turn)[0]
        assert len(points.ids) == 8 and np.abs(points.uv - expected).max() < 1.0

    @pytest.mark.slow
    @pytest.mark.parametrize('spec', ['circles:6x5:40mm', 'circles:4x7:40mm:asymmetric'])
    def test_circles(self, spec: str) -> None:
        pattern = parse_pattern(spec)
        flat = np.full((900, 1100), 255, np.uint8)
        for x, y in pattern.points[:, :2] * 3000 + 120:
            cv2.circle(flat, (round(x), round(y)), 40, 0, -1, cv2.LINE_AA)
        # A camera with f = 400 px that sees the board turned by 35 deg
        place = cv2.Rodrigues(np.radians([-20.0, 28.0, 4.0]))[0][:, :2] / 3000
        turn = np.array([[400.0, 0, 260], [0, 400, 240], [0, 0, 1]]) @ np.column_stack(
            [place, [0.0, 0.0, 0.33] - place @ [550.0, 450.0]]
        )
        image = cv2.warpPerspective(flat, turn, (520, 480), flags=cv2.INTER_AREA, borderValue=255)
        image = cv2.GaussianBlur(image, (0, 0), 0.7)
        points = find_points(image, pattern, 'circles')
        assert not isinstance(points, str), points
        flat_uv = pattern.points[points.ids, :2] * 3000 + 120
        expected = cv2.perspectiveTransform(flat_uv[None], turn)[0]
        assert np.abs(points.uv - expected).max() < 0.6
        assert np.isfinite(points.sigma).all()

    @pytest.mark.parametrize('shadow', [False, True])
    def test_squares(self, shadow: bool) -> None:
        pattern = parse_pattern('squares:3x4:40mm:30mm')
        flat = np.full((900, 800), 255, np.uint8)
        for x, y in pattern.points[::4, :2] * 2500 + 150:
            flat[round(y) : round(y) + 100, round(x) : round(x) + 100] = 0
        if shadow:
            flat[300:] = (0.5 * flat[300:]).astype(np.uint8)
            flat[:, 340:] = (0.6 * flat[:, 340:] + 30).astype(np.uint8)
        image, turn = self.warped(flat)
        points = find_points(image, pattern, 'squares')
        assert not isinstance(points, str), points
        flat_uv = pattern.points[points.ids, :2] * 2500 + 150 - 0.5
        expected = cv2.perspectiveTransform(flat_uv[None], turn)[0]
        assert np.abs(points.uv - expected).max() < 1.0


@pytest.mark.xdist_group('photographs')  # searched once
class TestPhotographs:
    @pytest.fixture(scope='class')
    @classmethod
    def folder(cls, tmp_path_factory: pytest.TempPathFactory) -> Path:
        """Photographs, the first four as they should be and the others each odd in one way."""
        folder = tmp_path_factory.mktemp('photographs')
        where = poses(6, 4)
        images = [photograph(where.take(i)) for i in range(4)]
        write(folder, images)
        cv2.imwrite(str(folder / '10_copy.png'), images[0])
        cv2.imwrite(str(folder / '11_blank.png'), np.full_like(images[0], 128))
        cv2.imwrite(str(folder / '12_size.png'), images[1][:-10])
        cv2.imwrite(
            str(folder / '13_colour.jpg'),
            cv2.cvtColor(photograph(where.take(4)), cv2.COLOR_GRAY2BGR),
            [cv2.IMWRITE_JPEG_QUALITY, 98],
        )
        data = (folder / '13_colour.jpg').read_bytes()
        (folder / '14_cut.jpg').write_bytes(data[: len(data) // 2])
        (folder / '15_empty.png').write_bytes(b'')
        (folder / '16_text.png').write_text('no image')
        cv2.imwrite(
            str(folder / '17_soft.png'), photograph(where.take(5), exposure=Exposure(blur=2.5))
        )
        cv2.imwrite(
            str(folder / '18_burnt.png'),
            photograph(where.take(5), exposure=Exposure(gain=1.5), seed=2),
        )
        deep = photograph(where.take(3), seed=3).astype(np.uint16) * 200
        cv2.imwrite(str(folder / '19_deep.png'), deep)
        return folder

    @pytest.fixture(scope='class')
    @classmethod
    def detection(cls, folder: Path) -> Detection:
        return found(folder)

    @pytest.mark.slow
    def test_the_odd_ones_are_named_and_the_rest_goes_on(self, detection: Detection) -> None:
        said = reasons(detection)
        assert {name for name, reason in said.items() if not reason} == {
            '00.png',
            '01.png',
            '02.png',
            '03.png',
            '13_colour.jpg',
            '17_soft.png',
            '18_burnt.png',
            '19_deep.png',
        }
        assert 'a copy of' in said['10_copy.png']
        assert said['11_blank.png'] == 'no board found'
        assert 'is 424x390 px; the others are 424x400' in said['12_size.png']
        assert 'JPEG is incomplete' in said['14_cut.jpg']
        assert 'the image cannot be read' in said['15_empty.png']
        assert 'the image cannot be read' in said['16_text.png']
        assert all('\n' not in reason for reason in said.values())
        notes = {Path(one.name).name: ' '.join(one.notes) for one in detection.searched}
        assert 'blurred by 2.' in notes['17_soft.png']
        assert 'over-exposed' in notes['18_burnt.png']
        assert 'same viewpoint as 03.png' in notes['19_deep.png']
        assert not notes['00.png']

    def test_observations_are_the_corners(self, detection: Detection) -> None:
        table = detection.observations
        assert detection.image_size == (424, 400)
        assert len(table.frames) == 8
        assert np.isfinite(table.sigma).all()
        for i in range(4):
            mine = table.frame == detection.frames[i]
            true = true_corners(poses(6, 4).take(i))[table.landmark[mine]]
            assert np.abs(table.uv[mine] - true).max() < 0.1

    def test_nothing_found(self, tmp_path: Path) -> None:
        with pytest.raises(ObservationError, match='hold no photograph'):
            found(tmp_path)
        write(tmp_path, [np.full((50, 60), 9, np.uint8)])
        with pytest.raises(ObservationError, match='no board found'):
            found(tmp_path)
        with pytest.raises(ObservationError, match='no such file'):
            found(tmp_path / 'nowhere')

    def test_the_size_is_that_of_images_with_a_board(self, tmp_path: Path) -> None:
        images = [photograph(poses(4, 2).take(i)) for i in (0, 1)]
        write(tmp_path, [*images, images[0][:-10], *(np.full((50, 60), 9, np.uint8),) * 4])
        detection = found(tmp_path)
        assert detection.image_size == (424, 400)
        assert [*reasons(detection).values()] == [
            '',
            '',
            'is 424x390 px; the others are 424x400',
            *('no board found',) * 4,
        ]

    def test_a_rig_by_its_folders(self, tmp_path: Path) -> None:
        images = [photograph(poses(2, 4).take(i)) for i in range(2)]
        write(tmp_path / 'left', images)
        write(tmp_path / 'right', images[::-1])
        table = found(tmp_path).observations
        assert table.cameras == ('left', 'right')
        left, right = (table.take(table.camera == i) for i in (0, 1))
        assert np.abs(left.uv[left.frame == 0] - right.uv[right.frame == 1]).max() < 1e-9

    def test_video(self, tmp_path: Path) -> None:
        path = tmp_path / 'film.avi'
        video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*'MJPG'), 10.0, (424, 400))
        if not video.isOpened():
            pytest.skip('this OpenCV writes no video')
        for i in range(3):
            video.write(cv2.cvtColor(photograph(poses(4, 4).take(i)), cv2.COLOR_GRAY2BGR))
        video.release()
        table = detect(find_photographs([str(path)], every=2), PATTERN).observations
        assert np.unique(table.t).tolist() == pytest.approx([0.0, 0.2])

    @pytest.mark.parametrize('name', ['a.mp4', 'a.avi', 'a.mkv'])
    @pytest.mark.parametrize('size', [0, 5000])
    @pytest.mark.parametrize('head', [b'', b'RIFF\0\0\0\0AVI '])
    def test_a_broken_video(
        self,
        name: str,
        size: int,
        head: bytes,
        tmp_path: Path,
        capfd: pytest.CaptureFixture[str],
    ) -> None:
        (tmp_path / name).write_bytes(head + np.random.default_rng(0).bytes(size))
        with pytest.raises(ObservationError, match='the video is empty or cannot be decoded'):
            list(find_photographs([str(tmp_path / name)]))
        assert capfd.readouterr().err == ''

    def test_exif(self) -> None:
        entry = b'\x12\x01\x03\x00\x01\x00\x00\x00\x06\x00\x00\x00'
        head = b'\xff\xd8\xff\xe1\x00\x22Exif\0\0II*\0\x08\0\0\0\x01\0'
        assert exif_turned(head + entry)
        assert not exif_turned(head + entry.replace(b'\x06', b'\x01'))
        big = b'\xff\xd8\xff\xe1\x00\x22Exif\0\0MM\0*\0\0\0\x08\0\x01'
        assert exif_turned(big + b'\x01\x12\x00\x03\x00\x00\x00\x01\x00\x08\x00\x00')


class TestCameras:
    def cameras(self, *paths: Path) -> list[tuple[str, str]]:
        return [(one.camera, one.key) for one in find_photographs([str(p) for p in paths])]

    @pytest.mark.parametrize(
        ('files', 'cameras'),
        [
            (['left/1.png', 'right/1.png'], [('left', '1'), ('right', '1')]),
            (['cam0/7.png', 'cam1/7.png'], [('cam0', '7'), ('cam1', '7')]),
            (['left01.png', 'right01.png'], [('left', '01'), ('right', '01')]),
            (['photos/1.png'], [('', '1')]),
            (['left01.png', 'left02.png'], [('', 'left01'), ('', 'left02')]),
            (['1.png', 'results/1.png'], [('', '1')]),
        ],
    )
    def test_folders_and_names(
        self, tmp_path: Path, files: list[str], cameras: list[tuple[str, str]]
    ) -> None:
        for name in files:
            (tmp_path / name).parent.mkdir(exist_ok=True)
            (tmp_path / name).touch()
        assert self.cameras(tmp_path) == cameras

    @pytest.mark.parametrize(
        ('files', 'told'),
        [
            (
                ['left01.png', 'right01.png', 'notes.png'],
                'those of one camera, since notes.png names',
            ),
            (['left01.png', 'right01.png'], ''),
            (['left01.png', 'other.png'], ''),
            (['1.png', 'results/1.png'], 'results: its 1 images are skipped'),
            (['1.png', 'results/1.txt'], ''),
            (
                ['1.png', 'second/left/1.png', 'second/right/1.png'],
                'second: its 2 images are skipped',
            ),
            (
                ['left/1.png', 'right/1.png', 'left/old/1.png'],
                'left/old: its 1 images are skipped',
            ),
        ],
    )
    def test_what_may_not_be_meant_is_told(
        self, tmp_path: Path, files: list[str], told: str
    ) -> None:
        for name in files:
            (tmp_path / name).parent.mkdir(exist_ok=True, parents=True)
            (tmp_path / name).touch()
        lines = [*doubtful_folders([str(tmp_path)])]
        assert len(lines) == bool(told)
        assert all(told in line for line in lines)

    @pytest.mark.parametrize(
        ('topics', 'cameras'),
        [
            (['/image_raw', '/image_raw/compressed'], ['']),
            (['/left/image', '/right/image'], ['left', 'right']),
            (['/camera/left/image_raw/compressed'], ['left']),
            (
                ['/cam0/image_raw', '/cam0/image_raw/compressed', '/cam1/image_raw/compressed'],
                ['cam0', 'cam1'],
            ),
        ],
    )
    def test_topics(self, tmp_path: Path, topics: list[str], cameras: list[str]) -> None:
        store = get_typestore(Stores.ROS2_JAZZY)
        make = store.types
        stamp = make['builtin_interfaces/msg/Time'](3, 0)
        header = make['std_msgs/msg/Header'](stamp, 'camera')
        grey = np.full((4, 6), 9, np.uint8)
        with BagWriter(tmp_path / 'bag') as bag:
            for topic in topics:
                kind = 'sensor_msgs/msg/Image'
                message = make[kind](header, 4, 6, 'mono8', 0, 6, grey.ravel())
                if topic.endswith('compressed'):
                    kind = 'sensor_msgs/msg/CompressedImage'
                    data = np.frombuffer(cv2.imencode('.png', grey)[1], np.uint8)
                    message = make[kind](header, 'png', data)
                bag.write(topic, kind, bytes(store.serialize_cdr(message, kind)))
        assert sorted(camera for camera, _ in self.cameras(tmp_path / 'bag')) == cameras
        with pytest.raises(ObservationError, match=f'has images, on {min(topics)}.*--board'):
            read_observations(tmp_path / 'bag')


@pytest.mark.parametrize('shape', [(1, 3072), (48, 8), (40_000, 30), (1, 1)])
def test_an_image_that_opencv_does_not_search_has_no_board(shape: tuple[int, int]) -> None:
    found = find_points(np.zeros(shape, np.uint8), parse_pattern('chessboard:9x6:25mm'), 'quick')
    assert isinstance(found, str) and 'no board found' in found


def test_a_png_that_announces_more_than_it_holds(tmp_path: Path) -> None:
    good = cv2.imencode('.png', np.zeros((48, 64), np.uint8))[1].tobytes()
    for place in (33, good.index(b'IEND') - 4):
        data = bytearray(good)
        data[place : place + 4] = b'\x7f\xff\xff\xf0'  # a length; OpenCV 5 makes room for it
        with pytest.raises(ObservationError, match='the PNG is incomplete'):
            decode_image(bytes(data), 'x')


def test_a_jpeg_of_thousands_of_scans_is_not_decoded() -> None:
    data = cv2.imencode('.jpg', np.zeros((48, 64), np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[
        1
    ].tobytes()
    assert decode_image(data, 'x').shape == (48, 64)
    again = data[data.rindex(b'\xff\xda') : -2]
    with pytest.raises(ObservationError, match='more than 32 scans'):
        decode_image(data[:-2] + 40 * again + data[-2:], 'x')


def test_a_small_file_of_a_huge_image_is_not_decoded(tmp_path: Path) -> None:
    """In a process of its own: the bound holds from before OpenCV is loaded."""
    path, side = tmp_path / 'a.pgm', 20_000
    path.write_bytes(b'P5 %d %d 255 ' % (side, side))
    done = subprocess.run(
        [
            sys.executable,
            '-m',
            'fisheye_svp_ros.cli',
            'detect',
            path,
            '--board',
            'chessboard:9x6:24mm',
            '-o',
            tmp_path / 'a.csv',
        ],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert 'larger than 67 megapixels, or broken' in done.stderr and 'Traceback' not in done.stderr


class TestOrder:
    @pytest.mark.slow
    def test_frames_of_a_symmetric_board_are_turned_alike(self, tmp_path: Path) -> None:
        board = Print(6, 4, 0.030)
        printed = printed_with(0.0003, 5, board)
        where = poses(12, 6, board)
        write(tmp_path, [photograph(where.take(i), printed, seed=i) for i in range(12)])
        detection = found(tmp_path, 'chessboard:6x4:30mm')
        table, turned = detection.observations, []
        for i in range(12):
            mine = table.frame == i
            if mine.any():
                true = true_corners(where.take(i), printed)[table.landmark[mine]]
                turned.append(np.abs(table.uv[mine] - true).max() > 1)
        assert len(turned) > 9
        assert len(set(turned)) == 1
        sure = detection.certainty[detection.frames >= 0]
        assert sure.min() > 0.8

    @pytest.mark.slow
    def test_a_perfect_board_leaves_the_order_open(self, tmp_path: Path) -> None:
        board = Print(6, 4, 0.030)
        where = poses(8, 6, board)
        write(tmp_path, [photograph(where.take(i), board, seed=i) for i in range(5)])
        detection = found(tmp_path, 'chessboard:6x4:30mm')
        assert detection.certainty.mean() < 0.95
        # That is said once, not of each photograph, where it would hide what is said of some.
        assert not any(one.notes for one in detection.searched)

    @pytest.mark.slow
    def test_cameras_of_a_rig_have_the_board_in_one_order(self, tmp_path: Path) -> None:
        board = Print(6, 4, 0.030)
        left = poses(12, 6, board)
        # Mounted upside down: the upper left of its image is another corner's.
        rig = Pose(np.diag([-1.0, -1.0, 1.0]), np.array([0.02, 0.0, 0.0]))
        truth = {'left': left, 'right': left.compose(rig)}
        for name, where in truth.items():
            write(tmp_path / name, [photograph(where.take(i), board, seed=i) for i in range(12)])
        table = found(tmp_path, 'chessboard:6x4:30mm').observations
        turned: dict[int, set[bool]] = {}
        for i in range(12):
            for camera, name in enumerate(table.cameras):
                mine = (table.frame == i) & (table.camera == camera)
                if mine.any():
                    true = true_corners(truth[name].take(i), board)[table.landmark[mine]]
                    turned.setdefault(i, set()).add(np.abs(table.uv[mine] - true).max() > 1)
        both = [i for i in turned if len({*table.camera[table.frame == i]}) == 2]
        assert len(both) > 6
        assert all(len(turned[i]) == 1 for i in both)


def test_a_script_without_a_main_guard_searches_as_well(tmp_path: Path) -> None:
    write(tmp_path, [photograph(poses(4, 2).take(0))])
    script = tmp_path / 'mine.py'
    script.write_text(f"""
from fisheye_svp_ros.detect.detection import detect
from fisheye_svp_ros.detect.patterns import parse_pattern
from fisheye_svp_ros.detect.photographs import find_photographs
print(len(detect(find_photographs([{str(tmp_path)!r}]), parse_pattern({BOARD!r})).observations))
""")
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ('30\n', '')


def test_work_is_bounded_in_time() -> None:
    results = dict(bounded_map(sleep, [0.0, 0.0, 0.0, 120.0, 0.0, 0.0], 1.0))
    assert results[3] == TimedOut(True)
    assert [results[i] for i in (0, 1, 2, 4, 5)] == [None] * 5


def test_a_process_that_dies_between_two_calls_is_replaced() -> None:
    calls = BoundedCalls(abs, 0)

    def called(item: int) -> Any:
        while calls.busy:
            calls.result()
        calls.start(item, 60.0)
        while (result := calls.result()) is None:
            sleep(0.01)
        return result

    assert called(-1) == 1
    calls._worker.process.kill()
    calls._worker.process.wait()
    assert called(-2) == TimedOut(False)
    assert called(-3) == 3
    calls.stop()


@pytest.mark.skipif(platform.libc_ver()[0] != 'glibc', reason='of glibc alone')
def test_workers_keep_their_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is given back has to be cleared anew, page by page, which took as long as the fit."""
    for name in ('MALLOC_MMAP_THRESHOLD_', 'MALLOC_TRIM_THRESHOLD_'):
        monkeypatch.delenv(name, raising=False)  # Dask sets one in a process that starts workers
    assert dict(bounded_map(page_faults, [10], 60.0))[0] < 1000


def half_hidden() -> np.ndarray:
    """Return a photograph of a board, most of it behind light of one brightness."""
    image = photograph(poses(4).take(1)).astype(float)
    middle = true_corners(poses(4).take(1)).mean(axis=0)
    u, v = np.meshgrid(*map(np.arange, image.shape[::-1]))
    image[(u - middle[0]) + 0.4 * (v - middle[1]) > 3] = 255
    return image.astype(np.uint8)


@pytest.mark.filterwarnings('error')
def test_fits_that_diverge_say_nothing() -> None:
    """Windows of anything but corners, with neighbors of any size."""
    rng = np.random.default_rng(3)
    image = half_hidden()
    start = rng.uniform(20, 380, (400, 2))
    axes = rng.normal(0, 300, (400, 2, 2))
    for square in (False, True):
        corners = fit_corners(image, start, axes, rng.uniform(2, 40, 400), square)
        assert np.isfinite(corners.uv[corners.ok]).all()
    noise = rng.integers(0, 2, image.shape).astype(np.uint8) * 255
    fit_corners(noise, start, axes, np.full(400, 12.0))


@pytest.mark.parametrize('name', ['half_hidden_charuco.png', 'gapped_chessboard.png'])
def test_odd_boards_leave_no_warnings(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    path = DATA.parent / 'faults' / 'numpy_warnings' / name
    if not path.exists():
        pytest.skip('the photographs are not here')
    if 'charuco' in name and not hasattr(cv2, 'aruco'):
        pytest.skip('this OpenCV has no markers')
    board = {'half': 'charuco:8x6:25mm:18mm:DICT_4X4_50', 'gapp': 'chessboard:5x4:30mm'}[name[:4]]
    seen = detect(find_photographs([str(path)]), parse_pattern(board))
    assert seen.searched[0].points is not None
    assert 'Warning' not in capfd.readouterr().err


@pytest.mark.parametrize('gain', [1.4, 2.0])
def test_an_over_exposed_board_is_found_where_it_is(gain: float) -> None:
    """Light cut off at the end of the scale moves edges, and corners stay in their middle."""
    for i in (0, 3):
        pose = poses(4, 5).take(i)
        image, true = photograph(pose).astype(float), true_corners(pose)
        burnt = np.clip(gain * image, 0, 255).astype(np.uint8)
        points = find_points(burnt, PATTERN, 'saddle')
        assert not isinstance(points, str), points
        assert len(points.ids) > 0.8 * len(true)
        assert np.abs(points.uv - true[points.ids]).max() < 0.3


def test_a_board_with_more_squares_is_said_to_be_larger(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    larger = Print(9, 6, 0.02)
    write(tmp_path, [photograph(poses(4, 1, larger).take(i), larger) for i in range(4)])
    assert cli.main(['detect', str(tmp_path), '--board', 'chessboard:9x6:20mm']) == 0
    assert 'larger' not in capsys.readouterr().err
    cli.main(['detect', str(tmp_path), '--board', 'chessboard:8x6:20mm'])
    told = capsys.readouterr().err
    assert re.search(r'\d+ of \d+ boards look larger than chessboard:8x6:20mm; count', told)
    assert 'its squares continue beyond the given corners' in told
