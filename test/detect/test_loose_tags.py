"""Loose tags are found by id, their corners from the lower left against the clock."""

import cv2
import numpy as np
import pytest

from fisheye_svp_ros.detect.photographs import Photograph
from fisheye_svp_ros.detect.tags import find_tag_views, find_tags, tag_size
from fisheye_svp_ros.errors import ObservationError, ParameterError


def sheet(*tags):
    """Return white paper with tags, each an id and the pixel of its upper left cell."""
    image = np.full((400, 600), 255, np.uint8)
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    for number, (u, v) in tags:
        # OpenCV prints a tag of libapriltag turned by half.
        image[v : v + 160, u : u + 160] = np.rot90(
            cv2.aruco.generateImageMarker(family, number, 160), 2
        )
    return cv2.GaussianBlur(image, (0, 0), 0.7)


def test_corners_go_round_from_the_lower_left():
    ids, corners = find_tags(sheet((3, (50, 60)), (40, (350, 100))))
    assert sorted(ids.tolist()) == [3, 40]
    low, high = np.array([49.5, 59.5]), np.array([209.5, 219.5])
    expected = [[low[0], high[1]], high, [high[0], low[1]], low]
    np.testing.assert_allclose(corners[ids.tolist().index(3)], expected, atol=0.15)


def test_an_id_that_is_there_twice_is_left_out():
    ids, _ = find_tags(sheet((3, (50, 60)), (3, (350, 100))))
    assert not len(ids)


def test_images_are_searched_one_by_one():
    photographs = [
        Photograph(f'{n}.png', str(n), '', float('nan'), sheet((n, (50, 60)))) for n in (1, 2)
    ]
    found = find_tag_views(photographs)
    assert found.image.tolist() == [0, 1] and found.ids.tolist() == [1, 2]
    assert found.uv.shape == (2, 4, 2) and found.size == (600, 400)
    with pytest.raises(ObservationError, match='no tag 36h11 in 1 images'):
        find_tag_views([Photograph('a', 'a', '', 0.0, sheet())])


def test_the_size_is_part_of_the_name():
    assert tag_size('tags:36h11:160mm') == pytest.approx(0.16)
    assert tag_size('tags:16cm') == pytest.approx(0.16)
    for spec in ('tags', 'tags:36h11', 'tags:25h9:1cm', 'chessboard:9x6:25mm', 'tags:36h11:0mm'):
        with pytest.raises(ParameterError, match='tags:36h11:160mm'):
            tag_size(spec)
