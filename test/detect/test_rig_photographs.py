"""Photographs of two cameras: by names, folders, videos and halves of images; of one moment."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.photographs import BOARD, photograph, poses, write

from fisheye_svp_ros import cli
from fisheye_svp_ros.detect.photographs import doubtful_folders, find_photographs
from fisheye_svp_ros.detect.rig_photographs import (
    alike_series,
    pair_photographs,
    split_names,
    stamp_of,
)
from fisheye_svp_ros.io.readers import read_observations
from fisheye_svp_ros.scene.observations import make_observations
from fisheye_svp_ros.scene.table_checks import looks_side_by_side


def film(path: Path, views: list[int]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*'MJPG'), 10.0, (424, 400))
    if not video.isOpened():
        pytest.skip('this OpenCV writes no video')
    for i in views:
        video.write(cv2.cvtColor(photograph(poses(4, 4).take(i)), cv2.COLOR_GRAY2BGR))
    video.release()


@pytest.mark.parametrize(
    ('names', 'cameras'),
    [
        (['left01', 'right01'], [('left', '01'), ('right', '01')]),
        (['0001_left', '0001_right'], [('left', '0001'), ('right', '0001')]),
        (['imgL01', 'imgR01'], None),
        (['frameLeft01', 'frameRight01'], [('left', 'frame_01'), ('right', 'frame_01')]),
        (['img_l_01', 'img_r_01'], [('left', 'img_01'), ('right', 'img_01')]),
        (['CAM0_1', 'CAM1_1'], [('cam0', '1'), ('cam1', '1')]),
        (['camera-1_7', 'camera-2_7'], [('camera1', '7'), ('camera2', '7')]),
        (['bright01', 'right01'], None),
        (['left01', 'left02'], None),
        (['left01', 'right01', 'notes'], None),
        (['cam1', 'cam2', 'cam3'], None),
    ],
)
def test_names_of_cameras(names: list[str], cameras: list[tuple[str, str]] | None) -> None:
    assert split_names(names) == cameras


def test_series_of_equal_numbers_may_be_cameras() -> None:
    assert alike_series([f'infra{i}_{n}' for i in (1, 2) for n in range(4)])
    assert not alike_series([f'infra1_{n}' for n in range(4)])
    assert not alike_series(['board1', 'board2', 'test3', 'test4'])


@pytest.mark.parametrize(
    ('files', 'given', 'cameras'),
    [
        (['left01.png', 'right01.png'], ['left01.png', 'right01.png'], ['left', 'right']),
        (['left/1.png', 'right/1.png'], ['left/1.png', 'right/1.png'], ['left', 'right']),
        (['left/1.png', 'right/1.png'], ['left', 'right'], ['left', 'right']),
        (['a/cam0/1.png', 'a/cam1/1.png'], ['a/cam0', 'a/cam1'], ['cam0', 'cam1']),
        (['first/1.png', 'second/1.png'], ['first', 'second'], ['', '']),
    ],
)
def test_files_and_folders_given_apart(
    tmp_path: Path, files: list[str], given: list[str], cameras: list[str]
) -> None:
    for name in files:
        (tmp_path / name).parent.mkdir(exist_ok=True, parents=True)
        (tmp_path / name).touch()
    found = [*find_photographs([str(tmp_path / one) for one in given])]
    assert [one.camera for one in found] == cameras
    assert len({one.key for one in found}) == (1 if any(cameras) else 2)


@pytest.mark.parametrize(
    ('videos', 'given'),
    [
        (['left.avi', 'right.avi'], ['left.avi', 'right.avi']),
        (['run_right.avi', 'run_left.avi'], ['.']),
        (['left/a.avi', 'right/b.avi'], ['.']),
        (['cam0/a.avi', 'cam1/a.avi'], ['cam0', 'cam1']),
    ],
)
def test_videos_of_two_cameras(tmp_path: Path, videos: list[str], given: list[str]) -> None:
    for number, name in enumerate(videos):
        film(tmp_path / name, [number, 2, 3])
    out = tmp_path / 'o.csv'
    paths = [str(tmp_path / one) for one in given]
    assert cli.main(['detect', *paths, '--board', BOARD, '-o', str(out)]) == 0
    table = read_observations(out)
    assert len(table.cameras) == 2 and len(table.frames) == 3


@pytest.mark.parametrize(
    ('files', 'told'),
    [
        (['one.avi', 'two.avi'], 'these videos count as those of one camera'),
        (['left.avi', 'right.avi'], ''),
        ([f'{name}{i}.png' for name in 'ab' for i in range(4)], 'images named a and b with equal'),
        (['1.png', 'film.avi'], 'its 1 videos are skipped'),
    ],
)
def test_what_may_be_two_cameras_is_told(tmp_path: Path, files: list[str], told: str) -> None:
    for name in files:
        (tmp_path / name).touch()
    lines = [*doubtful_folders([str(tmp_path)])]
    assert len(lines) == bool(told) and all(told in line for line in lines)


@pytest.fixture
def side_by_side(tmp_path: Path) -> Path:
    """Photographs of two cameras, each pair in one image."""
    images = [photograph(poses(4, 2).take(i)) for i in range(4)]
    write(tmp_path / 'joined', [np.hstack([one, images[i - 1]]) for i, one in enumerate(images)])
    return tmp_path / 'joined'


@pytest.mark.parametrize('split', [[], ['--split', '2']])
def test_images_side_by_side_are_a_rig(
    side_by_side: Path, split: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    out = side_by_side.parent / 'o.csv'
    command = ['detect', str(side_by_side), '--board', BOARD, '-o', str(out)]
    overlays = side_by_side.parent / 'overlays'
    assert cli.main([*command, *split, '--overlays', str(overlays)]) == 0
    assert ('both halves of these wide images' in capsys.readouterr().err) == (not split)
    table = read_observations(out)
    assert table.cameras == ('left', 'right') and len(table.frames) == 4
    first = table.take((table.frame == 0) & (table.camera == 0))
    again = table.take((table.frame == 1) & (table.camera == 1))
    assert np.abs(first.uv - again.uv).max() < 1e-9
    assert len([*overlays.iterdir()]) == 9


@pytest.mark.parametrize(('gap', 'told'), [(0.4, True), (0.0, False)])
def test_a_table_of_two_cameras_is_told(gap: float, told: bool) -> None:
    """Frames lie left or right of the middle and none across it, or anywhere."""
    rng = np.random.default_rng(0)
    center = rng.uniform(0.12, 0.88, 12)
    center += np.where(center < 0.5, -1, 1) * 0.1 if gap else 0.0
    u = 2560 * np.clip(center, 0.05, 0.95)[:, None] + np.linspace(-90, 90, 6)
    frame, landmark = np.indices(u.shape)
    uv = np.stack([u.ravel(), np.full(u.size, 300.0)], axis=-1)
    table = make_observations(frame.ravel(), landmark.ravel(), uv, np.zeros((u.size, 3)))
    assert looks_side_by_side(table, (2560, 960)) == told
    assert not looks_side_by_side(table, (2560, 1600))


BASE = 1403636579763555584


@pytest.mark.parametrize(
    ('name', 'stamp'),
    [
        (str(BASE), BASE),
        ('1403636579763555', 1403636579763555000),
        ('1403636579763', 1403636579763 * 10**6),
        ('1403636579.763555', 1403636579763555000),
        ('frame_1403636579_763555584', BASE),
        ('left01', None),
        ('20240210', None),
        ('IMG_20240210_101112', None),
    ],
)
def test_stamps_in_names(name: str, stamp: int | None) -> None:
    assert stamp_of(name) == stamp


def paired(
    left: Sequence[str], right: Sequence[str], t: Sequence[float] = (), sync: float | None = None
) -> tuple[str, list[tuple[str, str]], int]:
    """Return how photographs are paired, which are, and how many are not."""
    keys = (*left, *right)
    cameras = ['left'] * len(left) + ['right'] * len(right)
    times = np.array(t) if len(t) else np.full(len(keys), np.nan)
    found = pair_photographs(keys, cameras, times, sync)
    pairs = [
        (keys[i], keys[j])
        for i in range(len(left))
        for j in range(len(left), len(keys))
        if found.keys[i] == found.keys[j]
    ]
    return found.way, pairs, len(found.alone)


def test_by_name_or_else_by_number() -> None:
    assert paired(['a', 'b', 'c'], ['b', 'c', 'd']) == ('name', [('b', 'b'), ('c', 'c')], 2)
    assert paired(['left01', 'left2'], ['right001', 'right003']) == (
        'number',
        [('left01', 'right001')],
        2,
    )
    assert paired(['a', 'b'], ['c', 'd']) == ('name', [], 4)
    # Of two paths
    assert paired(['0/left01', '1/left01'], ['0/right1', '1/right2']) == (
        'number',
        [('0/left01', '0/right1')],
        2,
    )
    assert paired(['0/a', '1/a'], ['0/c', '1/d']) == ('name', [], 4)
    assert paired(['x1_1', 'x2_1'], ['y1_1', 'y2_2']) == ('name', [], 4)  # 1 counts nothing


def test_by_the_nearest_stamp() -> None:
    left, right = ['a', 'b', 'c'], ['d', 'e', 'f']
    assert paired(left, right, [0.0, 0.1, 0.2, 0.004, 0.098, 0.25]) == (
        'stamp',
        [('a', 'd'), ('b', 'e')],
        2,
    )
    assert paired(left, right, [0.0, 0.1, 0.2, 0.004, 0.098, 0.25], 0.003) == (
        'stamp',
        [('b', 'e')],
        4,
    )
    # Closer together than the cameras are: their order stays, and nobody is left over.
    assert paired(left, right, [0.0, 1e-9, 2e-9, 1.23e-6, 1.231e-6, 1.232e-6])[1] == [
        ('a', 'd'),
        ('b', 'e'),
        ('c', 'f'),
    ]
    rng = np.random.default_rng(0)
    own = np.arange(200) / 30
    kept = rng.random(200) > 0.2
    keys = [str(i) for i in range(200)]
    other = [f'r{i}' for i in np.flatnonzero(kept)]
    t = np.concatenate([own, own[kept] + 2e-3 * rng.standard_normal(kept.sum()).clip(-2, 2)])
    _, pairs, alone = paired(keys, other, t)
    assert alone == 200 - kept.sum()
    assert all(one == f'r{two}' or f'r{one}' == two for one, two in pairs)


def test_photographs_of_no_camera_beside_a_rig_are_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ('rig/left', 'rig/right', 'alone'):
        write(tmp_path / name, [photograph(poses(2).take(0))])
    paths = [str(tmp_path / name) for name in ('rig', 'alone')]
    assert cli.main(['detect', *paths, '--board', BOARD]) == 0
    told = capsys.readouterr()
    assert 'of no camera, others are of left, right; put it into a folder' in told.err
    assert 'found in 2 of 3 photographs' in told.out


def test_a_rig_whose_photographs_are_named_by_stamps(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    images = [photograph(poses(4).take(i)) for i in range(3)]
    for camera, off in (('left', 0), ('right', 1234)):
        write(tmp_path / camera, images)
        for i, path in enumerate(sorted((tmp_path / camera).iterdir())):
            path.rename(path.with_name(f'{BASE + 50_000_000 * i + off}.png'))
    (tmp_path / 'right' / f'{BASE + 1234}.png').unlink()
    out = tmp_path / 'observations.csv'
    assert cli.main(['detect', str(tmp_path), '--board', BOARD, '-o', str(out)]) == 0
    told = capsys.readouterr()
    assert (
        'cameras left, right: 2 simultaneous pairs, matched by stamp, 0.00123 ms apart' in told.out
    )
    assert '1 of 5 photographs have no simultaneous partner, by stamp: ' in told.err
    table = read_observations(out)
    right = table.take(table.camera == table.cameras.index('right'))
    assert right.frames.tolist() == [1, 2]
    assert table.t.min() == pytest.approx(BASE / 1e9, abs=1e-6)
    assert cli.main(['detect', str(tmp_path), '--board', BOARD, '--sync', '1us']) == 0
    assert 'no photographs of two cameras are simultaneous' in capsys.readouterr().err
    with pytest.raises(SystemExit):
        cli.main(['detect', str(tmp_path), '--board', BOARD, '--sync', '5'])
    assert "'5' is not a time with a unit, such as 5ms" in capsys.readouterr().err
