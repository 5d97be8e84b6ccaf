"""Rendered photographs show what the lens projects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.photographs import BOARD, LENS, PRINTED, photograph, poses, true_corners

from fisheye_svp_ros.detect.corner_fit import fit_corners
from fisheye_svp_ros.detect.patterns import parse_pattern
from fisheye_svp_ros.detect.points import find_points, local_axes
from fisheye_svp_ros.errors import GeometryError, ParameterError
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.simulate.render import Exposure, Field, Print, pixel_rays, render
from fisheye_svp_ros.simulate.targets import TARGETS, board_views, target_views, visible

QUIET = Exposure(noise=0.0)
PATTERN = parse_pattern(BOARD)


def corner_errors(printed: Print, exposure: Exposure, count: int = 2) -> np.ndarray:
    """Return found minus true corners of some photographs."""
    errors = []
    for i in range(count):
        pose = poses(count, 3, printed).take(i)
        points = find_points(photograph(pose, printed, exposure), PATTERN, 'saddle')
        assert not isinstance(points, str), points
        errors.append(points.uv - true_corners(pose, printed)[points.ids])
    return np.concatenate(errors)


def bow(height: float) -> Field:
    return lambda place: height * ((place[..., 0] - 0.075) / 0.075) ** 2


@pytest.mark.parametrize(
    'printed',
    [
        PRINTED,
        replace(PRINTED, bow=bow(0.002)),
        replace(PRINTED, shift=lambda place: 0.01 * place[..., ::-1]),
    ],
    ids=['flat', 'bowed', 'sheared print'],
)
def test_corners_are_where_the_lens_projects_them(printed: Print) -> None:
    errors = corner_errors(printed, QUIET)
    assert np.abs(errors.mean(axis=0)).max() < 0.01
    assert np.sqrt((errors**2).mean()) < 0.03


def test_the_viewpoint_shift_is_in_the_picture() -> None:
    pose = poses(4, 2).take(0)
    moved = replace(LENS, viewpoint_shift=None)
    points = find_points(photograph(pose), PATTERN, 'saddle')
    assert not isinstance(points, str)
    svp = project(moved, pose.into_body(PRINTED.corners)).uv[points.ids]
    assert np.abs(points.uv - svp).max() > 0.3


def test_rolling_shutter_shears_the_picture() -> None:
    pose = poses(1, 5).take(0)
    shutter = replace(QUIET, line_time=3e-5, twist=(0.3, 0.0, 0.0, 0.0, 0.0, 0.0))
    points = find_points(photograph(pose, exposure=shutter), PATTERN, 'saddle')
    assert not isinstance(points, str)
    true = true_corners(pose)[points.ids]
    late = 3e-5 * (true[:, 1] - (LENS.height - 1) / 2)
    expected = np.stack(
        [
            project(LENS, (PRINTED.corners[corner] - place) @ pose.rotation).uv
            for corner, place in zip(
                points.ids, pose.position + late[:, None] * [0.3, 0, 0], strict=True
            )
        ]
    )
    assert np.abs(expected - true).max() > 0.2
    assert np.abs(points.uv - expected).max() < 0.03


def test_effects_given_in_the_image_move_the_corners() -> None:
    pose = poses(1, 7).take(0)
    image = render(
        LENS,
        PRINTED,
        pose,
        QUIET,
        np.random.default_rng(0),
        moved=lambda place: np.stack([8 * place[..., 1], 0 * place[..., 0]], axis=-1),
    )
    points = find_points(image, PATTERN, 'saddle')
    assert not isinstance(points, str)
    expected = true_corners(pose) + np.stack([8 * PRINTED.corners[:, 1], np.zeros(30)], axis=-1)
    assert np.abs(points.uv - expected[points.ids]).max() < 0.02


def test_rays_computed_once_give_the_same_photographs() -> None:
    rays = pixel_rays(LENS)
    shutter = replace(QUIET, line_time=3e-5, twist=(0.3, 0.0, 0.0, 0.0, 0.0, 0.0))
    for pose, exposure in ((poses(2).take(0), QUIET), (poses(2).take(1), shutter)):
        first, second = (
            render(LENS, PRINTED, pose, exposure, np.random.default_rng(0), rays=one)
            for one in (None, rays)
        )
        np.testing.assert_array_equal(first, second)


def test_the_same_seed_gives_the_same_photograph() -> None:
    pose = poses(1).take(0)
    assert np.array_equal(photograph(pose), photograph(pose))
    assert not np.array_equal(photograph(pose), photograph(pose, seed=1))


def test_blur_grows_outwards_and_light_falls_off() -> None:
    pose = poses(1, 9).take(0)
    sharp = photograph(pose, exposure=QUIET).astype(float)
    soft = photograph(pose, exposure=replace(QUIET, blur_edge=3.0)).astype(float)
    assert np.abs(np.diff(soft)).max() < np.abs(np.diff(sharp)).max()
    assert sharp[0, 0] == 0  # beyond the field of view
    dim = photograph(pose, exposure=replace(QUIET, gain=0.5)).astype(float)
    assert np.allclose(dim, sharp / 2, atol=1)


def test_a_board_that_does_not_fit_is_refused() -> None:
    with pytest.raises(GeometryError, match='does not see the whole board'):
        board_views(LENS, Print(60, 50, 0.03), 1, (0.1, 0.2), np.random.default_rng(0))


@pytest.mark.parametrize('kind', TARGETS)
def test_corners_of_a_cube_and_a_room_are_where_they_are_said_to_be(kind: str) -> None:
    boards = TARGETS[kind](Print(5, 5, 0.02))
    pose = target_views(LENS, kind, boards, 1, (0.12, 0.16), np.random.default_rng(2)).take(0)
    image = render(LENS, boards, pose, QUIET, np.random.default_rng(0)).astype(float)
    uv, seen = visible(LENS, boards, pose)
    assert (seen.sum(axis=1) > 3).sum() >= 2
    checked = 0
    for board, points, mine in zip(boards, uv, seen, strict=True):
        if mine.sum() < 12:
            continue
        axes = local_axes(board.printed.corners[mine, :2], points[mine])
        reach = 0.02 * np.abs(np.linalg.det(axes)) / np.linalg.norm(axes, axis=-1).max(axis=-1)
        found = fit_corners(image, points[mine], axes, 0.7 * reach)
        error = np.linalg.norm(found.uv - points[mine], axis=-1)[found.ok & (reach > 8)]
        assert not len(error) or np.median(error) < 0.02
        checked += len(error)
    assert checked > 10


def test_a_face_that_looks_away_is_not_seen() -> None:
    boards = TARGETS['cube'](Print(5, 5, 0.02))
    poses = target_views(LENS, 'cube', boards, 5, (0.12, 0.3), np.random.default_rng(1))
    for i in range(5):
        seen = visible(LENS, boards, poses.take(i))[1].any(axis=1).reshape(3, 2)
        assert not seen.all(axis=1).any()


@pytest.mark.parametrize('values', [{'blur': 1e9}, {'noise': 256.0}, {'blur': float('nan')}])
def test_an_exposure_that_leaves_no_picture_is_refused(values: dict[str, float]) -> None:
    with pytest.raises(ParameterError, match=r'(blur|noise) is .* are needed'):
        Exposure(**values)
