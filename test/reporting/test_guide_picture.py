"""The guide's picture, and its words."""

import numpy as np
import pytest
from helpers.guide import POINTS, session

from fisheye_svp_ros.planning.guide import DetectedBoard, Guide, evaluate_session
from fisheye_svp_ros.reporting.shot_plots import draw_guide
from fisheye_svp_ros.reporting.wording.shots import guide_words

GREEN, ORANGE = np.array([80, 200, 80]), np.array([40, 123, 224])


@pytest.fixture
def guide():
    return Guide(session(), np.arange(len(POINTS))[None])


def of_color(picture, color):
    return int((np.abs(picture.astype(int) - color).max(axis=-1) < 30).sum())


def test_orange_until_the_board_is_there_then_green(guide):
    pixels = np.full((800, 848), 90, np.uint8)
    assert guide_words(guide)[0] == 'one moment'
    blank = draw_guide(pixels, guide, None)
    assert not of_color(blank, ORANGE) and blank.shape == (800, 848, 3)
    guide.adopt(evaluate_session(guide.session))
    assert 'off the axis' in guide_words(guide)[1] and guide_words(guide)[2] == '0 photographs'
    there = DetectedBoard(0.0, np.arange(len(POINTS)), guide.outline, np.ones(len(POINTS)))
    away = there._replace(uv=there.uv - 200)  # partly out of the picture
    cases = (away, ORANGE, GREEN, 'bring'), (there, GREEN, ORANGE, 'hold')
    for seen, color, other, todo in cases:
        guide.look(0.0, seen)
        picture = draw_guide(pixels, guide, seen)
        assert of_color(picture, color) > 1000 > 10 * of_color(picture, other)
        assert guide_words(guide)[0].startswith(todo)


def test_what_is_settled_and_what_photographs_cannot_tell(guide):
    stand = evaluate_session(guide.session)._replace(
        value=-0.003, stderr=0.0001, named=('viewpoint_shift',), alike=('flat_port',), settled=True
    )
    guide.adopt(stand)
    assert guide_words(guide) == (
        'settled',
        'diagnosis: viewpoint_shift, or flat_port: photographs cannot separate them',
        '0 photographs, e0 -3 +- 0.1 mm, goal +- 0.3',
    )


def test_a_large_image_of_16_bits_makes_a_small_picture(guide):
    pixels = np.full((3000, 4000), 40_000, np.uint16)
    pixels[:10] = 0
    picture = draw_guide(pixels, guide, None)
    assert picture.shape == (960, 1280, 3) and picture[480, 640].tolist() == [255, 255, 255]
