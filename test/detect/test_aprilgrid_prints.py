"""AprilGrids as Kalibr and other programs print them; drawn by code that shares none with ours."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.kalibr_grid import Grid, photograph, poses

from fisheye_svp_ros import cli
from fisheye_svp_ros.detect.detection import Detection, detect
from fisheye_svp_ros.detect.patterns import Pattern, parse_pattern
from fisheye_svp_ros.detect.photographs import find_photographs
from fisheye_svp_ros.detect.points import Points, find_points

pytestmark = pytest.mark.skipif(not hasattr(cv2, 'aruco'), reason='this OpenCV has no markers')
VIEWS = poses(4, 1)


def pattern_of(grid: Grid, folder: Path) -> Pattern:
    path = folder / 'target.yaml'
    path.write_text(grid.target)
    return parse_pattern(f'aprilgrid:{path}')


def seen(grid: Grid, folder: Path, view: int = 0) -> tuple[Points | str, np.ndarray]:
    image, (truth,) = photograph([(grid, *VIEWS[view])])
    return find_points(image, pattern_of(grid, folder), 'aprilgrid'), truth


def search(folder: Path, grid: Grid) -> Detection:
    return detect(find_photographs([str(folder)]), pattern_of(grid, folder))


@pytest.mark.parametrize(
    'grid',
    [
        Grid(),  # as Kalibr prints it
        Grid(turn=0),  # as OpenCV's dictionary stands
        Grid(turn=1),
        Grid(5, 3, gap=0.2),
        Grid(border=1),
        Grid(3, 4, turn=0, border=1),
        Grid(from_top=True),
        Grid(5, 3, from_top=True, turn=0),
        Grid(first=20),
        Grid(5, 4, first=7, turn=0),
        Grid(skipped=(0, 5, 6, 10)),
        Grid(2, 1),
        Grid(inverted=True),
        Grid(3, 3, turn=0, border=1, squares=False),
    ],
    ids=str,
)
def test_every_print_is_read_where_it_is(grid: Grid, tmp_path: Path) -> None:
    points, truth = seen(grid, tmp_path)
    assert not isinstance(points, str), points
    assert len(points.ids) > 0.9 * 4 * (grid.columns * grid.rows - len(grid.skipped))
    assert np.abs(points.uv - truth[points.ids]).max() < 0.5


def test_tags_that_are_left_out_are_not_found(tmp_path: Path) -> None:
    points, _ = seen(Grid(skipped=(5,)), tmp_path)
    assert isinstance(points, Points) and not {20, 21, 22, 23} & {*points.ids.tolist()}


def test_columns_and_rows_that_are_exchanged_are_told(tmp_path: Path) -> None:
    image, _ = photograph([(Grid(5, 3), *VIEWS[0])])
    said = find_points(image, pattern_of(Grid(3, 5), tmp_path), 'aprilgrid')
    assert isinstance(said, str) and 'ids grow by 5 from row to row, and tagCols is 3' in said


def test_one_tag_takes_the_layout_of_the_other_photographs(tmp_path: Path) -> None:
    """By itself it leaves open which way it is turned."""
    images = [photograph([(Grid(), *view)])[0] for view in VIEWS[:3]]
    image, (truth,) = photograph([(Grid(), *VIEWS[3])])
    hidden = np.full_like(image, 120)
    low, high = (
        truth[20:24].min(axis=0).astype(int) - 14,
        truth[20:24].max(axis=0).astype(int) + 14,
    )
    hidden[low[1] : high[1], low[0] : high[0]] = image[low[1] : high[1], low[0] : high[0]]
    alone = find_points(hidden, pattern_of(Grid(), tmp_path), 'aprilgrid')
    assert alone == 'no board found: a single tag does not show how the grid is printed'
    for number, one in enumerate([hidden, *images]):
        cv2.imwrite(str(tmp_path / f'{number}.png'), one)
    detection = search(tmp_path, Grid())
    points = detection.searched[0].points
    assert points is not None and points.ids.tolist() == [20, 21, 22, 23]
    assert np.abs(points.uv - truth[points.ids]).max() < 0.5


def test_ids_that_start_elsewhere_are_one_grid_in_all_photographs(tmp_path: Path) -> None:
    """Photographs of a part of the grid do not tell its first id; one of the whole does."""
    grid = Grid(4, 5, first=9)
    part = replace(grid, rows=2, first=17)  # the upper rows of it, cut off
    for number, one in enumerate((grid, grid, part)):
        cv2.imwrite(str(tmp_path / f'{number}.png'), photograph([(one, *VIEWS[number])])[0])
    detection = search(tmp_path, grid)
    assert [one.points is not None for one in detection.searched] == [True] * 3
    last = detection.searched[2].points
    assert last is not None and last.ids.min() == 4 * 8
    truth = photograph([(part, *VIEWS[2])])[1][0]
    assert np.abs(last.uv - truth[last.ids - 4 * 8]).max() < 0.5


@pytest.mark.parametrize('second', [0, 16])
def test_a_second_grid_in_view_is_told(
    second: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whether it has the same ids or those that follow."""
    one, other = Grid(tag=0.03), Grid(tag=0.03, rows=3, first=second)
    for number in range(3):
        turn, place = VIEWS[number]
        aside = np.array([0.1, 0.0, 0.0])
        image, truth = photograph([(one, turn, place - aside), (other, turn, place + aside)])
        cv2.imwrite(str(tmp_path / f'{number}.png'), image)
        points = find_points(image, pattern_of(one, tmp_path), 'aprilgrid')
        assert isinstance(points, Points), points
        of_one = [np.abs(points.uv - uv[points.ids % len(uv)]).max() for uv in truth]
        assert min(of_one if second == 0 else of_one[:1]) < 0.5
    spec = f'aprilgrid:{tmp_path / "target.yaml"}'
    assert cli.main(['detect', str(tmp_path), '--board', spec]) == 0
    assert 'tags of another grid are left out' in capsys.readouterr().err
