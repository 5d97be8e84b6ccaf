"""Circles that no lens explains, over-exposed or offset ones, and markers in inverted colors."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.patterns import pattern_photograph

from fisheye_svp_ros import cli
from fisheye_svp_ros.detect.patterns import parse_pattern
from fisheye_svp_ros.detect.points import Points, find_points
from fisheye_svp_ros.io.readers import read_observations
from fisheye_svp_ros.simulate.render import Exposure


def drawn_circles(scatter: float) -> np.ndarray:
    """Draw a grid of circles, each off its place by so many px."""
    image, rng = np.full((480, 560), 220, np.uint8), np.random.default_rng(0)
    for row in range(6):
        for column in range(7):
            u, v = 16 * (np.array([70 + 70 * column, 65 + 70 * row]) + rng.normal(0, scatter, 2))
            cv2.circle(image, (round(u), round(v)), 16 * 18, 30, -1, cv2.LINE_AA, 4)
    return cv2.GaussianBlur(image, (0, 0), 1.0)


def test_circles_that_no_lens_explains_are_written_without_sigma(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image, _ = pattern_photograph(parse_pattern('circles:7x6:20mm'), 1)
    uneven = np.full_like(image, 220)
    uneven[100:580, 100:660] = drawn_circles(2.0)
    cv2.imwrite(str(tmp_path / 'even.png'), image)
    cv2.imwrite(str(tmp_path / 'uneven.png'), uneven)
    out = tmp_path / 'o.csv'
    command = ['detect', str(tmp_path), '--board', 'circles:7x6:20mm', '-o', str(out)]
    assert cli.main(command) == 0
    said = capsys.readouterr().err
    assert '1 photographs have centers of unknown sigma' in said and 'uneven.png' in said
    table = read_observations(out)
    assert np.isfinite(table.sigma).tolist() == [True] * 42 + [False] * 42


@pytest.mark.slow
@pytest.mark.parametrize('spec', ['circles:6x5:30mm', 'circles:4x9:17mm:asymmetric'])
@pytest.mark.parametrize('gain', [1.0, 1.6])
def test_over_exposed_and_offset_circles(spec: str, gain: float) -> None:
    pattern = parse_pattern(spec)
    for number in (1, 2):
        image, true = pattern_photograph(pattern, number, Exposure(gain=gain))
        points = find_points(image, pattern, 'circles')
        assert isinstance(points, Points), points
        off = np.abs(points.uv - true[points.ids]).max()
        # An even board looks the same when turned.
        turned = [turn.source for turn in pattern.symmetries]
        assert min(off, *(np.abs(points.uv - true[t][points.ids]).max() for t in turned)) < 0.4


@pytest.mark.skipif(not hasattr(cv2, 'aruco'), reason='this OpenCV has no markers')
@pytest.mark.parametrize(
    'spec', ['charuco:9x7:25mm:18mm:DICT_5X5_100', 'charuco:8x6:28mm:20mm:DICT_4X4_50']
)
def test_inverted_charuco(spec: str) -> None:
    """Bright is dark and dark is bright, as of a board engraved or shown in inverted colors."""
    pattern = parse_pattern(spec)
    image, true = pattern_photograph(pattern, 1)
    points = find_points(255 - image, pattern, 'charuco')
    assert isinstance(points, Points), points
    assert len(points.ids) > 0.7 * len(true)
    assert np.abs(points.uv - true[points.ids]).max() < 0.2
