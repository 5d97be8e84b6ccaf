"""Simulated observations: what is there, what is absent, and how it scatters."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from benchmark.studies.boards import surround_rig
from fisheye_svp_ros.effects.base import ModelTerm
from fisheye_svp_ros.effects.detection_effects import (
    NoiseVsAngleEffect,
    QuantisationEffect,
    WrongIdsEffect,
)
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import LensError, ParameterError
from fisheye_svp_ros.io.landmark_files import environment
from fisheye_svp_ros.io.lens_files import load_lens, save_lens
from fisheye_svp_ros.io.parameters import Sweep
from fisheye_svp_ros.io.rig_files import save_rig
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.optics.camera import back_project, project
from fisheye_svp_ros.pose import identity
from fisheye_svp_ros.scene.observations import Landmarks, group_views
from fisheye_svp_ros.scene.rigs import calibration_poses, paper_pose, rig
from fisheye_svp_ros.simulate import scenario
from fisheye_svp_ros.simulate.scenario import (
    Scenario,
    check_sweep,
    scalars,
    simulate_in_pieces,
    simulate_scenario,
)
from fisheye_svp_ros.simulate.simulation import simulate, simulate_stereo

FISH180, FISH214 = (load_lens(lens_path(name)) for name in ('fish180', 'fish214'))


def rng():
    return np.random.default_rng(51)


def test_one_row_an_image_point():
    landmarks = environment('outer', 0.5)
    times, boards = np.arange(10) * 0.1, np.arange(18) // 8
    table = simulate(
        ForwardModel(FISH214), landmarks, calibration_poses(), 0.0, rng(), t=times, board=boards
    )
    assert len(table) == 180
    assert table.frames.tolist() == list(range(10))
    np.testing.assert_array_equal(table.landmark, np.tile(landmarks.ids, 10))
    np.testing.assert_array_equal(table.board, np.tile(boards, 10))
    np.testing.assert_array_equal(table.t, np.repeat(times, 18))
    np.testing.assert_array_equal(table.xyz, np.tile(landmarks.points, (10, 1)))
    assert np.isnan(table.sigma).all()
    assert table.cameras == ('',)
    views = group_views(table)
    expected = project(FISH214, calibration_poses().into_body(views.points)).uv
    np.testing.assert_array_equal(views.uv, expected)


def test_what_has_no_image_is_absent():
    points = np.array([[0, 0, 1.0], [0, 0.1, -1.0], [0.1, 0, 0.1], [np.sin(1.8), 0, -np.cos(1.8)]])
    landmarks = Landmarks(np.array([3, 1, 4, 5]), points)
    table = simulate(ForwardModel(FISH214), landmarks, paper_pose(1), 0.0, rng())
    assert table.landmark.tolist() == [1, 5]
    narrow = replace(FISH214, width=800, height=1536)
    table = simulate(ForwardModel(narrow), landmarks, paper_pose(1), 0.0, rng())
    assert table.landmark.tolist() == [1]
    empty = simulate(
        ForwardModel(FISH214), Landmarks(np.array([3]), points[:1]), paper_pose(2), 0.0, rng()
    )
    assert len(empty) == 0


def test_the_image_ends_half_a_pixel_beyond_the_outer_centers():
    lens = replace(FISH214, viewpoint_shift=None, width=400, height=300, cx=200.0, cy=150.0)
    edges = np.array(
        [
            [-0.45, 10.0],
            [399.45, 10.0],
            [10.0, -0.45],
            [10.0, 299.45],
            [-0.55, 10.0],
            [399.55, 10.0],
            [10.0, -0.55],
            [10.0, 299.55],
        ]
    )
    points = back_project(lens, edges).direction
    table = simulate(ForwardModel(lens), Landmarks(np.arange(8), points), identity(1), 0.0, rng())
    assert table.landmark.tolist() == [0, 1, 2, 3]


def test_noise_is_gaussian_and_follows_the_seed():
    landmarks = environment('inner', 2.0)
    clean = simulate(ForwardModel(FISH180), landmarks, paper_pose(400), 0.0, rng())
    noisy = simulate(ForwardModel(FISH180), landmarks, paper_pose(400), 0.3, rng())
    again = simulate(ForwardModel(FISH180), landmarks, paper_pose(400), 0.3, rng())
    np.testing.assert_array_equal(noisy.uv, again.uv)
    scatter = (noisy.uv - clean.uv) / 0.3
    assert scatter.mean() == pytest.approx(0.0, abs=0.03)
    assert scatter.std() == pytest.approx(1.0, abs=0.02)
    assert (scatter**4).mean() == pytest.approx(3.0, abs=0.2)
    assert np.corrcoef(scatter.T)[0, 1] == pytest.approx(0.0, abs=0.04)
    np.testing.assert_array_equal(noisy.sigma, 0.3)


@pytest.mark.parametrize('sigma', [-0.1, float('nan'), float('inf')])
def test_impossible_noise(sigma):
    with pytest.raises(ParameterError, match=r'noise is .* px; 0 or more is needed'):
        simulate(ForwardModel(FISH180), environment('inner', 2.0), paper_pose(1), sigma, rng())


def test_stereo_is_one_table_of_two_cameras():
    landmarks, right = environment('whole', 2.0), calibration_poses()
    left_in_right = rig('vergent')
    table = simulate_stereo(
        ForwardModel(FISH180),
        ForwardModel(FISH214),
        landmarks,
        left_in_right,
        right,
        0.0,
        rng(),
        t=np.arange(10.0),
    )
    assert table.cameras == ('left', 'right')
    views = group_views(table)
    assert views.frame.tolist() == [frame for frame in range(10) for _ in range(2)]
    assert views.camera.tolist() == [0, 1] * 10
    for camera, lens, pose in ((0, FISH180, right.compose(left_in_right)), (1, FISH214, right)):
        mine = views.take(views.camera == camera)
        expected = project(lens, pose.into_body(mine.points)).uv
        np.testing.assert_array_equal(mine.uv[mine.used], expected[mine.used])
        np.testing.assert_array_equal(np.unique(mine.t[mine.used]), np.arange(10.0))


def noisy(effect, values, sigma=0.2, frames=300):
    """Return clean and noisy image points (frames, N, 2) with one effect of the noise."""
    landmarks = environment('inner', 2.0)
    terms = (ModelTerm(effect, np.array(values)),)
    tables = (
        simulate(ForwardModel(FISH180, some), landmarks, paper_pose(frames), noise, rng())
        for some, noise in (((), 0.0), (terms, sigma))
    )
    return tuple(table.uv.reshape(frames, -1, 2) for table in tables)


def test_noise_that_grows_with_the_angle():
    clean, seen = noisy(NoiseVsAngleEffect(), [0.8], sigma=0.1)
    points = paper_pose(1).into_body(environment('inner', 2.0).points)[0]
    theta = np.arctan2(np.linalg.norm(points[:, :2], axis=1), points[:, 2])
    scatter = (seen - clean).std(axis=(0, 2))
    np.testing.assert_allclose(scatter, 0.1 * np.exp(0.8 * theta**2), rtol=0.15)


def test_rounded_image_points():
    clean, seen = noisy(QuantisationEffect(), [0.25])
    np.testing.assert_array_equal(seen / 0.25, np.round(seen / 0.25))
    assert (seen - clean).std() == pytest.approx(np.hypot(0.2, 0.25 / np.sqrt(12)), rel=0.03)


def test_image_points_swapped_with_others_of_their_view():
    clean, seen = noisy(WrongIdsEffect(), [0.1], sigma=0.0)
    wrong = np.any(seen != clean, axis=-1)
    assert wrong.mean() == pytest.approx(0.1, abs=0.02)
    assert (wrong.sum(axis=1) % 2 == 0).all()
    for before, after in zip(clean, seen, strict=True):
        assert sorted(map(tuple, before)) == sorted(map(tuple, after))


def test_the_image_ends_half_a_pixel_beyond_the_outer_pixel_centers():
    """Pixel centers are at whole numbers: the image runs from -0.5 to width - 0.5."""
    lens = replace(FISH214.svp(), max_incidence=np.pi / 2)
    edges = np.array([-0.51, -0.49, lens.width - 0.51, lens.width - 0.49])
    uv = np.stack([edges, np.full(4, lens.cy)], axis=-1)
    wide = replace(lens, cx=lens.width / 2, fx=lens.width / 3)
    points = 2.0 * back_project(wide, uv).direction
    seen = simulate(ForwardModel(wide), Landmarks(np.arange(4), points), identity(1), 0.0, rng())
    assert seen.landmark.tolist() == [1, 2]
    tall = replace(lens, cy=lens.height / 2, fy=lens.height / 3)
    edges = np.array([-0.51, -0.49, lens.height - 0.51, lens.height - 0.49])
    points = 2.0 * back_project(tall, np.stack([np.full(4, lens.cx), edges], axis=-1)).direction
    seen = simulate(ForwardModel(tall), Landmarks(np.arange(4), points), identity(1), 0.0, rng())
    assert seen.landmark.tolist() == [1, 2]


@pytest.mark.parametrize('steps', [0, 1, 7])
def test_pieces_are_the_whole(monkeypatch: pytest.MonkeyPatch, steps: int) -> None:
    poses = (
        0.0,
        0.0,
        0.0,
        1.0,
        0.0,
        0.0,
        0.0,
        0.1,
        0.0,
        0.0,
        0.0,
        1.0,
        0.0,
        0.0,
        0.1,
        0.2,
        0.0,
        1.0,
        0.0,
        0.0,
        0.0,
    )
    one = Scenario(poses=poses, trajectory_steps=steps, noise_px=0.3)
    whole = simulate_scenario(one)
    monkeypatch.setattr(scenario, '_SETS_PER_BLOCK', 4)
    pieces = list(simulate_in_pieces(one))
    sets = 2 * max(steps, 1) + 1
    assert [first for first, _, _ in pieces] == list(range(0, sets, 4))
    assert {total for _, total, _ in pieces} == {sets}
    for name in ('uv', 'landmark'):
        parts = [getattr(piece.observations, name) for _, _, piece in pieces]
        assert np.array_equal(np.concatenate(parts), getattr(whole.observations, name))
    places = np.concatenate([piece.poses[0].position for _, _, piece in pieces])
    assert np.array_equal(places, whole.poses[0].position)


def test_a_million_steps_take_little_memory() -> None:
    poses = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0)
    one = Scenario(poses=poses, trajectory_steps=1_000_000)
    tracemalloc.start()
    check_sweep(one, Sweep({}))
    first, sets, piece = next(simulate_in_pieces(one))
    assert (first, sets) == (0, 1_000_001) and len(piece.poses[0].position) < 10_000
    assert tracemalloc.get_traced_memory()[1] < 200e6
    tracemalloc.stop()


def four_cameras(folder):
    """Write the lenses and the rig of four cameras; return their places in the first one."""
    rig = surround_rig(4, 0.1)
    for number in range(4):
        save_lens(
            replace(FISH180, name=f'cam{number}', cx=FISH180.cx + number),
            folder / f'cam{number}.yaml',
        )
    steps = [rig.take(i + 1).inverse().compose(rig.take(i)) for i in range(3)]
    save_rig(steps, folder / 'rig.yaml', tuple(f'cam{i}' for i in range(4)))
    return rig


def test_cameras_of_a_file_see_what_they_would_alone(tmp_path):
    rig = four_cameras(tmp_path)
    seen = simulate_scenario(
        Scenario(rig_file=str(tmp_path), radius=0.5, poses=(0.01, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
    )
    table = seen.observations
    assert table.cameras == ('cam0', 'cam1', 'cam2', 'cam3') and seen.rig is None
    for number, pose in enumerate(seen.poses):
        expected = seen.poses[0].compose(rig.take([number]))
        np.testing.assert_allclose(pose.difference(expected), 0, atol=1e-12)
        rows = table.camera == number
        image = project(seen.lenses[number], pose.into_body(table.xyz[rows][None])[0])
        assert seen.lenses[number].cx == FISH180.cx + number
        assert rows.any() == (number != 2)  # which looks away from all landmarks
        np.testing.assert_allclose(table.uv[rows], image.uv, atol=1e-9)
    assert 'lens' not in scalars(Scenario(rig_file=str(tmp_path)))


def test_a_rig_without_a_lens_is_refused(tmp_path):
    four_cameras(tmp_path)
    (tmp_path / 'cam2.yaml').unlink()
    with pytest.raises(LensError, match='the rig has the camera cam2, which has no lens'):
        simulate_scenario(Scenario(rig_file=str(tmp_path)))
