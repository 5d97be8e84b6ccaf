"""How thoroughly photographs are searched: as much is found, with fewer thorough searches."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.photographs import BOARD, LENS, photograph, poses, write

from fisheye_svp_ros.detect import detection, points
from fisheye_svp_ros.detect.detection import Detection, Effort, Look, detect
from fisheye_svp_ros.detect.patterns import parse_pattern
from fisheye_svp_ros.detect.photographs import find_photographs
from fisheye_svp_ros.errors import ObservationError

# One process renders the images.
pytestmark = pytest.mark.xdist_group('photographs')
EMPTY = np.full((LENS.height, LENS.width), 90, np.uint8)


@pytest.fixture(scope='module')
def images() -> list[np.ndarray]:
    return [photograph(poses(4, 7).take(i)) for i in range(4)]


@pytest.fixture
def looks(monkeypatch: pytest.MonkeyPatch) -> list[Look]:
    """Search in this process, one photograph after the other, and return how each was."""
    done: list[Look] = []

    def search(function, tasks, seconds):
        for number, task in enumerate(tasks):
            done.append(task.look)
            yield number, function(task)

    monkeypatch.setattr(detection, 'bounded_map', search)
    return done


def found(folder: Path) -> Detection:
    return detect(find_photographs([str(folder)]), parse_pattern(BOARD))


def test_a_board_that_is_not_there_is_looked_for_a_few_times(
    tmp_path: Path, looks: list[Look]
) -> None:
    write(tmp_path, [EMPTY] * 40)
    with pytest.raises(ObservationError, match=r'no board found \(40\)'):
        found(tmp_path)
    assert looks.count(Look.SAMPLE) == 4
    assert looks.count(Look.FIRST_SEARCH) == 36


def test_once_a_board_is_found_all_are_searched_thoroughly(
    tmp_path: Path, looks: list[Look], images: list[np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """And those before it once more, with the result of a thorough search."""

    def blind(image: np.ndarray, pattern: object) -> None:
        """See nothing at a first look but in the last photographs."""
        return real(image, pattern) if image[0, 0] != 7 else None

    real = detection.FIRST_LOOKS['saddle']
    monkeypatch.setitem(detection.FIRST_LOOKS, 'saddle', blind)
    hidden = [image.copy() for image in images]
    for image in hidden:
        image[0, 0] = 7
    write(tmp_path, [EMPTY] * 4 + hidden[:2] + [EMPTY] * 2 + images[2:])
    seen = found(tmp_path)
    assert [one.points is not None for one in seen.searched] == [False] * 4 + [True] * 2 + [
        False
    ] * 2 + [True] * 2
    assert looks == [Look.SAMPLE] * 3 + [Look.FIRST_SEARCH] * 6 + [Look.THOROUGH] * 6
    for one, image in zip(seen.searched[4:6], hidden, strict=False):
        alone = points.find_points(image, parse_pattern(BOARD), 'saddle')
        assert np.array_equal(one.points.uv, alone.uv)


def test_inverted_boards_are_found_at_a_first_look(
    tmp_path: Path, looks: list[Look], images: list[np.ndarray]
) -> None:
    write(tmp_path, [255 - image for image in images[:3]])
    inverted = found(tmp_path)
    if inverted.searched[0].points is None:
        pytest.skip('this OpenCV does not find the first inverted board')
    assert looks == [Look.SAMPLE, Look.INVERTED_IMAGE, Look.INVERTED_IMAGE]
    for one, image in zip(inverted.searched, images[:3], strict=True):
        alone = points.find_points(255 - image, parse_pattern(BOARD), 'saddle')
        assert np.abs(one.points.uv - alone.uv).max() < 0.1 * alone.sigma.max()


def test_what_cannot_be_read_again_is_searched_at_once() -> None:
    effort = Effort(True)
    assert effort.look(9, False) is Look.SAMPLE
    assert effort.look(9, True) is Look.FIRST_SEARCH
    effort.note(True, False)
    assert effort.look(10, True) is Look.THOROUGH
    assert Effort(False).look(9, True) is Look.THOROUGH


def test_a_first_look_is_at_the_scale_at_which_large_images_are_searched_first(
    images: list[np.ndarray],
) -> None:
    large = cv2.resize(images[0], None, fx=6, fy=6, interpolation=cv2.INTER_CUBIC)
    pattern = parse_pattern(BOARD)
    first = points.find_points(large, pattern, 'saddle', finder=detection.FIRST_LOOKS['saddle'])
    whole = points.find_points(large, pattern, 'saddle')
    assert np.array_equal(first.uv, whole.uv)
