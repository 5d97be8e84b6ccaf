"""A rolling shutter that the lens does not model is bounded by how the camera moves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.tag_room import LENS, TagRoom, oval

from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.optics.curves import KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import make_observations
from fisheye_svp_ros.solve.poses import solve_poses
from fisheye_svp_ros.solve.readout import Readout, exceeds, row_shift, steady_velocity
from fisheye_svp_ros.solve.table_poses import solve_table
from fisheye_svp_ros.solve.weak_geometry import CHI2_999

MODEL, ROOM = ForwardModel(LENS), TagRoom(16)
READOUT = 0.03
CURVE = KannalaBrandt(0.03, -0.01)


def rolled(camera: Pose, velocity: np.ndarray, seconds: float) -> np.ndarray:
    """Return image points of all tags in view, each as the camera stood when its row was read."""
    tags = ROOM.visible(camera)
    uv = ROOM.project(camera, tags)
    for _ in range(3):
        late = seconds * (uv[:, 1] / LENS.height - 0.5)
        each = [camera.retract(velocity * time) for time in late]
        uv = np.stack([ROOM.project(one, tags)[i] for i, one in enumerate(each)])
    return uv


@pytest.mark.parametrize('pace', [1.0, 0.02])
def test_the_bias_is_that_of_solved_images(pace: float) -> None:
    rng, velocity = np.random.default_rng(1), pace * np.array([0.3, 0.1, 0.0, 0.0, 0.0, 1.0])
    for place in (0.1, 0.4, 0.8):
        camera = oval(place)
        uv = rolled(camera, velocity, READOUT)
        views = ROOM.views(camera, uv, ROOM.visible(camera), 0.2, rng)
        solved = solve_poses(MODEL, views._replace(uv=uv[None]), examined=False)
        off = solved.pose.difference(camera.take(None))[0]
        bias = READOUT * row_shift(solved, velocity).bias[0]
        np.testing.assert_allclose(bias, off, atol=0.1 * np.linalg.norm(off))
        covariance = solved.covariance[0]
        outside = off @ np.linalg.solve(covariance, off) > CHI2_999
        assert exceeds(bias, covariance) == outside == (pace == 1.0)
        covariance = covariance + np.outer(bias, bias)
        assert off @ np.linalg.solve(covariance, off) < CHI2_999


def test_a_velocity_is_that_of_a_steady_motion() -> None:
    velocity = np.array([0.3, 0.1, 0.0, 0.0, 0.0, 0.7])
    times = [1.0, 1.1, 1.25]
    poses = [oval(0.2).retract(velocity * time) for time in times]
    np.testing.assert_allclose(steady_velocity(times, poses), velocity, atol=0.05)
    assert steady_velocity(times[:2], poses[:2]) is None
    assert steady_velocity([1.0, 1.1, 1.9], poses) is None, 'long ago'
    assert steady_velocity(times, [poses[0], poses[2], poses[1]]) is None, 'noise'


def test_residuals_of_another_error_are_no_rolling_shutter() -> None:
    velocity, known = np.array([0.3, 0.1, 0.0, 0.0, 0.0, 1.0]), Readout(0.03)
    for i in range(10):
        camera = oval(0.1).retract(0.1 * i * velocity)
        uv, tags = rolled(camera, velocity, 0.2), ROOM.visible(camera)
        views = ROOM.views(camera, uv, tags, 0.2, np.random.default_rng(i))
        solved = solve_poses(MODEL, views)
        assert not known.cover(0.1 * i, solved, solved.covariance)[1]
    assert known.time > 0.1


@pytest.mark.parametrize('readout', [0.0, 0.005, 0.02, -0.02])
@pytest.mark.parametrize('fx', [330.0, 331.5])
def test_residuals_tell_the_readout_of_a_turning_camera(readout: float, fx: float) -> None:
    """A global shutter gets no warning, also with a lens that is somewhat wrong."""
    rng, velocity = np.random.default_rng(5), np.array([0.3, 0.1, 0.0, 0.0, 0.0, 1.0])
    lens, known = Lens('made', 1280, 960, fx, 331.0, 640.5, 479.5, CURVE, 1.5), Readout(0.03)
    assert known.mean_square() == pytest.approx(0.03**2 / 3, rel=0.02), 'nothing is known yet'
    for i in range(20):
        camera = oval(0.1).retract(0.1 * i * velocity)
        tags = ROOM.visible(camera)
        uv = rolled(camera, velocity, readout)
        solved = solve_poses(ForwardModel(lens), ROOM.views(camera, uv, tags, 0.2, rng), tags=True)
        covariance, text = known.cover(0.1 * i, solved, solved.covariance)
        assert not text or readout
        assert (covariance[0] - solved.covariance[0]).trace() >= 0
    assert known.time == pytest.approx(readout, abs=4 * known.stderr) and known.stderr < 0.003
    assert known.mean_square() == pytest.approx(known.time**2 + known.stderr**2, rel=0.05)
    assert bool(text) == (abs(readout) > 0.01)


def test_poses_of_a_table_cover_the_readout_by_their_times() -> None:
    """Frames that follow each other while the camera turns; without times there is no motion."""
    velocity, found = np.array([0.3, 0.1, 0.0, 0.0, 0.0, 1.0]), []
    for i in range(5):
        camera = oval(0.1).retract(0.1 * i * velocity)
        uv = rolled(camera, velocity, READOUT)
        found.append(ROOM.views(camera, uv, ROOM.visible(camera), 1e-9, np.random.default_rng(i)))
    frame = np.repeat(np.arange(5), [one.uv.shape[1] for one in found])
    landmark, uv, xyz = (
        np.concatenate([getattr(one, name)[0] for one in found])
        for name in ('landmark', 'uv', 'points')
    )
    sigma = np.full(len(frame), 0.2)
    table = make_observations(frame, landmark, uv, xyz, t=0.1 * frame, sigma=sigma)
    plain, covered = (solve_table(table, MODEL, readout_time=s) for s in (0.0, READOUT))
    told = ['a rolling shutter of ' in reason for reason in covered.reasons]
    assert told == [False, False, True, True, True]
    cameras = Pose.stack([oval(0.1).retract(0.1 * i * velocity) for i in range(5)])
    off = plain.pose.difference(cameras)
    for i, (before, after) in enumerate(zip(plain.covariance, covered.covariance, strict=True)):
        assert off[i] @ np.linalg.solve(before, off[i]) > CHI2_999
        assert (off[i] @ np.linalg.solve(after, off[i]) < CHI2_999) == told[i]
    still = solve_table(replace(table, t=np.full(len(frame), np.nan)), MODEL, readout_time=READOUT)
    np.testing.assert_array_equal(still.covariance, plain.covariance)
