"""A rig among tags: errors of the map, tags as wholes, and a plane, as with one camera."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.tag_room import LENS, MOUNT, TagRoom, oval

from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.io.tag_maps import CORNERS, TagMap, map_of_size
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.scene.observations import (
    Observations,
    group_frames,
    make_observations,
    views_of,
)
from fisheye_svp_ros.scene.pose_priors import PlanarPrior
from fisheye_svp_ros.solve.localization import localize
from fisheye_svp_ros.solve.rig_model import RigModel
from fisheye_svp_ros.solve.solved_poses import SolvedPoses
from fisheye_svp_ros.solve.table_poses import solve_rig_table, solve_table
from fisheye_svp_ros.solve.weak_geometry import CHI2_999, is_ambiguous

CAMERAS = ('ahead', 'left')
LENSES = dict.fromkeys(CAMERAS, LENS)
# The second camera looks to the left of the first: turned about y, which points down.
RIG = Pose(
    np.stack([np.eye(3), rotation_from_vector(np.array([0.0, -np.pi / 2, 0.0]))]),
    np.array([[0.0, 0.0, 0.0], [-0.2, 0.05, -0.1]]),
)
MODEL, ROOM, SIGMA = ForwardModel(LENS), TagRoom(16), 0.2
ERROR = 0.004  # m and rad, of a tag of the map


def with_errors(tags: TagMap) -> TagMap:
    """Return the map with the covariance that it states."""
    return tags._replace(covariance=ERROR**2 * np.eye(6 * len(tags.ids)))


def see(
    actual: TagMap,
    cameras: Pose,
    rng: np.random.Generator,
    most: tuple[int, ...] = (16, 16),
    sigma: float | None = SIGMA,
) -> Observations:
    """Return what the rig sees at some places (F,) of its first camera, by the map of the room.

    actual: the tags as they hang; most: tags that each camera sees.
    """
    columns: list[list[np.ndarray]] = [[], [], [], []]
    for frame in range(len(cameras.position)):
        for number, count in enumerate(most):
            camera = cameras.take(frame).compose(RIG.take(number))
            tags = rng.permutation(ROOM.visible(camera))[:count]
            points = views_of(actual.corners[tags].reshape(1, -1, 3))
            uv = MODEL.predict(camera.take(None), points, limited=False).uv[0]
            landmark = (CORNERS * tags[:, None] + np.arange(CORNERS)).ravel()
            noisy = uv + SIGMA * rng.normal(size=uv.shape)
            here = np.full(len(landmark), frame), np.full(len(landmark), number)
            for column, part in zip(columns, (*here, landmark, noisy), strict=True):
                column.append(part)
    frame, camera, landmark, uv = map(np.concatenate, columns)
    xyz = ROOM.tags.corners.reshape(-1, 3)[landmark]
    return make_observations(
        frame,
        landmark,
        uv,
        xyz,
        camera=camera,
        cameras=CAMERAS,
        sigma=None if sigma is None else np.full(len(frame), sigma),
    )


def solve(table: Observations, tags: TagMap, prior: PlanarPrior | None = None) -> SolvedPoses:
    return solve_rig_table(table, LENSES, CAMERAS, RIG, tags, prior=prior)


def nees(solved: SolvedPoses, cameras: Pose) -> np.ndarray:
    """Return the normalized squared errors (S,) of poses."""
    error = solved.pose.difference(cameras.take(solved.frame))
    return np.einsum('fi,fij,fj->f', error, np.linalg.inv(solved.covariance), error)


def places(count: int) -> Pose:
    return Pose.stack([oval(part) for part in np.linspace(0, 1, count, endpoint=False)])


def test_derivatives_are_those_of_the_predictions() -> None:
    rng = np.random.default_rng(0)
    views, widths = group_frames(see(ROOM.tags, places(3), rng))
    model, pose = RigModel([MODEL, MODEL], RIG, widths), places(3)
    linear = model.linearize(pose, views)
    for column, step in enumerate(1e-6 * np.eye(6)):
        higher, lower = (model.linearize(pose.retract(s * step[None]), views) for s in (1, -1))
        slope = (higher.uv - lower.uv) / 2e-6
        np.testing.assert_allclose(
            model.d_pose(linear, views)[..., column][views.used], slope[views.used], atol=1e-3
        )


def test_one_camera_in_the_body_is_as_by_itself() -> None:
    table = see(ROOM.tags, places(4), np.random.default_rng(5), (16, 0))
    alone = solve_table(table, MODEL, ROOM.tags)
    rig = solve_rig_table(table, LENSES, CAMERAS, RIG, ROOM.tags)
    np.testing.assert_allclose(rig.pose.position, alone.pose.position, atol=1e-8)
    np.testing.assert_allclose(rig.covariance, alone.covariance, rtol=1e-5, atol=1e-13)


@pytest.mark.parametrize('sigma', [SIGMA, None])
def test_the_errors_of_the_map_are_in_the_pose(sigma: float | None) -> None:
    """Each frame among tags of its own errors, and the sigma of corners known or not."""
    rng, squares, reasons = np.random.default_rng(1), [], []
    for part in np.linspace(0, 1, 12, endpoint=False):
        actual = ROOM.tags.poses.retract(rng.normal(0, ERROR, (16, 6)))
        camera = oval(part).take(None)
        table = see(map_of_size(ROOM.tags.ids, ROOM.size, actual), camera, rng, sigma=sigma)
        solved = solve(table, with_errors(ROOM.tags))
        squares += nees(solved, camera).tolist()
        reasons += solved.reasons
        assert solved.sigma is None or 0.02 <= solved.sigma < 3 * SIGMA
    assert 3.0 < np.mean(squares) < 9.0
    assert sum(map(bool, reasons)) <= 1


def test_a_moved_tag_is_rejected_from_both_cameras_and_named() -> None:
    rng = np.random.default_rng(2)
    cameras = places(6)
    table = see(ROOM.tags, cameras, rng)
    both = next(
        tag
        for tag in ROOM.tags.ids.tolist()
        if len(np.unique(table.camera[table.landmark // CORNERS == tag])) == 2
    )
    table = see(ROOM.move(both, [0.15, 0.1, -0.1]).tags, cameras, rng)
    of_table = solve(table, ROOM.tags)  # of an exact map, by all frames together
    assert {one.number // CORNERS for one in of_table.landmarks} == {both}
    solved = solve(table, with_errors(ROOM.tags))
    shown = np.unique(table.frame[table.landmark // CORNERS == both])
    named = [f'tag {both}' in reason or f' {both} ' in reason for reason in solved.reasons]
    assert np.flatnonzero(named).tolist() == shown.tolist()
    rejected = solved.views.landmark[solved.outliers] // CORNERS
    assert set(rejected.tolist()) == {both} and solved.outliers.sum() % CORNERS == 0
    assert nees(solved, cameras).max() < CHI2_999


def test_a_camera_without_a_pose_of_its_own_adds_what_it_sees() -> None:
    """Two corners in the second camera, and a frame that only this one sees."""
    cameras = places(2)
    table = see(ROOM.tags, cameras, np.random.default_rng(3))
    second = np.flatnonzero((table.camera == 1) & (table.frame == 0))
    kept = np.ones(len(table), dtype=bool)
    kept[second[2:]] = False
    kept[(table.camera == 0) & (table.frame == 1)] = False
    solved = solve(table.take(kept), ROOM.tags)
    assert solved.frame.tolist() == [0, 1] and not any(solved.reasons)
    assert solved.views.used[0].sum() == (kept & (table.frame == 0)).sum()
    assert nees(solved, cameras).max() < CHI2_999


def test_poses_need_no_start_values_however_the_rig_stands() -> None:
    table = see(ROOM.tags, places(8), np.random.default_rng(4))
    turn = Pose(rotation_from_vector(np.array([1.2, -2.0, 0.7])), np.array([9.0, -4.0, 2.0]))
    views, widths = group_frames(table)
    moved = views._replace(
        points=turn.transform(views.points.reshape(-1, 3)).reshape(views.points.shape)
    )
    found = localize(RigModel([MODEL, MODEL], RIG, widths), moved).pose
    expected = turn.compose(places(8))
    assert np.linalg.norm(found.position - expected.position, axis=1).max() < 0.05


def test_a_plane_leaves_fewer_second_poses_of_one_far_tag() -> None:
    ambiguous = []
    for plane in (False, True):
        cameras = places(16)
        table = see(ROOM.tags, cameras, np.random.default_rng(6), (1, 0))
        frames = len(table.frames)
        prior = PlanarPrior(
            Pose.stack([MOUNT.inverse()] * frames), np.zeros(frames), np.full((frames, 2), 0.02)
        )
        solved = solve(table, ROOM.tags, prior if plane else None)
        assert nees(solved, cameras).max() < CHI2_999
        ambiguous.append(int(is_ambiguous(solved.result).sum()))
    assert ambiguous[1] < ambiguous[0]
