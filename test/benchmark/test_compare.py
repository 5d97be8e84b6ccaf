"""The comparison with other calibrations: grids, corners, scores, fits, halves of frames."""

from __future__ import annotations

from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
from helpers.targets import plane, poses_around

import fisheye_svp_ros as fsvp
from benchmark.peers.calibrations import PEERS, NotHereError, opencv_fisheye, vnlog, warped_places
from benchmark.peers.compare import Row, halves_table
from benchmark.peers.halves import (
    Difference,
    all_pairs,
    fixed_halves,
    half_sets,
    honesty_table,
    whole,
)
from benchmark.peers.python_calibrations import PYTHON_PEERS
from benchmark.peers.sets import BOARDS, Set, grid_of, one_board_a_frame, residuals, rms
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.optics.curves import KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import rotation_from_vector
from fisheye_svp_ros.scene.observations import Landmarks
from fisheye_svp_ros.simulate.simulation import simulate

LENS = Lens(
    'camera',
    800,
    700,
    220.0,
    220.0,
    400.0,
    350.0,
    KannalaBrandt(-0.02, 0.004, -0.003),
    np.radians(85),
)


@pytest.fixture(scope='module')
def data():
    """Two boards of 9 x 7 on a rigid target, one of them oblique, in 14 frames, without noise."""
    first = plane().points
    turn = rotation_from_vector(np.array([0.3, 0.8, -0.4]))
    points = np.concatenate([first, first @ turn.T + [0.3, 0.02, 0.05]])
    target = Landmarks(np.arange(len(points)), points)
    rng = np.random.default_rng(3)
    poses = poses_around(target, 14, rng, widest=0.5, distance=(0.5, 0.8))
    table = simulate(ForwardModel(LENS), target, poses, 0.0, rng, board=target.ids // len(first))
    table = replace(table, xyz=np.round(table.xyz, 7))
    train = table.frame < 10
    return Set('boards', table.take(train), one_board_a_frame(table.take(~train)), (800, 700))


def test_boards_become_grids(data):
    grid = grid_of(data)
    assert grid.spacing == pytest.approx(0.03, rel=1e-5)
    assert grid.width == 9
    for board in (0, 63):
        places = np.array([grid.places[board + one] for one in range(63)])
        assert sorted(map(tuple, places)) in (
            sorted((i, j) for i in range(9) for j in range(7)),
            sorted((i, j) for i in range(7) for j in range(9)),
        )


def test_landmarks_on_no_grid_are_refused(data):
    bent = replace(data.train, xyz=data.train.xyz * (1 + 3 * data.train.xyz[:, :1]))
    with pytest.raises(ObservationError, match='no regular grid'):
        grid_of(replace(data, train=bent))


def test_corners_for_mrcal_are_whole_grids(data):
    lines = vnlog(data.train, grid_of(data)).splitlines()
    views = len(np.unique(BOARDS * data.train.frame + data.train.board))
    assert len(lines) == 1 + 81 * views
    assert sum(not line.endswith('-') for line in lines[1:]) == len(data.train)


def test_awarped_places_board_lies_on_the_nominal_one(data):
    grid = grid_of(data)
    across, along = np.meshgrid(np.arange(9), np.arange(9))
    flat = grid.spacing * np.stack([across, along, 0 * across], axis=-1)
    assert np.abs(warped_places(data.test, grid, flat) - data.test.xyz).max() < 1e-6
    bow = 1e-3 * (across / 8) ** 2
    bent = warped_places(data.test, grid, flat + np.stack([0 * bow, 0 * bow, bow], axis=-1))
    assert 8e-4 < np.abs(bent - data.test.xyz).max() < 1.1e-3


def test_opencv_finds_the_lens_and_poses_are_fitted(data):
    start = fsvp.localize(data.test, LENS)
    start = replace(start, pose=start.pose.retract(np.full(6, 0.01)))
    fitted = opencv_fisheye(data, grid_of(data), 200.0)[0]
    apart = residuals(
        fitted.project, data.test.frame, fitted.places(data.test), data.test.uv, start.pose
    )
    assert rms(apart) < 1e-3
    off = data.test.uv + np.where(np.arange(len(data.test)) % 2, 0.5, -0.5)[:, None]
    apart = residuals(fitted.project, data.test.frame, data.test.xyz, off, start.pose)
    assert rms(apart) == pytest.approx(0.5 * np.sqrt(2), rel=0.1)


@pytest.mark.skipif(find_spec('mrcal') is not None, reason='mrcal is there')
def test_a_missing_tool_says_so(data):
    with pytest.raises(NotHereError, match='not installed'):
        PEERS['mrcal, CAHVORE'](data, grid_of(data), 220.0)


@pytest.mark.parametrize(
    ('tool', 'module', 'largest'),
    [
        ('lensboy, rational', 'lensboy', 0.3),  # another model
        ('calibsense, fisheye', 'calibsense', 1e-3),
        ('ds-msp, Kannala-Brandt', 'ds_msp', 1e-3),
    ],
)
def test_tools_of_the_index_find_the_lens(data, tool, module, largest):
    if find_spec(module) is None:
        with pytest.raises(NotHereError, match='not installed'):
            PYTHON_PEERS[tool](data, grid_of(data), 200.0)
        pytest.skip(f'{module} is not installed')
    fitted = PYTHON_PEERS[tool](data, grid_of(data), 200.0)[0]
    start = fsvp.localize(data.test, LENS)
    apart = residuals(
        fitted.project, data.test.frame, fitted.places(data.test), data.test.uv, start.pose
    )
    assert rms(apart) < largest
    for error in fitted.errors.values():
        off = fitted.intrinsics - [LENS.fx, LENS.fy, LENS.cx, LENS.cy]
        assert (np.abs(off) < 1e-2).all()
        assert (error < 1e-2).all()


def test_halves_are_disjoint_and_whole(data):
    table = whole(data)
    assert len(table) == len(data.train) + len(data.test)
    assert table.frames.tolist() == [*range(14)]
    for one, other in fixed_halves(table.frames).values():
        assert sorted([*one, *other]) == [*range(14)]
    for one in half_sets(data):
        assert len(one.train) + len(one.test) == len(table)
        assert not set(one.train.frames) & set(one.test.frame // BOARDS)
    for pair in all_pairs(data):
        assert [len(one.train.frames) for one in pair] == [7, 7]


def test_differences_are_counted_beside_their_errors():
    ones = np.ones(4)
    found = {
        'a': [Difference('tool', np.array([0.5, -1.5, 3.0, 0.0]), ones)],
        'b': [
            Difference('tool', 0 * ones, np.array([1.0, 1.0, 1.0, np.nan])),
            Difference('other', 2 * ones, ones),
        ],
    }
    lines = honesty_table(found)
    assert lines[2] == '| tool | 7 | 86 % | 75 % | 100 % | 1.28 | 1.00 / 1.00 |'
    assert lines[3] == '| other | 4 | 0 % | - | 0 % | 2.00 | - / 1.00 |'


def test_halves_are_pooled():
    rows = [[Row('tool', 1.0, 1.0, 30, 1.0)], [Row('tool', 3.0, 3.0, 10, 1.0)]]
    lost = [[Row('tool', np.nan, np.nan, 0, 1.0)], rows[1]]
    assert halves_table({'a': rows, 'b': lost})[2] == '| tool | 1.732 | 3.000 (1 of 2) |'
