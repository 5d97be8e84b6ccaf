"""Epipolar curves and stereo depth: exact with the true lens, Kita's sizes with SVP."""

import numpy as np
import pytest
from helpers.differences import jacobian
from scipy.optimize import brentq, least_squares, minimize_scalar

from fisheye_svp_ros.effects.base import ModelTerm
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.io.landmark_files import environment
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.optics.camera import back_project, project
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import RADII
from fisheye_svp_ros.scene.rigs import STYLES, paper_pose, rig
from fisheye_svp_ros.solve.stereo_depth import (
    epipolar_curves,
    epipolar_offset,
    triangulate,
    triangulate_optimally,
)

MODELS = {name: ForwardModel(load_lens(lens_path(name))) for name in ('fish180', 'fish214')}
SVP = {name: ForwardModel(model.lens.svp()) for name, model in MODELS.items()}
# Kita, section 5: the right camera stands at the origin, for Fish214 0.1 m ahead of it.
AHEAD = {'fish180': 0.0, 'fish214': 0.1}


def matches(name, style, radius):
    """True points (N, 3) in the right camera and their image points in both."""
    pose = Pose(paper_pose().rotation, np.array([0, 0, -AHEAD[name]]))
    points = pose.into_body(environment('whole', radius).points)
    left = project(MODELS[name].lens, rig(style).into_body(points))
    right = project(MODELS[name].lens, points)
    both = left.valid & right.valid
    return points[both], left.uv[both], right.uv[both]


def random_points(rng, count):
    """Points in front of both cameras of every style, 0.3 to 3 m away."""
    theta, azimuth = np.radians(rng.uniform(0, 70, count)), rng.uniform(-np.pi, np.pi, count)
    distance = rng.uniform(0.3, 3.0, count)
    return distance[:, None] * np.stack(
        [np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)], axis=-1
    )


@pytest.mark.parametrize('name', MODELS)
@pytest.mark.parametrize('style', STYLES)
@pytest.mark.parametrize('radius', RADII)
def test_errors_vanish_with_the_true_lens(name, style, radius):
    model = MODELS[name]
    points, uv_left, uv_right = matches(name, style, radius)
    offset = epipolar_offset(model, model, rig(style), uv_left, uv_right)
    assert offset.distance.max() < 1e-8
    assert np.abs(offset.vertical).max() < 1e-8
    for solved in (
        triangulate(model, model, rig(style), uv_left, uv_right),
        triangulate_optimally(model, model, rig(style), uv_left, uv_right),
    ):
        assert solved.valid.all()
        assert np.abs(solved.points - points).max() < 1e-9


@pytest.mark.parametrize(
    ('name', 'published', 'depth_mm'),
    [('fish180', (0.004, 0.61), (1.6, 8.6)), ('fish214', (0.03, 9.3), (6.4, 43.4))],
)
def test_svp_errors_have_the_papers_size(name, published, depth_mm):
    svp, error2, error3 = SVP[name], {}, []
    for radius in RADII:
        for style in STYLES:
            points, uv_left, uv_right = matches(name, style, radius)
            offset = epipolar_offset(svp, svp, rig(style), uv_left, uv_right)
            found = triangulate(svp, svp, rig(style), uv_left, uv_right).points
            error2[radius, style] = np.nanmean(offset.distance)
            error3.append(1e3 * np.nanmedian(np.linalg.norm(found - points, axis=-1)))
            assert error2[radius, style] < np.nanmean(np.abs(offset.vertical))
    assert published[0] / 2.5 < min(error2.values()) < published[0] * 2.5
    assert published[1] / 2.5 < max(error2.values()) < published[1] * 2.5
    assert depth_mm[0] / 2.5 < min(error3) < max(error3) < depth_mm[1]
    for style in STYLES:
        assert error2[2.0, style] < error2[0.5, style] < error2[0.2, style]
    for radius in RADII:
        assert error2[radius, 'parallel'] < error2[radius, 'divergent']


def test_fish214_at_two_metres_has_the_papers_error2():
    for style, published in (('parallel', 0.026), ('vergent', 0.295), ('divergent', 0.339)):
        _, uv_left, uv_right = matches('fish214', style, 2.0)
        offset = epipolar_offset(SVP['fish214'], SVP['fish214'], rig(style), uv_left, uv_right)
        assert np.nanmean(offset.distance) == pytest.approx(published, rel=0.25)


@pytest.mark.parametrize('style', STYLES)
def test_offsets_equal_a_search_along_the_curve(style):
    rng = np.random.default_rng(71)
    model, lens = MODELS['fish214'], MODELS['fish214'].lens
    points = random_points(rng, 40)
    uv_right = project(lens, points).uv
    uv_left = project(lens, rig(style).into_body(points)).uv + rng.normal(size=(40, 2)) * 10
    offset = epipolar_offset(model, model, rig(style), uv_left, uv_right)
    rays = back_project(lens, uv_right)
    for i in range(40):

        def seen(inverse, i=i):
            points = rays.origin[i] + rays.direction[i] / np.reshape(inverse, (-1, 1))
            return project(lens, rig(style).into_body(points), limited=False).uv

        grid = np.concatenate([[1e-6], np.geomspace(1e-3, 30, 3000)])
        off = np.linalg.norm(seen(grid) - uv_left[i], axis=-1)
        best = np.nanargmin(off)
        low, high = grid[max(best - 1, 0)], grid[best + 1]
        found = minimize_scalar(
            lambda w, i=i: np.linalg.norm(seen(w)[0] - uv_left[i]),
            bounds=(low, high),
            method='bounded',
            options={'xatol': 1e-12},
        )
        assert offset.distance[i] == pytest.approx(min(found.fun, off[best]), abs=1e-7)
        assert np.linalg.norm(offset.foot[i] - uv_left[i]) == pytest.approx(offset.distance[i])
        u = seen(grid)[:, 0] - uv_left[i, 0]
        columns = np.flatnonzero(u[:-1] * u[1:] < 0)
        if not columns.size:
            assert np.isnan(offset.vertical[i])
            continue
        k = columns[np.argmin(np.abs(columns - best))]
        root = brentq(
            lambda w, i=i: seen(w)[0, 0] - uv_left[i, 0], grid[k], grid[k + 1], xtol=1e-15
        )
        assert offset.vertical[i] == pytest.approx(uv_left[i, 1] - seen(root)[0, 1], abs=1e-6)


def test_curves_pass_through_the_matches_and_have_no_offset():
    rng = np.random.default_rng(72)
    left, right = MODELS['fish180'], MODELS['fish214']
    points = random_points(rng, 20)
    uv_right = project(right.lens, points).uv
    curves = epipolar_curves(left, right, rig('vergent'), uv_right, count=400)
    assert curves.shape == (20, 400, 2)
    uv_left = project(left.lens, rig('vergent').into_body(points)).uv
    inside = np.isfinite(uv_left[:, 0])
    gap = np.linalg.norm(curves - uv_left[:, None], axis=-1)
    assert np.nanmin(gap[inside], axis=1).max() < 1.5
    offset = epipolar_offset(left, right, rig('vergent'), curves, uv_right[:, None])
    drawn = np.isfinite(curves[..., 0])
    assert drawn.mean() > 0.5
    assert offset.distance[drawn].max() < 1e-7
    infinity = project(
        left.lens, rig('vergent').into_body(1e6 * back_project(right.lens, uv_right).direction)
    ).uv
    np.testing.assert_allclose(curves[:, 0], infinity, atol=1e-3)


def test_a_match_beyond_infinity_ends_at_infinity():
    model = SVP['fish180']
    uv_right = project(model.lens, np.array([0.3, 0.2, 1.0])).uv
    end = epipolar_curves(model, model, rig('parallel'), uv_right, count=2)[0]
    beyond = end - [3.0, 0.0]
    offset = epipolar_offset(model, model, rig('parallel'), beyond, uv_right)
    assert offset.distance == pytest.approx(3.0, abs=0.1)
    np.testing.assert_allclose(offset.foot, end, atol=1e-4)
    assert np.isnan(offset.vertical)
    assert not triangulate(model, model, rig('parallel'), beyond, uv_right).valid


def test_midpoint_is_halfway_between_the_nearest_points_of_the_rays():
    rng = np.random.default_rng(73)
    model, lens, pose = MODELS['fish214'], MODELS['fish214'].lens, rig('divergent')
    points = random_points(rng, 30)
    uv_right = project(lens, points).uv
    uv_left = project(lens, pose.into_body(points)).uv + rng.normal(size=(30, 2))
    solved = triangulate(model, model, pose, uv_left, uv_right)
    a, b = back_project(lens, uv_left), back_project(lens, uv_right)
    for i in np.flatnonzero(solved.valid):
        start, along = pose.transform(a.origin[i]), pose.rotation @ a.direction[i]
        depths = np.linalg.lstsq(
            np.stack([along, -b.direction[i]], axis=1), b.origin[i] - start, rcond=None
        )[0]
        one, two = start + depths[0] * along, b.origin[i] + depths[1] * b.direction[i]
        np.testing.assert_allclose(solved.points[i], (one + two) / 2, rtol=0, atol=1e-9)
        assert solved.gap[i] == pytest.approx(np.linalg.norm(one - two), abs=1e-12)
    assert solved.valid.sum() >= 28


def test_optimal_points_equal_scipy_and_beat_the_midpoint():
    rng = np.random.default_rng(74)
    left, right, pose = MODELS['fish180'], SVP['fish214'], rig('vergent')
    points = random_points(rng, 12)
    uv_right = project(right.lens, points).uv + 0.5 * rng.normal(size=(12, 2))
    uv_left = project(left.lens, pose.into_body(points)).uv + 0.5 * rng.normal(size=(12, 2))
    solved = triangulate_optimally(left, right, pose, uv_left, uv_right)
    midpoint = triangulate(left, right, pose, uv_left, uv_right)
    assert solved.valid.sum() >= 9
    for i in np.flatnonzero(solved.valid):

        def residual(x, i=i):
            return np.concatenate(
                [
                    uv_left[i] - project(left.lens, pose.into_body(x[None]), limited=False).uv[0],
                    uv_right[i] - project(right.lens, x, limited=False).uv,
                ]
            )

        found = least_squares(
            residual,
            points[i],
            jacobian(residual),
            method='lm',
            xtol=1e-14,
            ftol=1e-14,
            gtol=1e-14,
        )
        np.testing.assert_allclose(solved.points[i], found.x, rtol=0, atol=1e-7)
        own = np.concatenate([solved.left_residual[i], solved.right_residual[i]])
        np.testing.assert_allclose(own, residual(solved.points[i]), atol=1e-9)
        assert np.sum(own**2) < np.sum(residual(midpoint.points[i]) ** 2)


@pytest.mark.parametrize('name', ['sensor_tilt', 'decentering', 'detector_bias'])
def test_no_correction_of_a_lens_keeps_a_point_from_being_found(name):
    rng = np.random.default_rng(51)
    effect = CATALOGUE[name]()
    model = ForwardModel(
        SVP['fish180'].lens, [ModelTerm(effect, np.full(len(effect.parameters), 0.005))]
    )
    points, pose = random_points(rng, 300), rig('parallel')
    left, right = (
        model.project(seen).uv + rng.normal(scale=0.3, size=(300, 2))
        for seen in (pose.into_body(points), points)
    )
    solved = triangulate_optimally(model, model, pose, left, right, 0.3)
    assert np.array_equal(solved.valid, triangulate(model, model, pose, left, right).valid)
    off = (solved.points - points)[solved.valid]
    nees = np.einsum('ni,nij,nj->n', off, np.linalg.inv(solved.covariance[solved.valid]), off)
    assert np.median(nees) == pytest.approx(2.37, rel=0.2)
    assert np.isfinite(epipolar_offset(model, model, pose, left, right).distance).mean() > 0.99


@pytest.mark.parametrize('style', STYLES)
def test_covariance_of_optimal_points_holds(style):
    rng = np.random.default_rng(75)
    model, lens, pose = MODELS['fish214'], MODELS['fish214'].lens, rig(style)
    points = np.repeat(random_points(rng, 10) * [0.5, 0.5, 1] / 2 + [0, 0, 0.2], 200, axis=0)
    shape = (10, 200)
    uv_right = project(lens, points).uv + 0.1 * rng.normal(size=(2000, 2))
    uv_left = project(lens, pose.into_body(points)).uv + 0.1 * rng.normal(size=(2000, 2))
    solved = triangulate_optimally(
        model, model, pose, uv_left.reshape(*shape, 2), uv_right.reshape(*shape, 2), sigma=0.1
    )
    assert solved.valid.all()
    assert solved.covariance.shape == (*shape, 3, 3)
    error = solved.points - points.reshape(*shape, 3)
    nees = np.einsum('...i,...ij,...j->...', error, np.linalg.inv(solved.covariance), error)
    assert nees.mean() == pytest.approx(3.0, abs=0.2)
    residual = np.concatenate([solved.left_residual, solved.right_residual], axis=-1) / 0.1
    assert (residual**2).sum(axis=-1).mean() == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize('shape', [(), (0,), (3,), (2, 3)])
def test_any_leading_shape(shape):
    model, lens = MODELS['fish214'], MODELS['fish214'].lens
    points = np.broadcast_to([0.1, 0.2, 0.8], (*shape, 3))
    uv_left, uv_right = (
        project(lens, rig('parallel').into_body(points.reshape(-1, 3))).uv.reshape(*shape, 2),
        project(lens, points).uv,
    )
    assert epipolar_curves(model, model, rig('parallel'), uv_right, 7).shape == (*shape, 7, 2)
    offset = epipolar_offset(model, model, rig('parallel'), uv_left, uv_right)
    assert offset.distance.shape == offset.vertical.shape == shape
    solved = triangulate(model, model, rig('parallel'), uv_left, uv_right)
    assert solved.gap.shape == solved.valid.shape == shape
    optimal = triangulate_optimally(model, model, rig('parallel'), uv_left, uv_right)
    assert optimal.points.shape == (*shape, 3)
    assert optimal.covariance.shape == (*shape, 3, 3)
    np.testing.assert_allclose(optimal.points, points, atol=1e-9)


def test_a_rig_for_every_system():
    model, lens = MODELS['fish180'], MODELS['fish180'].lens
    points = random_points(np.random.default_rng(76), 6) * [0.5, 0.5, 1.0]
    rigs = [rig(style) for style in STYLES]
    many = Pose(*(np.stack(parts)[:, None] for parts in zip(*rigs, strict=True)))
    uv_left = np.stack([project(lens, each.into_body(points)).uv for each in rigs])
    solved = triangulate_optimally(model, model, many, uv_left, project(lens, points).uv)
    assert solved.points.shape == (3, 6, 3)
    np.testing.assert_allclose(
        solved.points[solved.valid], np.broadcast_to(points, (3, 6, 3))[solved.valid], atol=1e-9
    )
    assert solved.valid.sum() >= 15


def test_what_cannot_be_seen_is_flagged():
    model, lens = MODELS['fish180'], MODELS['fish180'].lens
    good = project(lens, np.array([0.1, 0.2, 0.8])).uv
    left = project(lens, rig('parallel').into_body(np.array([[0.1, 0.2, 0.8]]))).uv[0]
    uv_right = np.stack([good, [np.nan, 5.0], [9000.0, 0.0], good])
    uv_left = np.stack([left, left, left, [np.nan, np.nan]])
    expected = [True, False, False, False]
    for solved in (
        triangulate(model, model, rig('parallel'), uv_left, uv_right),
        triangulate_optimally(model, model, rig('parallel'), uv_left, uv_right),
    ):
        assert solved.valid.tolist() == expected
        assert np.isfinite(solved.points).all(axis=-1).tolist() == expected
    offset = epipolar_offset(model, model, rig('parallel'), uv_left, uv_right)
    assert np.isfinite(offset.distance).tolist() == expected
    assert np.isfinite(offset.vertical).tolist() == expected


@pytest.mark.parametrize('behind', ['right', 'left'])
def test_rays_that_meet_behind_one_camera_measure_nothing(behind):
    """A lens of more than 180 degrees sees where the other camera's ray runs backwards."""
    model, pair = ForwardModel(MODELS['fish214'].lens.svp()), rig('parallel')
    angle = np.radians(85.0)
    away = np.array([np.sin(angle), 0.0, np.cos(angle)])
    if behind == 'right':
        meeting, right = -0.5 * away, away
        left = meeting - pair.position
    else:
        away = away * [-1, 1, 1]
        meeting, left = pair.position - 0.5 * away, away
        right = meeting
    image = [project(model.lens, ray) for ray in (left, right)]
    assert image[0].valid and image[1].valid
    solved = triangulate(model, model, pair, image[0].uv, image[1].uv)
    assert not solved.valid and np.isnan(solved.points).all() and np.isnan(solved.gap)


def test_rays_that_are_parallel_to_the_last_digit_measure_nothing():
    """Their information is singular."""
    model = SVP['fish214']
    for seed in range(5):
        rng = np.random.default_rng(seed)
        uv = rng.uniform(300, 1200, (20, 2))
        one = Pose(np.eye(3), np.array([10.0 ** -rng.integers(1, 20), 0, 0]))
        for off in (0.0, 1e-13, 1e-9):
            found = triangulate_optimally(
                model, model, one, uv, uv + off * rng.standard_normal(uv.shape)
            )
            assert np.isfinite(found.covariance[found.valid]).all()
            assert np.isnan(found.points[~found.valid]).all()
