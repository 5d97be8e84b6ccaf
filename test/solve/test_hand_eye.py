"""Hand-eye calibration: transforms, scale and noise of a robot, and what does not fix them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.differences import jacobian
from helpers.robot import LENS, TRUTH, robot

from fisheye_svp_ros.errors import GeometryError, ObservationError
from fisheye_svp_ros.library.calibration import LensOptions, calibrate_cameras
from fisheye_svp_ros.pose import Pose, identity, rotation_from_vector
from fisheye_svp_ros.reporting.calibrated_camera import hand_eye_rows
from fisheye_svp_ros.reporting.wording.calibration import hand_eye_sentence, hand_eye_warnings
from fisheye_svp_ros.solve.bundle_adjustment import Adjustment, adjust
from fisheye_svp_ros.solve.hand_eye import (
    MAX_ODDS,
    HandEye,
    Transforms,
    _check_noise,
    _Robot,
    fit_hand_eye,
    flange_poses,
    solve_hand_eye,
)
from fisheye_svp_ros.solve.least_squares import arrow_information
from fisheye_svp_ros.solve.lens_calibration import calibrate, calibrate_hand_eye
from fisheye_svp_ros.solve.reliability import noise_sigma
from fisheye_svp_ros.solve.rig_state import Linearization, RigState, group_by_frame


def fit(seed: int, **settings) -> tuple[RigState, HandEye]:
    table, camera, poses = robot(seed, **settings)
    data = group_by_frame(table)
    state = RigState(camera, identity(1), LENS, ())
    return fit_hand_eye(data, state, ('f', 'cx', 'cy'), *flange_poses(data, poses))


def errors(found: HandEye) -> np.ndarray:
    return np.concatenate(
        [
            found.camera.difference(TRUTH.camera),
            found.target.difference(TRUTH.target),
            [found.scale - TRUTH.scale],
        ]
    )


def test_exact_poses_give_the_transforms() -> None:
    camera = robot(1)[1]
    flange = TRUTH.flange(camera)
    found = solve_hand_eye(camera, Pose(flange.rotation, flange.position / TRUTH.scale))
    np.testing.assert_allclose(found.camera.difference(TRUTH.camera), 0, atol=1e-12)
    np.testing.assert_allclose(found.target.difference(TRUTH.target), 0, atol=1e-12)
    assert found.scale == pytest.approx(TRUTH.scale, abs=1e-12)


def test_noise_and_errors_are_those_of_the_robot() -> None:
    found = [fit(seed)[1] for seed in range(12)]
    noise = np.array([(one.noise_m, one.noise_rad) for one in found])
    np.testing.assert_allclose(np.sqrt((noise**2).mean(axis=0)), (3e-4, 1e-3), rtol=0.12)
    z = np.array([errors(one) / one.stderr for one in found])
    assert 0.8 < np.sqrt((z**2).mean()) < 1.2


def test_a_camera_whose_own_poses_are_known_is_at_the_flange() -> None:
    table, camera, _ = robot(3)
    data = group_by_frame(table)
    state = RigState(camera, identity(1), LENS, ())
    found = fit_hand_eye(data, state, (), camera, np.ones(data.frames, dtype=bool))[1]
    nothing = identity()
    assert np.abs(found.camera.difference(nothing)).max() < 5e-4
    assert np.abs(found.target.difference(nothing)).max() < 5e-4
    assert found.noise_m < 5e-5


@pytest.mark.parametrize('fixed_camera', [False, True])
def test_derivatives(fixed_camera: bool) -> None:
    _, camera, poses = robot(2, frames=5, fixed_camera=fixed_camera)
    known = np.array([True, True, False, True, True])
    one = _Robot(Pose.stack(list(poses.values())), known, 1.0, fixed_camera)
    frame, shared = one.columns(TRUTH, camera)

    def moved(change: np.ndarray) -> np.ndarray:
        there = Transforms(
            TRUTH.camera.retract(change[:6]),
            TRUTH.target.retract(change[6:12]),
            TRUTH.scale + change[12],
        )
        return one.residual(there, camera)

    np.testing.assert_allclose(shared, jacobian(moved)(np.zeros(13)), atol=1e-6)
    np.testing.assert_allclose(
        frame,
        jacobian(lambda change: one.residual(TRUTH, camera.retract(np.tile(change, (5, 1)))))(
            np.zeros(6)
        ),
        atol=1e-6,
    )
    assert not frame[2].any() and not shared[2].any()


def test_a_robot_holds_the_lens() -> None:
    """Poses that are far better than those of the images tell the lens."""
    off: list[list[float]] = []
    for seed in range(6):
        table, _, poses = robot(seed, frames=8, noise=(2e-6, 5e-6))
        alone = calibrate(table, 'kannala_brandt', (1280, 960), ('f', 'cx', 'cy', 'k1'))
        both, found = calibrate_hand_eye(alone, table, poses)
        off.append([abs(one.adjusted.lens.cx - LENS.cx) for one in (alone, both)])
        written = both.adjusted.lens.calibration['hand_eye']
        assert written['noise_m'] == found.noise_m and len(written['covariance']) == 13
        assert (
            both.adjusted.lens.calibration['rms_px'] >= (alone.adjusted.lens.calibration['rms_px'])
        )
    before, after = np.mean(off, axis=0)
    assert after < 0.7 * before


@pytest.mark.parametrize(
    ('scale', 'said'),
    [
        (1.001, ''),
        (0.9, 'lengths of the target are -10.0 % off those of the robot'),
        (2.5, 'a factor of 2.5; both'),
        (0.001, 'a factor of 1000: the poses may be in mm'),
        (1001.0, 'a factor of 1001: the target may be in mm; both are needed in m'),
    ],
)
def test_lengths_in_other_units_are_told(scale: float, said: str) -> None:
    warnings = hand_eye_warnings(replace(fit(1)[1], scale=scale))
    assert [said in one for one in warnings] == [True] * bool(said)


def test_frames_without_a_pose_have_none() -> None:
    table, camera, poses = robot(4)
    for number in (0, 7):
        del poses[number]
    data = group_by_frame(table)
    state = RigState(camera, identity(1), LENS, ())
    found = fit_hand_eye(data, state, (), *flange_poses(data, poses))[1]
    assert len(found.frame) == 16 and not {0, 7} & set(found.frame.tolist())
    assert (np.abs(errors(found) / found.stderr) < 4).all()


def test_what_does_not_fix_the_transform_is_refused() -> None:
    _, camera, _ = robot(5)
    turned = np.zeros((18, 3))
    turned[:, 2] = np.linspace(0, 1, 18)
    one_axis = Pose(rotation_from_vector(turned), camera.position)
    with pytest.raises(GeometryError, match='turn it about two axes'):
        solve_hand_eye(one_axis, one_axis)
    with pytest.raises(GeometryError, match='4 or more are needed'):
        solve_hand_eye(camera.take([0, 1, 2]), camera.take([0, 1, 2]))


def test_poses_of_other_frames_are_refused() -> None:
    table, _, poses = robot(6)
    alone = calibrate(table, 'kannala_brandt', (1280, 960), ('f', 'cx', 'cy', 'k1'))
    shuffled = dict(zip(poses, [poses[(7 * i + 3) % 18] for i in range(18)], strict=True))
    with pytest.raises(ObservationError, match='not those of a flange that carries the camera or'):
        calibrate_hand_eye(alone, table, shuffled)


@pytest.mark.parametrize('fixed_camera', [False, True])
@pytest.mark.parametrize('noise', [(3e-4, 1e-3), (3e-3, 1e-2)])
def test_the_arrangement_is_found_with_its_errors(
    noise: tuple[float, float], fixed_camera: bool
) -> None:
    found = [fit(seed, noise=noise, fixed_camera=fixed_camera)[1] for seed in range(8)]
    assert all(one.fixed_camera == fixed_camera and one.odds == MAX_ODDS for one in found)
    z = np.array([errors(one) / one.stderr for one in found])
    assert 0.75 < np.sqrt((z**2).mean()) < 1.3
    sizes = np.array([(one.noise_m, one.noise_rad) for one in found])
    np.testing.assert_allclose(np.sqrt((sizes**2).mean(axis=0)), noise, rtol=0.2)
    written = found[0].to_dict()
    assert ('camera_in_base' in written) == fixed_camera
    assert ('target_in_base' in written) != fixed_camera


def test_a_fixed_camera_is_told_with_its_odds() -> None:
    found = fit(3, fixed_camera=True)[1]
    assert 'which carries the target, the camera is fixed (odds more than 1e+06 to 1)' in (
        hand_eye_sentence(found)
    )
    assert [row[0] for row in hand_eye_rows(found)][::2] == ['camera in base', 'target in flange']
    (warning,) = hand_eye_warnings(found)
    assert 'If it carries the camera, the poses are inverted' in warning
    assert 'which carries the camera (odds more than' in hand_eye_sentence(fit(3)[1])


@pytest.mark.parametrize('fixed_camera', [False, True])
def test_noise_that_no_robot_has_is_refused(fixed_camera: bool) -> None:
    with pytest.raises(GeometryError, match='with camera or target on the flange'):
        fit(4, noise=(0.06, 0.15), fixed_camera=fixed_camera)


def test_poses_that_show_no_arrangement_are_refused() -> None:
    with pytest.raises(GeometryError, match='whether the camera or the target is on the flange'):
        _check_noise(np.array([1e-3, 1e-3]), robot(1)[1], 3.0)


def hand_eye_of(free: tuple[str, ...], covariance: np.ndarray | None) -> HandEye:
    """Fit from what least squares makes of the images alone; the lens known by a covariance."""
    table, camera, poses = robot(8, noise=(1e-4, 2e-4))
    data = group_by_frame(table)
    state = adjust(data, RigState(camera, identity(1), LENS, ()), ('f', 'cx', 'cy'))
    return fit_hand_eye(data, state, free, *flange_poses(data, poses), covariance)[1]


def assert_same(one: HandEye, other: HandEye, rtol: float) -> None:
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=rtol, atol=1e-13)
    assert (np.abs(one.camera.difference(other.camera)) < 0.01 * one.stderr[:6]).all()


def test_a_lens_known_as_the_images_know_it_changes_nothing() -> None:
    free = ('f', 'cx', 'cy')
    table, camera, _ = robot(8, noise=(1e-4, 2e-4))
    data = group_by_frame(table)
    state = adjust(data, RigState(camera, identity(1), LENS, ()), free)
    problem = Adjustment(data, state, free)
    normal = problem.linearize(problem.pack([state]), np.zeros(1, dtype=int))[1]
    sigma = noise_sigma(
        Linearization(data, state, ()).sum_of_squares,
        2 * len(table),
        6 * data.frames + len(free),
    )
    covariance = sigma**2 * np.linalg.inv(arrow_information(normal)[0])
    assert_same(hand_eye_of(free, covariance), hand_eye_of(free, None), 1e-3)
    # Known exactly, it is held; known less, the transforms are known less.
    assert_same(hand_eye_of(free, 1e-8 * covariance), hand_eye_of((), None), 0.02)
    loose, plain = hand_eye_of(free, 25 * covariance), hand_eye_of(free, None)
    assert (loose.stderr > plain.stderr).all() and loose.stderr[3] > 1.1 * plain.stderr[3]


def test_transforms_of_a_robot_before_a_bent_board_hold_their_errors() -> None:
    """The lens is known less well than noise alone says, and so are the transforms."""
    z = []
    for seed in range(6):
        table, _, poses = robot(seed, frames=12, noise=(2e-4, 5e-4))
        across = 2 * (table.xyz[:, 0] - table.xyz[:, 0].mean()) / np.ptp(table.xyz[:, 0])
        said = table.xyz + (5e-4 * (across**2 - 1 / 3))[:, None] * [0.0, 0.0, 1.0]
        options = LensOptions(poses=poses)
        found = calibrate_cameras(replace(table, xyz=said), {'': (1280, 960)}, options)
        z.append(errors(found.cameras[''].hand_eye) / found.cameras[''].hand_eye.stderr)
    assert np.sqrt(np.square(z).mean()) < 1.4
