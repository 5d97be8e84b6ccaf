"""Loose tags are found by id, their corners from the lower left against the clock."""

import cv2
import numpy as np
import pytest

from fisheye_svp_ros.detect.photographs import Photograph
from fisheye_svp_ros.detect.tag_edges import fit_quads
from fisheye_svp_ros.detect.tags import find_tag_views, find_tags, tag_size
from fisheye_svp_ros.errors import ObservationError, ParameterError

pytestmark = pytest.mark.skipif(not hasattr(cv2, 'aruco'), reason='this OpenCV has no markers')


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


def slanted_tags():
    """Return a photograph of small slanted tags, and their corners by id (20, 4, 2), px."""
    rng, fine = np.random.default_rng(2), 8
    large = np.full((fine * 400, fine * 500), 225, np.uint8)
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    corners = []
    for number in range(20):
        middle = np.array([50 + 100 * (number % 5), 50 + 100 * (number // 5)])
        turn = rng.uniform(-0.5, 0.5)
        axes = 12 * np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        axes *= [[1.0], [rng.uniform(0.7, 1.0)]]  # seen from one side
        corners.append(
            middle + rng.uniform(-0.5, 0.5, 2) + [[-1, 1], [1, 1], [1, -1], [-1, -1]] @ axes
        )
        print_ = np.rot90(cv2.aruco.generateImageMarker(family, number, 8), 2).copy()
        ends = np.array([[-0.5, 7.5], [7.5, 7.5], [7.5, -0.5], [-0.5, -0.5]], np.float32)
        warp = cv2.getPerspectiveTransform(
            ends, (fine * (corners[-1] + 0.5) - 0.5).astype(np.float32)
        )
        size = large.shape[::-1]
        ink = cv2.warpPerspective(print_, warp, size, flags=cv2.INTER_NEAREST)
        inside = cv2.warpPerspective(
            np.full_like(print_, 255), warp, size, flags=cv2.INTER_NEAREST
        )
        large[inside > 0] = np.where(ink[inside > 0] > 127, 225, 25)
    photograph = cv2.resize(large, (500, 400), interpolation=cv2.INTER_AREA).astype(float)
    photograph = cv2.GaussianBlur(photograph, (0, 0), 0.7) + rng.normal(0, 2, photograph.shape)
    return np.clip(np.round(photograph), 0, 255).astype(np.uint8), np.array(corners)


def test_corners_of_small_tags_do_not_lie_inwards():
    image, expected = slanted_tags()
    ids, corners = find_tags(image)
    assert len(ids) >= 15
    off, arm = corners - expected[ids], expected[ids] - expected[ids].mean(axis=1, keepdims=True)
    outwards = (off * arm).sum(axis=-1) / np.linalg.norm(arm, axis=-1)
    assert abs(outwards.mean()) < 0.05  # cornerSubPix: -0.3 px
    assert np.sqrt((off**2).sum(axis=-1).mean()) < 0.2


def test_a_tag_without_edges_stays_where_it_was():
    corners = np.array([[[20.0, 40], [40, 40], [40, 20], [20, 20]]])
    for image in (np.full((60, 60), 9, np.uint8), np.eye(60, dtype=np.uint8)):
        fitted = fit_quads(image, corners)
        assert np.isfinite(fitted).all() and np.abs(fitted - corners).max() < 5
    assert fit_quads(image, corners[:0]).shape == (0, 4, 2)


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


def test_an_opencv_without_markers_is_named(monkeypatch):
    monkeypatch.setattr('fisheye_svp_ros.detect.finders._ARUCO', None)
    with pytest.raises(ParameterError, match=r"board 'tags:36h11:160mm': OpenCV .* no markers"):
        tag_size('tags:36h11:160mm')
