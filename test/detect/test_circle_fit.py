"""Centers of circles: unbiased by the bend of a fisheye, and as sure as is stated."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from helpers.patterns import pattern_photograph

from benchmark.studies.detectors import LENS
from fisheye_svp_ros.detect.grids import _ellipses, find_circles
from fisheye_svp_ros.detect.patterns import parse_pattern
from fisheye_svp_ros.detect.points import find_points
from fisheye_svp_ros.simulate.render import Exposure


@pytest.mark.parametrize(
    ('spec', 'number'),
    [
        ('circles:8x6:25mm', 2),
        ('circles:4x9:18mm:asymmetric', 1),
        ('circles:4x9:18mm:asymmetric', 3),
    ],
)
def test_centers_are_unbiased_and_as_sure_as_stated(spec: str, number: int) -> None:
    pattern = parse_pattern(spec)
    image, true = pattern_photograph(pattern, number)
    found = find_points(image, pattern, 'circles')
    assert not isinstance(found, str), found
    assert len(found.ids) > 0.95 * len(true)
    orders = [np.argsort(turn.source) for turn in pattern.symmetries]
    error = min(
        (found.uv - true[order][found.ids] for order in orders),
        key=lambda error: float(np.abs(error).max()),
    )
    # The middle of the ellipse is up to a tenth of a pixel beside the image of the center.
    assert np.abs(error.mean(axis=0)).max() < 0.003
    # Centers of one photograph share what is wrong with the lens that fits it.
    assert 0.6 < np.sqrt(((error / found.sigma[:, None]) ** 2).mean()) < 1.6


def test_bright_circles_are_found_as_well() -> None:
    pattern = parse_pattern('circles:8x6:25mm')
    image, _ = pattern_photograph(pattern, 2)
    found = [find_points(one, pattern, 'circles') for one in (image, 255 - image)]
    assert not isinstance(found[0], str)
    assert not isinstance(found[1], str)
    np.testing.assert_allclose(found[0].uv, found[1].uv, atol=0.05)


def test_centers_at_the_edge_of_the_field() -> None:
    """A lens of too few terms bends wrong there: centers were off by 0.008 px."""
    pattern = parse_pattern('circles:8x6:25mm')
    image, true = pattern_photograph(pattern, 3)
    found = find_points(image, pattern, 'circles')
    assert not isinstance(found, str), found
    error = min(
        (found.uv - true[np.argsort(turn.source)][found.ids] for turn in pattern.symmetries),
        key=lambda error: float(np.abs(error).max()),
    )
    outer = np.linalg.norm(found.uv - (LENS.cx, LENS.cy), axis=1) > 355
    assert outer.sum() > 3
    assert np.linalg.norm(error[outer].mean(axis=0)) < 0.006


@pytest.mark.parametrize('spec', ['circles:8x6:25mm', 'circles:4x9:18mm:asymmetric'])
def test_grids_are_found_in_noise(spec: str) -> None:
    pattern = parse_pattern(spec)
    image, _ = pattern_photograph(pattern, 1, Exposure(noise=6.0))
    assert find_circles(image, pattern) is not None


def test_a_lens_that_is_off_the_middle_of_its_image() -> None:
    """Its center was not free, no lens fitted, and centers were off by a pixel."""
    pattern = parse_pattern('circles:8x6:25mm')
    lens = replace(LENS, cx=LENS.cx - 14, cy=LENS.cy + 11)
    image, true = pattern_photograph(pattern, 0, lens=lens)
    found = find_points(image, pattern, 'circles')
    assert not isinstance(found, str), found
    error = min(
        (found.uv - true[np.argsort(turn.source)][found.ids] for turn in pattern.symmetries),
        key=lambda error: float(np.abs(error).max()),
    )
    assert np.abs(error).max() < 0.05


def test_a_small_sheet_is_no_circle_that_holds_the_others() -> None:
    image = np.full((1000, 1200), 80, np.uint8)
    cv2.rectangle(image, (500, 400), (650, 530), 210, -1)
    true = np.stack(np.meshgrid(np.arange(525, 645, 20), np.arange(425, 525, 20)), axis=-1)
    for u, v in true.reshape(-1, 2).tolist():
        cv2.circle(image, (u, v), 6, 20, -1, cv2.LINE_AA)
    found = find_circles(cv2.GaussianBlur(image, (0, 0), 0.7), parse_pattern('circles:6x5:20mm'))
    assert found is not None
    assert {tuple(np.round(uv)) for uv in found[1]} == {tuple(uv) for uv in true.reshape(-1, 2)}


def test_paper_between_circles_is_no_bright_circle() -> None:
    """It was taken for some, and grids of circles in noise came out a row off."""
    image, true = pattern_photograph(parse_pattern('circles:4x9:18mm:asymmetric'), 1)
    assert len(_ellipses(image, bright=True).center) == 0
    dark = _ellipses(cv2.GaussianBlur(image, (0, 0), 1.0), bright=False).center
    assert len(dark) == len(true)
