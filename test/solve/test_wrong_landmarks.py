"""Landmarks that are not where the table says are named, and good ones are not."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from helpers.data import DATA, NO_DATA
from helpers.robot import LENS
from helpers.targets import cube, plane, poses_around

from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.io.readers import read_observations
from fisheye_svp_ros.scene.observations import Landmarks
from fisheye_svp_ros.simulate.simulation import simulate
from fisheye_svp_ros.solve.lens_calibration import calibrate, rough_lenses
from fisheye_svp_ros.solve.robust_calibration import calibrate_without_outliers
from fisheye_svp_ros.solve.table_poses import solve_table
from fisheye_svp_ros.solve.wrong_landmarks import find_wrong_landmarks

SIZE = (LENS.width, LENS.height)
fit = partial(calibrate, model='kannala_brandt', image_size=SIZE)


def observed(seed, target=plane, frames=15, bend=0.0):
    """Return image points of a target whose edges are bent up by so much, m, beside its middle."""
    rng, stated = np.random.default_rng(seed), target()
    arm = stated.points - stated.points.mean(axis=0)
    rise = bend * (arm[:, :2] ** 2).sum(axis=1) / (arm[:, :2] ** 2).sum(axis=1).max()
    true = Landmarks(stated.ids, stated.points + rise[:, None] * [0.0, 0.0, 1.0])
    poses = poses_around(stated, frames, rng, widest=1.2)
    table = simulate(ForwardModel(LENS), true, poses, 0.1, rng)
    table = table.take(np.bincount(table.frame)[table.frame] >= 12)
    return replace(table, xyz=stated.lookup(table.landmark)[0], sigma=np.full(len(table), np.nan))


def displaced(table, moves):
    """Return a table that states other places of some landmarks: moves (3,), m, by number."""
    xyz = table.xyz.copy()
    for number, move in moves.items():
        xyz[table.landmark == number] += move
    return replace(table, xyz=xyz)


def moved_at_random(numbers, low, high, seed):
    rng = np.random.default_rng(seed)
    ways = rng.normal(size=(len(numbers), 3))
    ways *= (rng.uniform(low, high, len(numbers)) / np.linalg.norm(ways, axis=1))[:, None]
    return dict(zip(numbers, ways, strict=True))


MIRRORED = {number: np.array([-0.06 * (number % 9), 0.0, 0.0]) for number in (10, 30, 44)}
MOVES = {
    'one by 25 mm': {0: np.array([0.025, 0.0, 0.0])},
    'one by 100 mm': {31: np.array([0.0, 0.06, 0.08])},
    'three by 5 mm': moved_at_random((1, 34, 42), 0.005, 0.006, 1),
    'three by sign': MIRRORED,
    'a third by 5 to 100 mm': moved_at_random(range(1, 61, 3), 0.005, 0.1, 2),
    'a third by 5 mm': moved_at_random(range(0, 60, 3), 0.005, 0.006, 3),
}


@pytest.mark.parametrize('moves', MOVES.values(), ids=MOVES)
def test_displaced_landmarks_are_named_and_bend_no_lens(moves):
    clean = observed(len(moves))
    table = displaced(clean, moves)
    starts = rough_lenses('kannala_brandt', SIZE)
    found, kept, outliers = calibrate_without_outliers(table, fit, starts)
    assert sorted(landmark.number for landmark in outliers.landmarks) == sorted(moves)
    for landmark in outliers.landmarks:
        np.testing.assert_allclose(landmark.offset, -moves[landmark.number], atol=1.5e-3)
    assert not np.isin(kept.landmark, list(moves)).any()
    assert not len(outliers.without_landmarks().rows)
    best = fit(clean).adjusted.lens
    assert found.adjusted.lens.fx == pytest.approx(best.fx, rel=2e-3)


def test_a_landmark_of_another_point_is_named_without_a_place():
    table = observed(7)
    uv = table.uv.copy()
    mine = np.flatnonzero(table.landmark == 20)
    uv[mine] += 90.0 * np.where(np.arange(len(mine)) % 2, 1, -1)[:, None] * [1.0, 0.3]
    _, _, outliers = calibrate_without_outliers(replace(table, uv=uv), fit)
    (landmark,) = outliers.landmarks
    assert landmark.number == 20 and not landmark.is_displaced and landmark.points == len(mine)
    assert landmark.px == pytest.approx(94, abs=3)


@pytest.mark.parametrize('target', [plane, cube])
def test_known_lens_names_them_too(target):
    moves = moved_at_random(range(2, 50, 5), 0.01, 0.08, 4)
    table = displaced(observed(4, target), moves)
    found = solve_table(table, ForwardModel(LENS))
    assert sorted(landmark.number for landmark in found.landmarks) == sorted(moves)
    wrong = np.isin(found.views.landmark, list(moves)) & found.views.used
    np.testing.assert_array_equal(found.outliers, wrong)
    assert found.sigma == pytest.approx(0.1, rel=0.1)


@pytest.mark.parametrize('bend', [0.0, 5e-4, 5e-3])
@pytest.mark.parametrize('target', [plane, cube])
def test_clean_and_bent_targets_lose_no_landmark(target, bend):
    table = observed(5, target, bend=bend)
    outliers = calibrate_without_outliers(table, fit)[2]
    assert not outliers.landmarks
    assert not solve_table(table, ForwardModel(LENS)).landmarks


def test_a_wrong_lens_is_no_wrong_landmark():
    table = observed(6)
    for lens in (
        replace(LENS, fx=1.1 * LENS.fx, fy=1.1 * LENS.fy),
        replace(LENS, cx=LENS.cx + 30),
        replace(LENS, fy=1.05 * LENS.fy),
    ):
        assert not solve_table(table, ForwardModel(lens)).landmarks


@pytest.mark.parametrize('name', ['ov_plane/train', 'ov_cube/train'])
def test_real_boards_lose_no_landmark_even_where_it_is_asked_for(name, monkeypatch):
    path = DATA / f'{name}.csv'
    if not path.exists():
        pytest.skip(NO_DATA)
    monkeypatch.setattr(
        'fisheye_svp_ros.solve.wrong_landmarks._LandmarkTable.is_suspicious', lambda *_: True
    )
    table = read_observations(path)

    def fit_model(rows):
        return ForwardModel(calibrate(rows, 'kannala_brandt', (1280, 800)).adjusted.lens)

    assert find_wrong_landmarks(table, fit_model(table), fit_model) == ()
