"""`localize` with a map of tags, offline; boards by the ids of their markers."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

import fisheye_svp_ros as fsvp
from fisheye_svp_ros import cli
from fisheye_svp_ros.detect.patterns import parse_pattern
from fisheye_svp_ros.detect.points import Points, find_points
from fisheye_svp_ros.io.lens_files import save_lens
from fisheye_svp_ros.io.tag_maps import TagMap, write_tag_map
from fisheye_svp_ros.optics.curves import Equidistant
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, quaternion_from_rotation, rotation_from_vector

pytestmark = pytest.mark.skipif(not hasattr(cv2, 'aruco'), reason='this OpenCV has no markers')
LENS = Lens('made', 640, 480, 300.0, 300.0, 320.3, 239.6, Equidistant(), np.radians(75.0))
# A wall of tags: x right, y up, z towards the camera
PLACES = {3: (-0.35, 0.15), 8: (0.3, 0.2), 11: (-0.3, -0.25), 20: (0.35, -0.2)}
SIDE = 0.16
MAP = TagMap(
    np.array([*PLACES]),
    np.full(len(PLACES), SIDE),
    Pose(np.tile(np.eye(3), (4, 1, 1)), np.array([(*place, 0.0) for place in PLACES.values()])),
)
# Cameras a meter away that look at the wall: z against its normal
LOOKING = np.diag([1.0, -1.0, -1.0])
CAMERAS = Pose(
    LOOKING @ rotation_from_vector(np.array([[0.05, 0.1, 0.02], [-0.1, -0.15, 0.1]])),
    np.array([[0.1, 0.05, 0.8], [-0.15, 0.1, 0.75]]),
)


def wall(places: dict[int, tuple[float, float]]) -> np.ndarray:
    """Return the print of the wall: 2 by 2 m, 1 px a mm, its middle at (1000, 1000)."""
    sheet = np.full((2000, 2000), 230, np.uint8)
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    for number, (x, y) in places.items():
        left, top = round(1000 + 1000 * (x - SIDE / 2)), round(1000 - 1000 * (y + SIDE / 2))
        mark = np.rot90(cv2.aruco.generateImageMarker(family, number, 160), 2)
        sheet[top : top + 160, left : left + 160] = np.where(mark > 0, 230, 25)
    return sheet


def photograph(sheet: np.ndarray, camera: Pose) -> np.ndarray:
    fine = 3  # samples along each side of a pixel
    steps = (np.arange(640 * fine) + 0.5) / fine - 0.5, (np.arange(480 * fine) + 0.5) / fine - 0.5
    rays = fsvp.back_project(LENS, np.stack(np.meshgrid(*steps), axis=-1)).direction
    ways = np.nan_to_num(rays, nan=0.7) @ camera.rotation.T
    reach = -camera.position[2] / ways[..., 2]
    x, y = (camera.position[i] + reach * ways[..., i] for i in (0, 1))
    u, v = (1000 * x + 999.5).astype(np.float32), (999.5 - 1000 * y).astype(np.float32)
    seen = cv2.remap(sheet, u, v, cv2.INTER_LINEAR, borderValue=90)
    return cv2.resize(seen, (640, 480), interpolation=cv2.INTER_AREA)


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('tags')
    save_lens(LENS, folder / 'lens.yaml')
    write_tag_map(MAP, folder / 'tags.yaml')
    (folder / 'photos').mkdir()
    for number in range(2):
        image = photograph(wall({**PLACES, 40: (0.0, 0.0)}), CAMERAS.take(number))
        cv2.imwrite(str(folder / 'photos' / f'{number}.png'), image)
    return folder


def localized(folder: Path, out: Path, *options: str) -> list[list[float]]:
    command = ['localize', str(folder / 'photos'), '--lens', str(folder / 'lens.yaml')]
    assert cli.main([*command, '-o', str(out), *options]) == 0
    names = ('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw')
    with (out / 'poses.csv').open() as stream:
        return [[float(row[name]) for name in names] for row in csv.DictReader(stream)]


@pytest.mark.parametrize('board', ['tags:36h11', 'tags:36h11:160mm', 'tags:'])
def test_photographs_are_localized_by_a_map(
    board: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A tag that the map does not have is left out."""
    poses = localized(folder, tmp_path, '--board', board, '--tag-map', str(folder / 'tags.yaml'))
    np.testing.assert_allclose([row[:3] for row in poses], CAMERAS.position, atol=2e-3)
    document = json.loads((tmp_path / 'localize.json').read_text())
    assert document['observations'] == 32 and document['rms_px'] < 0.3
    assert 'sigma' not in capsys.readouterr().err


def layout(size: float | None = None) -> dict:
    """The wall as a field layout of WPILib: a tag's x is out of it, y a beholder's right."""
    turn = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])  # its axes on this wall, by columns
    x, y, z, w = quaternion_from_rotation(turn).tolist()
    tags = [
        {
            'ID': number,
            'pose': {
                'translation': {'x': place[0], 'y': place[1], 'z': 0.0},
                'rotation': {'quaternion': {'W': w, 'X': x, 'Y': y, 'Z': z}},
            },
            **({} if size is None else {'size': size}),
        }
        for number, place in PLACES.items()
    ]
    return {'tags': tags, 'field': {'length': 16.54, 'width': 8.21}}


@pytest.mark.parametrize(('board', 'size'), [('tags:36h11:160mm', None), ('tags:36h11', 0.16)])
def test_a_field_layout_of_wpilib_is_a_map(
    board: str, size: float | None, folder: Path, tmp_path: Path
) -> None:
    (tmp_path / 'layout.json').write_text(json.dumps(layout(size)))
    poses = localized(
        folder, tmp_path, '--board', board, '--tag-map', str(tmp_path / 'layout.json')
    )
    np.testing.assert_allclose([row[:3] for row in poses], CAMERAS.position, atol=2e-3)


def test_the_size_that_a_layout_does_not_state_is_told(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / 'layout.json').write_text(json.dumps(layout()))
    localized(folder, tmp_path, '--board', f'tags:{tmp_path}/layout.json')
    assert 'states no size of its tags; 165.1 mm is taken' in capsys.readouterr().err


@pytest.mark.parametrize(
    ('options', 'said'),
    [
        (['--board', 'tags:36h11'], 'loose tags need a map; add its file'),
        (['--board', 'chessboard:9x6:24mm', '--tag-map', 'x.yaml'], 'add --board tags:36h11'),
        (['--tag-map', 'x.yaml'], 'belongs to photographs of loose tags'),
        (
            ['--board', 'tags:36h11:200mm', '--tag-map', 'TAGS'],
            '160 mm wide, not 200 mm as stated',
        ),
        (['--board', 'tags:36h11', '--tag-map', 'missing.yaml'], 'missing.yaml'),
        (['--board', 'tags:36h11', '--tag-map', 'TAGS', '--detector', 'charuco'], 'does not find'),
    ],
)
def test_what_does_not_go_together_is_refused(
    options: list[str], said: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [word.replace('TAGS', str(folder / 'tags.yaml')) for word in options]
    lens = str(folder / 'lens.yaml')
    assert cli.main(['localize', str(folder / 'photos'), '--lens', lens, *words]) == 2
    assert said in capsys.readouterr().err


def test_photographs_of_other_tags_say_which(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_tag_map(MAP._replace(ids=np.array([500, 501, 502, 503])), tmp_path / 'tags.yaml')
    command = ['detect', str(folder / 'photos'), '--board', f'tags:{tmp_path}/tags.yaml']
    assert cli.main(command) == 2
    error = capsys.readouterr().err
    assert 'no tag of the map' in error and 'whether the map has their ids' in error


def board(first: int) -> np.ndarray:
    """Return a print of 6 by 5 squares of 60 px whose markers begin at an id."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    ids = np.arange(first, first + 15, dtype=np.int32)
    known = cv2.aruco.CharucoBoard((6, 5), 0.04, 0.028, dictionary, ids)
    return cv2.GaussianBlur(
        np.pad(known.generateImage((360, 300)), 40, constant_values=255), (0, 0), 0.8
    )


@pytest.mark.skipif(
    not hasattr(getattr(cv2, 'aruco', None), 'CharucoDetector'), reason='OpenCV before 4.7'
)
def test_a_second_charuco_board_is_found_by_its_ids() -> None:
    """Of two boards in one image each pattern finds its own."""
    both = np.hstack([board(0), board(20)])
    for first, left in (('', 0), (':20', 440)):
        pattern = parse_pattern(f'charuco:6x5:40mm:28mm:DICT_5X5_100{first}')
        found = find_points(both, pattern, 'charuco')
        assert isinstance(found, Points) and len(found.ids) == 20
        expected = pattern.points[found.ids, :2] / 0.04 * 60 + [99.5 + left, 99.5]
        np.testing.assert_allclose(found.uv, expected, atol=0.2)
