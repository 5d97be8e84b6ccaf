"""Photographs of one moment of a rig: by name, by number, by stamp."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from helpers.photographs import BOARD, photograph, poses, write

from fisheye_svp_ros import cli
from fisheye_svp_ros.detect.rig_photographs import pair_photographs, stamp_of
from fisheye_svp_ros.io.readers import read_observations

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
