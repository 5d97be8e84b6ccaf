"""What a lens file says of its own errors: against samples, and the same for whoever asks."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.uncertain import (
    BOARD,
    BUMPS,
    COARSE,
    HIGH,
    LINEAR,
    LOW,
    NAMES,
    NOISE,
    OFFSET,
    uncertain,
)

import fisheye_svp_ros as fsvp
from fisheye_svp_ros.diagnosis import DiagnosisOptions, LensErrors, diagnose
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.lens_files import load_lens, save_lens
from fisheye_svp_ros.optics.curves import Gennery
from fisheye_svp_ros.pose import Pose, identity, rotation_from_vector
from fisheye_svp_ros.scene.observations import make_observations, views_of
from fisheye_svp_ros.solve.localization import localize
from fisheye_svp_ros.solve.stereo_depth import triangulate_optimally
from fisheye_svp_ros.study.budget import Setup, make_budget
from fisheye_svp_ros.study.trust import depth_errors, localize_with_errors

SAMPLES = 300


def drawn(lens, rng):
    """Return the lens as it may really be."""
    half = np.linalg.cholesky(np.array(lens.uncertainty['covariance']))
    off = half @ rng.normal(size=len(NAMES))
    moved = [lens.parameters[n] + d for n, d in zip(NAMES, off, strict=True)]
    return lens.with_parameters(NAMES, moved)


def smooth(uv, size, pitch, rng):
    """Draw fields (..., 2) of Gaussian bumps on a hexagonal grid, by their covariance."""
    width = 0.65 * pitch
    squares = ((uv[:, None] - uv) ** 2).sum(axis=-1)
    variance = size**2 * 2 / np.sqrt(3) / pitch**2 * np.pi * width**2
    covariance = variance * np.exp(-squares / (4 * width**2))
    half = np.linalg.cholesky(covariance + 1e-9 * np.eye(len(uv)))
    return half @ rng.normal(size=(len(uv), 2))


def misfit(uv, rng):
    pitch = (HIGH - LOW).max()
    x = (uv - (LOW + HIGH) / 2) / (pitch / 2)
    return (
        smooth(uv, COARSE, pitch / 6, rng)
        + smooth(uv, BUMPS, pitch / 4, rng)
        + LINEAR * x @ rng.normal(size=(2, 2))
    )


def seen_by(lens, pose, points, rng):
    """Return image points (N, 2) as the lens, its misfit and noise make them."""
    uv = ForwardModel(drawn(lens, rng)).project(pose.into_body(points)).uv
    return uv + misfit(uv, rng) + NOISE * rng.normal(size=uv.shape)


@pytest.mark.parametrize('board', [True, False])
def test_poses_scatter_as_the_lens_file_says(board):
    """A board that errs itself, and landmarks in all directions that do not."""
    lens, rng = uncertain(), np.random.default_rng(1)
    pose = Pose(rotation_from_vector(np.array([0.3, -0.4, 0.2])), np.array([0.2, 0.0, -0.25]))
    points = (
        BOARD if board else pose.transform(rng.uniform([-1, -0.7, 0.3], [1, 0.7, 1.0], (25, 3)))
    )
    uv = []
    for _ in range(SAMPLES):
        true = points + (1e-3 * OFFSET * rng.normal(size=points.shape) if board else 0.0)
        uv.append(seen_by(lens, pose, true, rng))
    errors = LensErrors.from_lens(lens)
    weight = np.full((SAMPLES, len(points)), 1 / errors.inflate_sigma(NOISE))
    views = views_of(points, np.array(uv), weight)
    start = Pose(*(np.repeat(part[None], SAMPLES, axis=0) for part in pose))
    solved = localize(ForwardModel(lens), views, start)
    parts = errors.of_solved_poses(views.take([0]), solved.take([0]), None)
    off = solved.pose.difference(start)
    pull = np.einsum('si,ij,sj->s', off, np.linalg.inv(parts.total[0]), off) / 6
    assert np.mean(pull) == pytest.approx(1, abs=0.15)
    for part in (parts.noise, parts.parameters, parts.misfit):
        assert (np.diagonal(part[0]) < 0.95 * np.diagonal(parts.total[0])).all()


def test_stereo_points_scatter_as_the_lens_files_say():
    lens, rng = uncertain(), np.random.default_rng(2)
    rig = Pose(rotation_from_vector(np.array([0.0, 0.1, 0.0])), np.array([-0.15, 0.0, 0.0]))
    points = np.array([[0.1, 0.05, 0.6], [-0.5, 0.2, 0.5], [0.3, -0.3, 0.9]])
    pairs = np.array(
        [[seen_by(lens, pose, points, rng) for pose in (rig, identity())] for _ in range(SAMPLES)]
    )
    found = triangulate_optimally(
        ForwardModel(lens), ForwardModel(lens), rig, pairs[:, 0], pairs[:, 1], NOISE
    )
    parts = depth_errors(LensErrors.from_lens(lens), LensErrors.from_lens(lens), rig, points)
    off = found.points - points
    pull = np.einsum('sni,nij,snj->sn', off, np.linalg.inv(parts.total), off) / 3
    # A mean of so many chi-squares of three degrees of freedom: three of its standard errors.
    assert pull.mean(axis=0) == pytest.approx(np.ones(3), abs=3 * np.sqrt(2 / 3 / SAMPLES))
    nowhere = np.array([[np.nan] * 3, [0.0, 0.0, -5.0], points[0]])
    holes = depth_errors(LensErrors.from_lens(lens), LensErrors.from_lens(lens), rig, nowhere)
    assert np.isnan(holes.total[:2]).all()
    np.testing.assert_allclose(holes.total[2], parts.total[0], rtol=0.01)


def test_a_diagnosis_and_its_lens_file_say_the_same(tmp_path):
    lens = replace(uncertain(), uncertainty=None, viewpoint_shift=None)
    table = board_table(lens, np.random.default_rng(3), 8)
    found = diagnose(table, lens, free_intrinsics=True, options=DiagnosisOptions(quick=True))
    save_lens(found.lens, tmp_path / 'lens.yaml')
    errors = LensErrors.from_lens(load_lens(tmp_path / 'lens.yaml'))
    fit = found.evaluation.written_model
    views, pose = fit.data.views, fit.state.pose
    said, carried = found.evaluation.model_errors.of_poses(fit), errors.of_poses(views, pose)
    np.testing.assert_allclose(carried.parameters, said.parameters, rtol=1e-6, atol=1e-15)
    # The file rounds; next to zero a covariance is as exact as the variances that it belongs to.
    sd = np.sqrt(np.diagonal(said.misfit, axis1=1, axis2=2))
    off = (carried.misfit - said.misfit) / (sd[:, :, None] * sd[:, None])
    assert np.abs(off).max() < 2e-4
    assert errors.noise == pytest.approx(found.noise_px) and said.misfit.any()
    assert {'fx', 'k4', 'target_shape.board0.z20'} < set(errors.model.names)


def board_table(lens, rng, frames):
    """Return photographs of a bent board through a lens with a shift."""
    bent = BOARD + np.stack([0 * BOARD[:, 0]] * 2 + [0.06 * (BOARD[:, 0] - 0.12) ** 2], -1)
    bent = bent + 3e-4 * rng.normal(size=BOARD.shape)
    seeing, tables = ForwardModel(replace(lens, viewpoint_shift=Gennery(e0=0.003))), []
    for _ in range(frames):
        turn = rotation_from_vector(0.5 * rng.normal(size=3))
        pose = Pose(
            turn,
            np.array([0.12, 0.08, 0.0]) - turn @ rng.uniform([-0.1, -0.1, 0.2], [0.1, 0.1, 0.4]),
        )
        uv = seeing.project(pose.into_body(bent)).uv
        tables.append(uv + 0.05 * rng.normal(size=uv.shape))
    return make_observations(
        np.repeat(np.arange(frames), len(BOARD)),
        np.tile(np.arange(len(BOARD)), frames),
        np.concatenate(tables),
        np.tile(BOARD, (frames, 1)),
    )


def room_poses(lens, noise, rng, frames=150):
    """Return landmarks of a room as a lens sees them with noise of its own, px, and true poses."""
    points = rng.uniform(-2.0, 2.0, (40, 3)) * (1, 1, 0.4) + (0, 0, 3.0)
    poses = Pose(
        np.stack([rotation_from_vector(0.2 * turn) for turn in rng.normal(size=(frames, 3))]),
        rng.uniform(-0.3, 0.3, (frames, 3)),
    )
    uv = np.stack(
        [ForwardModel(lens).project(poses.take(i).into_body(points)).uv for i in range(frames)]
    )
    uv = (uv + noise * rng.normal(size=uv.shape)).reshape(-1, 2)
    frame, landmark = np.divmod(np.arange(len(uv)), len(points))
    return make_observations(frame, landmark, uv, points[landmark]), poses


@pytest.mark.parametrize('calibrated', [False, True])
def test_poses_among_landmarks_that_are_less_sharp_than_a_board_say_so(calibrated):
    rng = np.random.default_rng(8)
    lens = uncertain()
    if calibrated:  # as `calibrate` writes a lens
        block = {
            'rms_px': NOISE,
            'stderr': {'fx': 1e-6, 'fy': 1e-6},
            'covariance': (1e-12 * np.eye(2)).tolist(),
        }
        lens = replace(lens, uncertainty=None, calibration=block)
    table, poses = room_poses(lens, 6 * NOISE, rng)
    errors = LensErrors.from_lens(lens)
    if not calibrated:  # noise alone: neither components nor misfit
        exact = replace(errors.model, geometry=None, covariance=0 * errors.model.covariance)
        errors = replace(errors, misfit=0.0, model=exact)
    found, parts = localize_with_errors(errors, table)
    off = found.result.pose.difference(poses)
    pull = np.einsum('si,sij,sj->s', off, np.linalg.inv(parts.total), off) / 6
    assert pull.mean() == pytest.approx(1, abs=0.15)


def test_stereo_points_take_the_noise_that_is_measured():
    lens = LensErrors.from_lens(uncertain())
    rig = Pose(np.eye(3), np.array([-0.15, 0.0, 0.0]))
    points = np.array([[0.1, 0.05, 0.6]])
    board, room, sharper = (
        depth_errors(lens, lens, rig, points, sigma).noise for sigma in (0.0, 3 * NOISE, NOISE / 3)
    )
    np.testing.assert_allclose(room, 9 * board)
    np.testing.assert_allclose(sharper, board)


def test_library_and_core_say_the_same_and_misfit_is_no_doubt():
    lens, rng = uncertain(), np.random.default_rng(4)
    pose = Pose(rotation_from_vector(np.array([0.2, -0.2, 0.1])), np.array([0.1, 0.1, -0.3]))
    uv = seen_by(lens, pose, BOARD, rng)
    table = make_observations(
        np.zeros(len(BOARD), int),
        np.arange(len(BOARD)),
        uv,
        BOARD,
        sigma=np.full(len(BOARD), NOISE),
    )
    plain, known = fsvp.localize(table, lens), fsvp.localize(table, lens, model_error=True)
    poses, parts = localize_with_errors(LensErrors.from_lens(lens), table)
    np.testing.assert_array_equal(known.covariance, parts.total)
    assert plain.reasons[0] and not known.reasons[0] and not poses.reasons[0]
    bare = localize(
        ForwardModel(lens),
        poses.views._replace(weight=np.full_like(poses.views.weight, 1 / NOISE)),
    )
    np.testing.assert_allclose(parts.noise, bare.covariance, rtol=1e-3)
    # Without a sigma the noise is the lens's, not what residuals look like.
    guessed = fsvp.localize(
        replace(table, sigma=np.full(len(BOARD), np.nan)), lens, model_error=True
    )
    np.testing.assert_allclose(guessed.covariance, known.covariance, rtol=1e-3)


def test_a_budget_of_a_lens_that_knows_its_errors():
    lens = uncertain()
    setup = Setup(lens, Pose(np.eye(3), np.array([0.15, 0.0, 0.0])), 0.1)
    budget = make_budget(setup, 3, 3)
    assert set(budget.own) == {'parameters', 'misfit'}
    for by in budget.own.values():
        assert set(by) == {'position', 'axis', 'depth'}
        assert all((values > 0).all() and values.shape == (3, 3) for values in by.values())
    # Nothing but a wrong focal length: depth errs in proportion.
    only = replace(
        lens,
        uncertainty={
            **lens.uncertainty,
            'components': {},
            'parameters': ['fx'],
            'covariance': [[9.0]],
        },
    )
    wide = make_budget(Setup(only, setup.rig, 0.1), 2, 2).own
    assert not wide['misfit']['depth'].any() and (wide['parameters']['depth'] > 0).all()


def test_a_lens_without_errors_or_with_half_of_them_is_refused():
    lens = uncertain()
    for calibration in (None, {'rms_px': 0.2}, {'stderr': {'fx': 1.0}, 'covariance': [[1.0]]}):
        with pytest.raises(LensError, match='no uncertainty'):
            LensErrors.from_lens(replace(lens, uncertainty=None, calibration=calibration))
    for name, value in (
        ('noise_px', -1.0),
        ('covariance', [[1.0]]),
        ('extent_px', None),
        ('landmarks', []),
        ('landmarks', [[float('nan'), 0, 0, 0, 0]]),
        ('extent_px', [[5.0, 5.0], [5.0, 9.0]]),
        ('noise_px', 10**400),
        ('covariance', (-np.eye(6)).tolist()),
        ('components', {'image_coarse': float('nan')}),
    ):
        with pytest.raises(LensError, match='uncertainty'):
            LensErrors.from_lens(replace(lens, uncertainty={**lens.uncertainty, name: value}))


def test_what_the_target_is_uncertain_by_needs_no_boards_to_be_told():
    """Topics tell of none: the localizer's covariance is that of the command."""
    points = np.column_stack([*np.mgrid[-3:4, -2:3].reshape(2, -1) * 0.04, np.zeros(35)])
    rows = [[i, 4, *map(float, point)] for i, point in enumerate(points)]
    bow = {
        'degree': 2,
        'boards': [[4.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0, 0, 0.1]],
        'parameters': {f'board4.z{name}': 0.001 for name in ('20', '11', '02')},
    }
    base = uncertain()
    lens = replace(
        base,
        target={'landmarks': rows, 'target_shape': bow},
        uncertainty={
            **base.uncertainty,
            'parameters': ['target_shape.board4.z20'],
            'covariance': [[1e-8]],
            'components': {},
        },
    )
    pose = Pose(rotation_from_vector(np.array([[0.3, -0.2, 0.1]])), np.array([[0.05, 0.0, -0.3]]))
    views = views_of(points, np.zeros((1, 35, 2)))
    errors = LensErrors.from_lens(lens)
    told, untold = (
        errors.of_poses(views._replace(board=board), pose).parameters
        for board in (np.full_like(views.board, 4), views.board)
    )
    assert np.sqrt(told[0, 2, 2]) > 1e-5
    np.testing.assert_allclose(untold, told, rtol=1e-12)
