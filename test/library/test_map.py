"""A map of tags: the same from the library and the command."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

import fisheye_svp_ros as fsvp
from fisheye_svp_ros.cli import main
from fisheye_svp_ros.errors import LensError, ParameterError
from fisheye_svp_ros.optics.curves import Perspective
from fisheye_svp_ros.pose import rotation_from_vector

pytestmark = pytest.mark.skipif(not hasattr(cv2, 'aruco'), reason='this OpenCV has no markers')

LENS = fsvp.Lens('wall', 640, 480, 420.0, 420.0, 319.5, 239.5, Perspective(), 0.75)
PIXELS = 1000  # a meter, of the wall
SIZE = 0.16
PLACES = {3: (0.2, 0.3), 5: (0.5, 0.25), 8: (0.8, 0.35)}  # m, of middles on the wall


@pytest.fixture(scope='module')
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of photographs of three tags on a wall."""
    wall, side = np.full((600, 1000), 255, np.uint8), int(SIZE * PIXELS)
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    for number, place in PLACES.items():
        x, y = (round(PIXELS * one - side / 2) for one in place)
        # OpenCV prints tags upside down.
        printed = cv2.aruco.generateImageMarker(family, number, side)[::-1, ::-1]
        wall[y : y + side, x : x + side] = printed
    folder, k = (
        tmp_path_factory.mktemp('walk'),
        np.array([[420, 0, 319.5], [0, 420, 239.5], [0, 0, 1]]),
    )
    # Pixel centers are at whole numbers, the wall is measured from the edge of its pixels.
    wall_of = np.array([[1 / PIXELS, 0, 0.5 / PIXELS], [0, 1 / PIXELS, 0.5 / PIXELS], [0, 0, 1]])
    for number, x in enumerate(np.linspace(0.3, 0.7, 6)):
        turn = rotation_from_vector(np.array([0.3 - 0.1 * number, 0.4 * (x - 0.5), 0.1]))
        plane = np.column_stack([turn[:, :2], -turn @ [x, 0.3, -0.8]])
        image = cv2.warpPerspective(
            wall, k @ plane @ wall_of, (640, 480), flags=cv2.INTER_AREA, borderValue=255
        )
        cv2.imwrite(str(folder / f'{number}.png'), cv2.GaussianBlur(image, (0, 0), 0.7))
    return folder


def test_the_tags_are_where_they_hang(walk: Path, tmp_path: Path) -> None:
    stages = list[str]()
    found = fsvp.map(
        walk, 'tags:36h11:160mm', LENS, origin=5, progress=lambda stage, done: stages.append(stage)
    )
    assert stages == ['searching', 'mapping'] and found.tags.ids.tolist() == [*PLACES]
    # Of a tag, y points up.
    expected = [[x - 0.5, 0.25 - y, 0.0] for x, y in PLACES.values()]
    np.testing.assert_allclose(found.tags.poses.position, expected, atol=2e-3)
    table = found.table()
    assert table['tag'] == [*PLACES] and table['stderr'][1] == 0 < table['stderr'][0] < 2e-3
    np.testing.assert_allclose(found.pose.position[:, 2], 0.8, atol=0.01)

    fsvp.save_lens(LENS, tmp_path / 'lens.yaml')
    command = ['map', str(walk), '--board', 'tags:36h11:160mm', '--origin', '5']
    command += ['--lens', str(tmp_path / 'lens.yaml'), '-o', str(tmp_path / 'told.yaml')]
    assert main(command) == 0
    found.save(tmp_path / 'found.yaml')
    for suffix in ('.poses.csv', '.yaml'):
        one, other = ((tmp_path / f'{name}{suffix}').read_text() for name in ('found', 'told'))
        assert one == other.replace('told.', 'found.')
    assert (tmp_path / 'found.covariance.npz').exists()


@pytest.mark.parametrize(
    ('board', 'options', 'said'),
    [
        ('chessboard:9x6:25mm', {}, 'loose tags are given as'),
        ('tags:36h11:160mm', {'every': 0}, 'every is 0; 1 or more is needed'),
        ('tags:36h11:160mm', {'origin': 'five'}, 'origin is not an array of numbers'),
    ],
)
def test_what_cannot_be_is_refused(walk: Path, board: str, options: dict, said: str) -> None:
    with pytest.raises(ParameterError, match=said):
        fsvp.map([walk], board, LENS, **options)


def test_a_lens_of_another_size_is_refused(walk: Path) -> None:
    with pytest.raises(LensError, match='640x480'):
        fsvp.map(walk, 'tags:36h11:160mm', fsvp.resize_lens(LENS, scale=0.5))
    with pytest.raises(ParameterError, match='no photographs; give at least one'):
        fsvp.map([], 'tags:36h11:160mm', LENS)
