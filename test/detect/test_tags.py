"""Boards with tags: those that are not decoded are reached from the others."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.patterns import pattern_photograph

from benchmark.studies.detectors import TARGET
from fisheye_svp_ros import cli
from fisheye_svp_ros.detect.patterns import Pattern, parse_pattern
from fisheye_svp_ros.detect.points import find_points
from fisheye_svp_ros.simulate.render import Exposure

CHARUCO = 'charuco:9x7:25mm:18mm:DICT_5X5_100'
pytestmark = pytest.mark.skipif(not hasattr(cv2, 'aruco'), reason='this OpenCV has no markers')


@pytest.fixture
def aprilgrid(tmp_path: Path) -> Pattern:
    path = tmp_path / 'target.yaml'
    path.write_text(TARGET)
    return parse_pattern(f'aprilgrid:{path}')


@pytest.mark.slow
@pytest.mark.parametrize(
    ('number', 'exposure', 'share'),
    [(0, Exposure(), 0.95), (2, Exposure(noise=6.0), 0.95), (4, Exposure(blur=1.5), 0.85)],
)
def test_bent_small_and_noisy_tags(
    aprilgrid: Pattern, number: int, exposure: Exposure, share: float
) -> None:
    """Of these OpenCV decodes 5, 6 and 10 of 30."""
    image, true = pattern_photograph(aprilgrid, number, exposure)
    found = find_points(image, aprilgrid, 'aprilgrid')
    assert not isinstance(found, str), found
    assert len(found.ids) > share * len(true)
    error = found.uv - true[found.ids]
    assert np.abs(error).max() < 0.25
    assert np.sqrt(((error / found.sigma[:, None]) ** 2).mean()) == pytest.approx(1.0, abs=0.25)


def test_corners_without_their_markers() -> None:
    """Of this photograph OpenCV finds 25 of 48 corners."""
    pattern = parse_pattern(CHARUCO)
    image, true = pattern_photograph(pattern, 2)
    found = find_points(image, pattern, 'charuco')
    assert not isinstance(found, str), found
    assert len(found.ids) > 40
    assert np.abs(found.uv - true[found.ids]).max() < 0.1


@pytest.mark.slow
def test_blurred_markers_are_decoded_when_sharpened() -> None:
    pattern = parse_pattern(CHARUCO)
    image, true = pattern_photograph(pattern, 3, Exposure(blur=1.5))
    found = find_points(image, pattern, 'charuco')
    assert not isinstance(found, str), found
    assert len(found.ids) > 40
    assert np.abs(found.uv - true[found.ids]).max() < 0.6


def test_what_is_hidden_is_not_reached(aprilgrid: Pattern) -> None:
    image, true = pattern_photograph(aprilgrid, 1)
    rows, columns = np.indices(image.shape)
    middle = true[50]
    hidden = np.hypot(columns - middle[0], rows - middle[1]) < 40
    texture = 60 + 60 * np.sin(columns / 4.0) * np.sin(rows / 5.0 + columns / 9.0)
    image = np.where(hidden, texture, image).astype(np.uint8)
    found = find_points(image, aprilgrid, 'aprilgrid')
    assert not isinstance(found, str), found
    away = np.linalg.norm(true - middle, axis=1) > 48
    assert set(np.flatnonzero(away)) - set(found.ids) == set()
    assert np.abs(found.uv - true[found.ids]).max() < 0.2


@pytest.mark.parametrize(
    ('change', 'status', 'said'),
    [
        ('Cols: 6', 0, ''),
        (
            'Cols: 5',
            2,
            r'ids grow by 6 from row to row, and tagCols is 5 \(2\); check kind, tagCols',
        ),
        (
            'Rows: 4',
            0,
            r'\d+ of \d+ tags have ids beyond the 6x4 board; check tagCols and tagRows',
        ),
    ],
)
def test_tags_beyond_the_board_are_told(
    aprilgrid: Pattern,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    change: str,
    status: int,
    said: str,
) -> None:
    for number in (1, 2):
        cv2.imwrite(str(tmp_path / f'{number}.png'), pattern_photograph(aprilgrid, number)[0])
    wrong = re.sub(f'{change[:4]}: .', change, TARGET)
    (tmp_path / 'target.yaml').write_text(wrong)
    spec = f'aprilgrid:{tmp_path}/target.yaml'
    assert cli.main(['detect', str(tmp_path), '--board', spec]) == status
    told = capsys.readouterr().err
    assert re.search(said, told) and ('beyond the' in told) == ('beyond' in said)


@pytest.mark.slow
def test_a_live_board_that_is_half_found_is_not_completed() -> None:
    pattern = parse_pattern(CHARUCO)
    for number, most in ((2, 30), (4, 48)):
        image, true = pattern_photograph(pattern, number)
        live = find_points(image, pattern, 'charuco', true)
        assert not isinstance(live, str)
        assert len(live.ids) <= most
        assert np.abs(live.uv - true[live.ids]).max() < 0.1
